"""The slit between tip and horizontal beam as a stop: an overload closes it, and the structure is stiffer from there.

The figure of the cross-section is not in the paper's text. Assumed: the slit, 0.25 mm wide as the cut, runs along the
upper face of the horizontal beam. How far it has closed is a cubic along each arm, so where a load closes it first is
where that cubic is largest. The stop has as many contact points on each arm as bring the load of first contact, in
every direction, within two per cent of that. The tip is rigid; the arm yields where it is pressed, as a beam with
held ends; each contact has a stiffness of its own. The force between tip and arm is an inner one: fixture and vertical
beam feel the applied force alone, the gauges of the arms do not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import Modes, compliances
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.limits import PAPER_SLIT_M
from tipforce.sensor.structure.plane_frame import EULER_BERNOULLI, Frame, FrameModel

STOP_STIFFNESS = 1e7
"""N/m of the contact alone, assumed; the arm behind it is softer (in the fabricated body 2.4e6 N/m)."""


CLOSE_ENOUGH, SMALLEST_CLOSURE = 0.02, 0.02
"""By what share the stop's points may close later than the whole slit, for loads that close it by at least so much of
what the worst one does: the others (beyond 750 N in the fabricated body) bend it elsewhere first."""
_FRACTIONS = np.linspace(0.0, 1.0, 201)
_SENSES = np.radians(np.arange(0.0, 360.0, 10.0))


class SlitStop(NamedTuple):
    """k contacts, those of the left arm first, in terms of the elastic force of the open structure."""

    closure_per_newton: FloatArray
    """(k, 3): how far the slit has closed per newton of elastic force in the arms, m/N."""
    gap_m: float
    compliance: FloatArray
    """(k, k): metres per newton of stop force, the tip held."""
    arms_per_newton: FloatArray
    """(3, k): what stop forces add to the elastic force in the arms."""
    vertical_per_newton: FloatArray
    """(3, k): and in the vertical beam."""
    right_arm: BoolArray
    """(k,): False for the left arm."""
    fraction: FloatArray
    """(k,): place along the arm, 0 at the joint."""


def slit_stop(
    geometry: Geometry,
    modes: Modes,
    gap_m: float = PAPER_SLIT_M,
    stiffness: float = STOP_STIFFNESS,
    model: FrameModel = EULER_BERNOULLI,
) -> SlitStop:
    """Return the stop for the modes of the same geometry and frame model.

    Raises InputError for a gap or stiffness (N/m) that is not positive and finite.
    """
    for name, value in (("gap_m", gap_m), ("stop stiffness", stiffness)):
        if not 0.0 < value < math.inf:
            raise InputError(f"{name} = {value!r}: allowed is a positive finite number")
    g, frame = geometry, Frame(geometry, model)
    xi = contact_fractions(frame)
    s = frame.slit_closure(xi).reshape(-1, 3)
    bending = g.youngs_modulus_pascals * g.width_m * g.h1_m**3 / 12.0
    own = np.kron(np.eye(2), _held_beam(xi) * g.a_m**3 / bending) + np.eye(2 * len(xi)) / stiffness
    places = np.repeat([False, True], len(xi)), np.tile(xi, 2)
    if len(modes.omega_rad_s) > 3:
        # The joint's motion is a state: a stop force acts on the tip's motion relative to it, nothing in between.
        return SlitStop(s, gap_m, own, np.zeros((3, len(s))), np.zeros((3, len(s))), *places)
    arms, vertical = compliances(frame)
    arm_stiffness, stiffness_of_both = np.linalg.inv(arms), np.linalg.inv(arms + vertical)
    behind = s @ (arm_stiffness - stiffness_of_both) @ s.T
    return SlitStop(
        s, gap_m, own + 0.5 * (behind + behind.T),
        (stiffness_of_both - arm_stiffness) @ s.T, stiffness_of_both @ s.T, *places,
    )  # fmt: skip


def contact_fractions(frame: Frame) -> FloatArray:
    """Return the places along an arm, (k,), that together close as early as the whole slit, within CLOSE_ENOUGH."""
    phi, theta = (grid.ravel() for grid in np.meshgrid(_SENSES, _SENSES[:19]))
    F = np.stack((np.sin(phi), np.sin(phi - theta), np.cos(phi)), axis=-1)
    closures = (frame.slit_closure(_FRACTIONS) @ F.T).max(axis=0)  # of the arm that closes first, (fractions, loads)
    most = closures.max(axis=0)
    near = most > SMALLEST_CLOSURE * most.max()
    closures, most = closures[:, near], most[near]
    chosen = [int(np.argmax(closures.max(axis=1)))]
    while len(chosen) < len(_FRACTIONS):
        late = 1.0 - closures[chosen].max(axis=0) / most
        if late.max() < CLOSE_ENOUGH:
            break
        chosen.append(int(np.argmax(closures[:, int(np.argmax(late))])))
    fractions: FloatArray = _FRACTIONS[np.sort(chosen)]
    return fractions


def _held_beam(xi: FloatArray) -> FloatArray:
    """Deflection at one place per unit force at another, (k, k), of a beam with held ends: times E I / length^3."""
    x, y = np.minimum.outer(xi, xi), np.maximum.outer(xi, xi)
    bend: FloatArray = x**2 * (1.0 - y) ** 2 * (3.0 * y - x - 2.0 * x * y) / 6.0
    return bend
