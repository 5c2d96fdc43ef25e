"""The slit between tip and horizontal beam as a stop: an overload closes it, and the structure is stiffer from there.

The figure of the cross-section is not in the paper's text. Assumed: the slit, 0.25 mm wide as the cut, runs along the
upper face of the horizontal beam, and closes at one place on each arm, that which the worst load closes first:
x = r / (2 a + 3 r) from the joint as a fraction of the arm. The tip is rigid; the arm yields where it is pressed, as a
beam with held ends; the contact has a stiffness of its own. The force between tip and arm is an inner one: fixture
and vertical beam feel the applied force alone, the gauges of the arms do not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.design.figures_of_merit import PAPER_SLIT_M
from tipforce.sensor.dynamics.model import Modes, compliances
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.plane_frame import EULER_BERNOULLI, Frame, FrameModel

STOP_STIFFNESS = 1e7
"""N/m of the contact alone, assumed; the arm behind it is softer (in the fabricated body 2.4e6 N/m)."""


class SlitStop(NamedTuple):
    """Two contacts, left and right arm, in terms of the elastic force of the open structure."""

    closure_per_newton: FloatArray
    """(2, 3): how far the slit has closed per newton of elastic force in the arms, m/N."""
    gap_m: float
    compliance: FloatArray
    """(2, 2): metres per newton of stop force, the tip held."""
    arms_per_newton: FloatArray
    """(3, 2): what stop forces add to the elastic force in the arms."""
    vertical_per_newton: FloatArray
    """(3, 2): and in the vertical beam."""


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
    xi = g.r_m / (2.0 * g.a_m + 3.0 * g.r_m)
    s = frame.slit_closure([xi])[:, 0]
    bending = g.youngs_modulus_pascals * g.width_m * g.h1_m**3 / 12.0
    own = (g.a_m * xi * (1.0 - xi)) ** 3 / (3.0 * bending) + 1.0 / stiffness
    if len(modes.omega_rad_s) > 3:
        # The joint's motion is a state: a stop force acts on the tip's motion relative to it, nothing in between.
        return SlitStop(s, gap_m, own * np.eye(2), np.zeros((3, 2)), np.zeros((3, 2)))
    arms, vertical = compliances(frame)
    arm_stiffness, stiffness_of_both = np.linalg.inv(arms), np.linalg.inv(arms + vertical)
    behind = s @ (arm_stiffness - stiffness_of_both) @ s.T
    return SlitStop(
        s, gap_m, own * np.eye(2) + 0.5 * (behind + behind.T),
        (stiffness_of_both - arm_stiffness) @ s.T, stiffness_of_both @ s.T,
    )  # fmt: skip


def closing_load(geometry: Geometry, theta_rad: float, phi_rad: float, gap_m: float = PAPER_SLIT_M) -> float:
    """Return the static load P in newtons that closes the slit; inf where the load opens it on both arms."""
    x = geometry.r_m / (2.0 * geometry.a_m + 3.0 * geometry.r_m)
    closure = Frame(geometry).slit_closure([x])[:, 0]
    F = np.array([math.sin(phi_rad), math.sin(phi_rad - theta_rad), math.cos(phi_rad)])
    most = float((closure @ F).max())
    return gap_m / most if most > 0.0 else math.inf
