"""The steps of a guided calibration (the paper's, or a plan file), and the session of their readings: a CSV of
measurements, a row per step, on disk before the next begins, also with ``step`` (in the plan, or extra), ``serial``,
``taken`` (UTC), and ``var_j_k_ue2``, the covariance of one reading."""

from __future__ import annotations

import csv
import datetime
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec
import numpy as np

from canopen_device.toml_table import convert, read_table
from tipforce.arrays import FloatArray
from tipforce.errors import InputError, placed
from tipforce.host.configuration.measurements import LARGEST_ANGLE_DEG, LOAD_COLUMNS, read_measurements
from tipforce.output_file import new_file
from tipforce.sensor.calibration.regressors import FORCES, require_seen
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.layouts import GROOVES_DEG

if TYPE_CHECKING:
    from tipforce.host.configuration.capture import Capture

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


TARE = Step(EXTRA, 0.0, 0.0, 0.0, "tare", "remove every load")
EXTRA_TARE = replace(TARE, instruction="remove every load (after a pause the offsets may have drifted)")


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
    Raises InputError for a weight or groove that is not allowed, and for loads that do not determine the matrix."""
    places = _grooves(grooves)
    try:
        newtons = [float(word) for word in weights.split(",")]
    except ValueError:
        newtons = []
    if not newtons or not all(0.0 < P < math.inf for P in newtons):
        raise InputError(f"--weights {weights!r}: allowed are newtons above 0 separated by commas: 4.4,2.2")
    loads = []
    for P in newtons:
        hang = f"hang {P:g} N ({P / GRAVITY * 1000:.4g} g) in the"
        for along, phi, theta in places:
            text = f"{hang} {along}-groove at theta = {theta:g} degrees (phi = {phi:g})"
            loads.append(Step(0, P, phi, theta, "pull", text))
    return _plan(loads, TARE_EVERY)


def file_plan(path: str | Path) -> tuple[Step, ...]:
    """Return the steps of a plan file. Raises InputError naming the file, the step and what is allowed."""
    content = convert(_File, read_table(path, f"plan {path}"), f"plan {path}")
    if content.tare_every < 1:
        raise InputError(f"plan {path}: tare_every = {content.tare_every}: allowed is 1 or more")
    with placed(f"plan {path}"):
        steps = [_step(k + 1, step) for k, step in enumerate(content.step)]
        return _plan(steps, 0 if any(step.mode == "tare" for step in steps) else content.tare_every)


def _step(number: int, step: _FileStep) -> Step:
    P, phi, theta = step.P_N, step.phi_deg, step.theta_deg
    if step.mode == "tare":
        if P or phi or theta:
            raise InputError(f"step {number} is a tare, an unloaded reading: remove P_N, phi_deg and theta_deg")
        return replace(TARE, instruction=step.instruction or TARE.instruction)
    if not 0.0 < P < math.inf:
        raise InputError(f"step {number}: P_N = {P:g}: allowed is above 0 (an unloaded reading: mode = tare)")
    most = LARGEST_ANGLE_DEG
    for name, angle in (("phi_deg", phi), ("theta_deg", theta)):
        if angle is None or not abs(angle) <= most:
            raise InputError(f"step {number}: {name} = {angle}: allowed is -{most:g} to {most:g}")
    assert phi is not None
    assert theta is not None
    text = step.instruction or f"{step.mode} with {P:g} N at theta = {theta:g} degrees (phi = {phi:g})"
    return Step(0, P, phi, theta, step.mode, text)


def _grooves(text: str) -> list[tuple[str, float, float]]:
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


def _plan(steps: list[Step], tare_every: int) -> tuple[Step, ...]:
    if tare_every:
        groups = [[*steps[k : k + tare_every], TARE] for k in range(0, len(steps), tare_every)]
        steps = [TARE, *chain.from_iterable(groups)]
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


class Row(NamedTuple):
    """The values of one line that the guide needs; the fit reads the file itself."""

    step: int
    t_s: float
    taken: datetime.datetime
    mean_microstrain: FloatArray
    covariance_microstrain2: FloatArray
    """(n, n), of one reading."""
    samples: int
    unloaded: bool


class Session:
    """A session file of one node and one plan; created with the first row. Raises InputError for a file that is
    damaged, no session or another's, and leaves it unchanged. A last line truncated by an interruption is removed."""

    def __init__(self, path: str | Path, steps: Sequence[Step], serial: int, gauges: int, temperature: bool) -> None:
        self.path = Path(path)
        self.rows: list[Row] = []
        self.cut = False
        """The last line was truncated by an interruption, and has been removed."""
        self._serial, self._n = serial, gauges
        upper = [(j, k) for j in range(gauges) for k in range(j, gauges)]
        self._variances = {f"var_{j + 1}_{k + 1}_ue2": (j, k) for j, k in upper}
        self._steps = {step.number: step for step in steps}
        self._columns = self._columns_of(temperature)
        self._content = self._read()
        whole = self._content[: self._content.rfind(b"\n") + 1]
        if whole:
            self._load(whole)
        elif not self._header().startswith(self._content):
            raise InputError(f"session {self.path}: not a session file; choose another --session")
        if whole != self._content:
            self.cut = True
            self._save(whole)

    @property
    def done(self) -> set[int]:
        """Numbers of the completed steps."""
        return {row.step for row in self.rows if row.step != EXTRA}

    def append(self, step: Step, capture: Capture) -> None:
        """Write the row of a step to disk. Raises InputError or WriteError if that fails."""
        now = datetime.datetime.now(datetime.UTC)
        t_s = 0.0
        if self.rows:  # they stay in time order even if the clock is set
            t_s = max(self.rows[-1].t_s, self.rows[0].t_s + (now - self.rows[0].taken).total_seconds())
        self._save((self._content or self._header()) + self._line(step, capture, t_s, now).encode())
        row = Row(step.number, round(t_s, 3), now, capture.mean, capture.covariance, capture.count, step.mode == "tare")
        self.rows.append(row)

    def drop_last(self) -> int | None:
        """Remove the last row from the file; return the number of its step, None if there is no row."""
        if not self.rows:
            return None
        self._save(self._content[: self._content.rfind(b"\n", 0, -1) + 1])
        return self.rows.pop().step

    def noise(self) -> tuple[FloatArray, float]:
        """Return the covariance of one reading, (n, n), strain^2, and its degrees of freedom, from all captures."""
        freedom = [row.samples - 1 for row in self.rows]
        mean = np.average([row.covariance_microstrain2 for row in self.rows], axis=0, weights=freedom)
        return np.asarray(mean * 1e-12, dtype=np.float64), float(sum(freedom))

    def _columns_of(self, temperature: bool) -> list[str]:
        gauges = [f"SG{k + 1}" for k in range(self._n)]
        degrees = ["temperature_degC"] if temperature else []
        return ["t_s", *gauges, *LOAD_COLUMNS, *degrees, "weight", "mode", "step", "serial", "taken", *self._variances]

    def _header(self) -> bytes:
        return ",".join(self._columns).encode() + b"\n"

    def _line(self, step: Step, capture: Capture, t_s: float, now: datetime.datetime) -> str:
        if "temperature_degC" in self._columns and capture.temperature_degC is None:
            raise InputError("the node no longer sends its temperature, which the session has: check the node")
        cells = {
            "t_s": f"{t_s:.3f}",
            "P_N": repr(step.P_newtons),
            "phi_deg": repr(step.phi_deg),
            "theta_deg": repr(step.theta_deg),
            "temperature_degC": f"{capture.temperature_degC or 0.0:.2f}",
            "weight": str(capture.count),
            "mode": step.mode,
            "step": str(step.number) if step.number != EXTRA else "extra",
            "serial": str(self._serial),
            "taken": now.isoformat(timespec="milliseconds"),
        }
        cells |= {f"SG{k + 1}": f"{value:.6f}" for k, value in enumerate(capture.mean)}
        cells |= {name: f"{capture.covariance[place]:.8g}" for name, place in self._variances.items()}
        return ",".join(cells[name] for name in self._columns) + "\n"

    def _read(self) -> bytes:
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            if not self.path.absolute().parent.is_dir():
                raise InputError(f"session {self.path}: the directory does not exist; create it first") from None
            return b""
        except OSError as error:
            raise InputError(f"session {self.path}: {error.strerror}") from error

    def _save(self, content: bytes) -> None:
        if self._read() != self._content:
            raise InputError(f"session {self.path}: another program has changed it; start the same command again")
        with new_file(self.path) as partial, partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if os.name == "posix":  # so that the new name is on disk, too
            folder = os.open(self.path.absolute().parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
        self._content = content

    def _load(self, content: bytes) -> None:
        try:
            lines = content.decode("utf-8-sig").splitlines(keepends=True)
        except UnicodeDecodeError:
            raise InputError(f"session {self.path}: not UTF-8, not a session file") from None
        names = next(csv.reader(lines[:1]))
        gauges = sum(name.startswith("SG") for name in names)
        self._columns = self._columns_of("temperature_degC" in names)
        if {"step", "serial", "taken", "SG1"} <= set(names) and gauges != self._n:
            raise InputError(f"session {self.path}: it has {gauges} gauges, the node has {self._n}")
        if names != self._columns:
            missing = [name for name in self._columns if name not in names]
            what = f"the column {missing[0]} is missing" if missing else "the columns are not those of a session"
            raise InputError(f"session {self.path}: not a session file ({what}); choose another --session")
        bad = read_measurements(self.path, loads=True).bad if len(lines) > 1 else ()
        faults = [row for row in bad if row.line <= len(lines)]  # without the truncated line
        if faults:
            raise InputError(f"session {self.path}: {faults[0]}; correct that line, or remove it to repeat the step")
        self.rows = [self._row(number, line) for number, line in enumerate(lines[1:], 2)]

    def _row(self, number: int, text: str) -> Row:
        place = f"session {self.path}: line {number}"
        cells = dict(zip(self._columns, next(csv.reader([text])), strict=True))
        try:
            step = EXTRA if cells["step"] == "extra" else int(cells["step"])
            serial, samples = int(cells["serial"]), round(float(cells["weight"]))
            taken = datetime.datetime.fromisoformat(cells["taken"])
            P, phi, theta = (float(cells[name]) for name in LOAD_COLUMNS)
            covariance = np.zeros((self._n, self._n))
            for name, (j, k) in self._variances.items():
                covariance[j, k] = covariance[k, j] = float(cells[name])
            mean = np.array([float(cells[f"SG{k + 1}"]) for k in range(self._n)])
            if taken.tzinfo is None or samples < 2 or not np.isfinite(covariance).all():
                raise ValueError
        except ValueError:
            text = f"{place}: not a line of a session; correct it, or remove it to repeat the step"
            raise InputError(text) from None
        if serial != self._serial:
            raise InputError(f"{place}: of the node with serial {serial}, this one has serial {self._serial}")
        taken_step, planned = Step(step, P, phi, theta, cells["mode"], ""), self._steps.get(step)
        if step == EXTRA and taken_step.mode != "tare":
            raise InputError(f"{place}: an extra step is {taken_step}, allowed is unloaded")
        if step != EXTRA and (planned is None or taken_step.load != planned.load):
            wrong = f"step {step} is {taken_step}, in this plan it is {planned}"
            if planned is None:
                wrong = f"step {step} ({taken_step}), this plan has {len(self._steps)} steps"
            raise InputError(f"{place}: {wrong}: another plan; pass the plan of this session, or another --session")
        return Row(step, float(cells["t_s"]), taken, mean, covariance, samples, cells["mode"] == "tare")
