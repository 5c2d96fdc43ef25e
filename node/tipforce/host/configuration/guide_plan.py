"""The steps of a guided calibration, loads and unloaded readings between them: the paper's, or those of a file.

A plan file, in TOML::

    tare_every = 4                # loads between unloaded readings (default 4); not used if a step is a tare

    [[step]]
    P_N = 4.4                     # newtons, above 0
    phi_deg = 0.0                 # direction of the force
    theta_deg = 30.0              # contact angle
    mode = "pull"                 # or push, or tare (an unloaded reading, without the three keys above)
    instruction = "hang weight A on hook 3"      # optional
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from canopen_device.toml_table import convert, read_table
from tipforce.errors import InputError
from tipforce.host.configuration.measurements import LARGEST_ANGLE_DEG
from tipforce.sensor.calibration.regressors import FORCES, require_seen
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.published import GROOVES_DEG

GRAVITY = 9.80665  # m/s^2
TARE_EVERY = 4
EXTRA = 0
"""Number of an unloaded reading beyond the plan, taken when a session continues after a pause."""


@dataclass(frozen=True, slots=True)
class Step:
    """One load and its reading. ``number`` counts from 1."""

    number: int
    P_newtons: float
    phi_deg: float
    theta_deg: float
    mode: str
    """pull, push or tare."""
    instruction: str

    @property
    def load(self) -> tuple[float, float, float, str]:
        """The key that identifies the step in a session."""
        return self.P_newtons, self.phi_deg, self.theta_deg, self.mode

    def __str__(self) -> str:
        if self.mode == "tare":
            return "unloaded"
        return f"{self.P_newtons:g} N at phi {self.phi_deg:g}, theta {self.theta_deg:g} degrees, {self.mode}"


EXTRA_TARE = Step(EXTRA, 0.0, 0.0, 0.0, "tare", "remove every load (after a pause the offsets may have drifted)")


class _FileStep(msgspec.Struct, forbid_unknown_fields=True):
    P_N: float = 0.0
    phi_deg: float | None = None
    theta_deg: float | None = None
    mode: Literal["pull", "push", "tare"] = "pull"
    instruction: str = ""


class _File(msgspec.Struct, forbid_unknown_fields=True):
    step: tuple[_FileStep, ...]
    tare_every: int = TARE_EVERY
    name: str = ""


def groove_plan(weights: str, grooves: str) -> tuple[Step, ...]:
    """Return steps of a rope in grooves: every weight ("4.4,2.2", newtons) in every groove ("paper", or "x30,y60").

    Raises InputError for a weight or groove that is not allowed, and for loads that do not determine the matrix.
    """
    places = _grooves(grooves)
    loads = []
    for P in _weights(weights):
        hang = f"hang {P:g} N ({P / GRAVITY * 1000:.4g} g) in the"
        for along, phi, theta in places:
            text = f"{hang} {along}-groove at theta = {theta:g} degrees (phi = {phi:g})"
            loads.append(Step(0, P, phi, theta, "pull", text))
    return _numbered(_with_tares(loads, TARE_EVERY))


def file_plan(path: str | Path) -> tuple[Step, ...]:
    """Return the steps of a plan file. Raises InputError naming the file, the step and what is allowed."""
    content = convert(_File, read_table(path, f"plan {path}"), f"plan {path}")
    if content.tare_every < 1:
        raise InputError(f"plan {path}: tare_every = {content.tare_every}: allowed is 1 or more")
    try:
        steps = [_step(k + 1, found) for k, found in enumerate(content.step)]
        own_tares = any(step.mode == "tare" for step in steps)
        return _numbered(steps if own_tares else _with_tares(steps, content.tare_every))
    except InputError as error:
        raise InputError(f"plan {path}: {error}") from None


def _step(number: int, found: _FileStep) -> Step:
    if found.mode == "tare":
        if found.P_N or found.phi_deg or found.theta_deg:
            raise InputError(f"step {number} is a tare, an unloaded reading: remove P_N, phi_deg and theta_deg")
        return Step(0, 0.0, 0.0, 0.0, "tare", found.instruction or _UNLOAD)
    if not 0.0 < found.P_N < math.inf:
        raise InputError(f"step {number}: P_N = {found.P_N:g}: allowed is above 0 (an unloaded reading: mode = tare)")
    for name, angle in (("phi_deg", found.phi_deg), ("theta_deg", found.theta_deg)):
        if angle is None or not abs(angle) <= LARGEST_ANGLE_DEG:
            raise InputError(
                f"step {number}: {name} = {angle}: allowed is -{LARGEST_ANGLE_DEG:g} to {LARGEST_ANGLE_DEG:g}"
            )
    assert found.phi_deg is not None
    assert found.theta_deg is not None
    phi, theta = found.phi_deg, found.theta_deg
    text = found.instruction or f"{found.mode} with {found.P_N:g} N at theta = {theta:g} degrees (phi = {phi:g})"
    return Step(0, found.P_N, phi, theta, found.mode, text)


_UNLOAD = "remove every load"


def _weights(text: str) -> list[float]:
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(0.0 < P < math.inf for P in found):
        raise InputError(f"--weights {text!r}: allowed are newtons above 0 separated by commas: 4.4,2.2")
    return found


def _grooves(text: str) -> list[tuple[str, float, float]]:
    """Return (x or y, phi, theta) of each groove, degrees."""
    if text == "paper":
        return [("y" if phi == 90.0 else "x", phi, theta) for phi, theta in GROOVES_DEG]
    found = []
    for word in text.split(","):
        parts = re.fullmatch(r"\s*([xy])(\d{1,3}(?:\.\d+)?)\s*", word)
        if parts is None or float(parts[2]) > 180.0:
            raise InputError(f"--grooves {text!r}: {word!r}: allowed are paper, or grooves: x30,y60 (theta 0 to 180)")
        theta = float(parts[2])
        # A rope can only pull away from the tip.
        phi = 90.0 if parts[1] == "y" else 0.0 if theta < 90.0 else 180.0
        found.append((parts[1], phi, theta))
    return found


def _with_tares(loads: Sequence[Step], every: int) -> list[Step]:
    tare = Step(0, 0.0, 0.0, 0.0, "tare", _UNLOAD)
    steps = [tare]
    for k, load in enumerate(loads):
        steps.append(load)
        if (k + 1) % every == 0 or k + 1 == len(loads):
            steps.append(tare)
    return steps


def _numbered(steps: Sequence[Step]) -> tuple[Step, ...]:
    loads = [step for step in steps if step.mode != "tare"]
    if not loads:
        raise InputError("no step has a load: add at least one with P_N above 0")
    # Loads that cannot determine the matrix are refused before they are applied.
    typical_newtons = sum(step.P_newtons for step in loads) / len(loads)
    P = np.array([step.P_newtons for step in steps])
    phi, theta = (np.radians([getattr(step, name) for step in steps]) for name in ("phi_deg", "theta_deg"))
    g = np.concatenate((force_vector(P, phi, theta) / typical_newtons, np.ones((len(steps), 1))), axis=1)
    require_seen(g, np.ones((len(steps), 1), dtype=np.bool_), (*FORCES, "offset"), typical_newtons)
    return tuple(replace(step, number=k + 1) for k, step in enumerate(steps))
