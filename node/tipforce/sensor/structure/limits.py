"""The loads that a body stands: the largest stress by beam theory, and the load that closes the slit.

The figure of the cross-section is not in the paper's text. Assumed: the slit, 0.25 mm wide as the cut, runs along the
upper face of the horizontal beam, between the joint and the tip's ends.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.plane_frame import Frame
from tipforce.sensor.structure.strain import stress_coefficients

AnyArray = npt.NDArray[Any]
"""Real, or complex for a complex step."""

PAPER_SLIT_M = 0.25e-3
_ROUNDING = 1e-12


def worst_stress(geometry: Geometry, load_newtons: float) -> float:
    """Return the largest stress anywhere on the beams in Pa, over all directions phi and contacts 0 to 180 degrees.

    For any phi the contacts reach F2 = +-P, and phi + pi turns every sign: the maximum of |g . F| is
    P (hypot(g1, g3) + |g2|), on either face.
    """
    largest = max(math.hypot(g1, g3) + abs(g2) for g1, g2, g3 in stress_coefficients(geometry).values())
    return largest * load_newtons / geometry.width_m


def slit_closure(geometry: Geometry, load_newtons: float) -> float:
    """Return the most by which a load narrows the slit above the horizontal beam in metres, over the same loads.

    The slit is assumed to run along the beam's upper face, between the joint and the tip's ends (the paper
    gives its width, 0.25 mm; the figure is not in its text). Rigid tip and joint, Euler-Bernoulli.
    """
    closure = float(slit_compliance(np.asarray(geometry.a_m), np.asarray(geometry.r_m), np.asarray(geometry.h1_m)))
    return closure * load_newtons / (geometry.width_m * geometry.youngs_modulus_pascals)


def slit_compliance(a: AnyArray, r: AnyArray, h1: AnyArray) -> AnyArray:
    """Return E b times that closure per newton, at the place along an arm where it is largest; same shapes."""
    # F1 lifts the tip by a^3 / 24 EI against the joint, F2 rotates it by r a / 8 EI; I = h1^3 / 12. Their effects on
    # the slit at the fraction x of an arm have the largest sum at x = r / (2 a + 3 r).
    x = r / (2.0 * a + 3.0 * r)
    lift = 0.5 * a * (1.0 - x * x * (3.0 - 2.0 * x))
    turn = 1.5 * r * x * (1.0 - x) ** 2
    result: AnyArray = (lift + turn) * a * a / (h1 * h1 * h1)
    return result


def closing_load(geometry: Geometry, theta_rad: float, phi_rad: float, gap_m: float = PAPER_SLIT_M) -> float:
    """Return the static load P in newtons that closes the slit somewhere; inf where the load opens it everywhere.

    Raises InputError for angles that are not finite, or a gap that is not above 0.
    """
    if not (math.isfinite(theta_rad) and math.isfinite(phi_rad) and 0.0 < gap_m < math.inf):
        raise InputError(
            f"theta_rad = {theta_rad!r}, phi_rad = {phi_rad!r}, gap_m = {gap_m!r}: allowed are finite angles "
            "and a gap above 0"
        )
    F = np.array([math.sin(phi_rad), math.sin(phi_rad - theta_rad), math.cos(phi_rad)])
    most = float(_largest(Frame(geometry), F).max())
    return gap_m / most if most > _ROUNDING * _largest(Frame(geometry), np.array([-1.0, 0.0, 0.0])).max() else math.inf


def _largest(frame: Frame, F: FloatArray) -> FloatArray:
    """The largest closure of each arm under F (3,), (2,), metres: of a cubic, at an end or where its slope is zero."""
    at = np.array([0.0, 1.0, 2.0, 3.0]) / 3.0
    found = np.zeros(2)
    for arm, values in enumerate(frame.slit_closure(at) @ F):
        cubic = np.linalg.solve(np.vander(at), values)
        turns = [float(root.real) for root in np.roots(np.polyder(cubic)) if abs(root.imag) < 1e-9]
        places = [0.0, 1.0, *(turn for turn in turns if 0.0 < turn < 1.0)]
        found[arm] = (frame.slit_closure(places)[arm] @ F).max()
    return found
