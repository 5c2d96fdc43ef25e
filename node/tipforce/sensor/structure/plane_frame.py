"""A plane frame by the direct stiffness method: fixture, joint and tip are rigid, the vertical beam and both arms
elastic. x to the right, y away from the fixture; tension is positive. EULER_BERNOULLI equals Table 1 to rounding. The
unknowns are the motions of the joint relative to the fixture and of the tip relative to the joint: no stiffness is
added to a far smaller one, and with diagonal scaling a body of 1 nm thickness is solved to rounding."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.layouts import POINTS
from tipforce.sensor.structure.quality import stress_coefficients
from tipforce.sensor.structure.strain import Gauge, Geometry, place

HALF_PLANE_ROTATION = 18.0 / math.pi
"""E b h^2 times the rotation of a root per moment, for a beam on an elastic half plane. A moment M enters as the linear
traction 12 M y / h^3; Flamant's solution gives the surface's displacement -(2 / pi E) integral p(y') ln|y - y'| dy',
whose mean slope, weighted by the traction, is 18 / (pi E b h^2) M (plane stress): a beam that is 0.48 h longer."""


SHEAR_COEFFICIENT = 5.0 / 6.0
"""Timoshenko's kappa of a rectangle; Cowper's 10 (1 + nu) / (12 + 11 nu) is 0.849."""
POISSON_RATIO = 0.29
"""Of steel; an assumption, not in the paper."""


@dataclass(frozen=True, slots=True)
class FrameModel:
    """Assumptions on the beams, their roots and the joint."""

    shear: bool = False
    """True: Timoshenko beams, with shear deformation. False: Euler-Bernoulli."""
    root_rotation: float = 0.0
    """E b h^2 times rotation per moment of each of the six beam ends; 0: rigid, HALF_PLANE_ROTATION: a large wall."""
    finite_joint: bool = False
    """True: the joint is a rigid block h2 wide with the arms at its sides. False: they meet at its middle (Table 1)."""


EULER_BERNOULLI = FrameModel()
"""The assumptions of Table 1."""
TIMOSHENKO = FrameModel(shear=True)
ELASTIC_ROOTS = FrameModel(shear=True, root_rotation=HALF_PLANE_ROTATION)
"""Shear and roots that rotate: the closest of the three to a real body."""


class _Element(NamedTuple):
    """One beam between its ends A and B, lengths in metres, for E = 1 and width = 1."""

    thickness: float
    start: FloatArray
    """End A, on the body nearer to the fixture, (2,)."""
    length: float
    axes: FloatArray
    """Rows: direction from A to B, and that turned by +90 degrees, (2, 2)."""
    stiffness: FloatArray
    """(6, 6), local axes: forces and moments at A and B per displacements and rotations."""
    motion: FloatArray
    """(3, 3): displacement of B in local axes per motion (u, v, rotation) of its body about the origin."""


class Frame:
    """Frame model of one body, solved once for F1 = 1, F2 = 1, F3 = 1 newton. Raises InputError for a body so thin or
    thick that floating point cannot represent its stiffness, or if a finite joint is wider than the horizontal beam."""

    def __init__(self, geometry: Geometry, model: FrameModel = EULER_BERNOULLI) -> None:
        self.geometry, self.model = geometry, model
        self._inner = 0.5 * geometry.h2_m if model.finite_joint else 0.0
        if self._inner >= geometry.a_m:
            raise InputError(f"h2_m = {geometry.h2_m!r}: a finite joint must be narrower than 2 a = {2 * geometry.a_m}")
        drop, a = 0.5 * geometry.h1_m, geometry.a_m
        self._vertical = _element((0.0, -drop - geometry.d_m), (0.0, -drop), geometry.h2_m, model)
        self._arms = {
            side: _element((sign * self._inner, 0.0), (sign * a, 0.0), geometry.h1_m, model)
            for side, sign in (("left", -1.0), ("right", 1.0))
        }
        # A force on the tip is the force and its moment about the origin; F = (Fy, M / r, Fx), equation (16).
        loads = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, geometry.r_m, 0.0]])
        # The joint carries the load of the tip: the loads of both blocks are equal.
        self._joint = _solve([self._vertical], loads)
        self._tip = _solve(list(self._arms.values()), loads)
        self._scale = geometry.width_m * geometry.youngs_modulus_pascals

    def strain_matrix(self, gauges: Sequence[Gauge], gauge_length_m: float = 0.0) -> FloatArray:
        """Return the strain per newton of F, (n, 3), tension positive, as the mean over gauge_length_m; K_H and S_H lie
        where their arms start. Raises InputError for a gauge that is unknown or not within its beam."""
        return np.array([self._row(gauge, gauge_length_m) for gauge in gauges], dtype=np.float64).reshape(-1, 3)

    def motions(self) -> tuple[FloatArray, FloatArray]:
        """Return the motions (3, 3) of tip to joint and of joint to fixture, per newton of F: (u_m, v_m, angle)."""
        return self._tip / self._scale, self._joint / self._scale

    def slit_closure(self, fractions: npt.ArrayLike) -> FloatArray:
        """Return the decrease of the slit width between tip and horizontal beam, m per newton of F, (2, m, 3).
        fractions: (m,) places along the left and the right arm, 0 at the joint, 1 at the tip."""
        xi = np.asarray(fractions, dtype=np.float64)[:, np.newaxis]
        closures = []
        for element in self._arms.values():
            x = element.start[0] + xi * element.length * element.axes[0, 0]
            tip = self._tip[1] + x * self._tip[2]
            # The upward deflection relative to the joint by Hermite's cubic, (m, 3) per newton: the small changes by
            # shear and springs between the ends are neglected.
            _, w, turn = element.motion @ self._tip
            shape = w * xi**2 * (3.0 - 2.0 * xi) + turn * element.length * xi**2 * (xi - 1.0)
            closures.append((shape * element.axes[0, 0] - tip) / self._scale)
        return np.stack(closures)

    def _row(self, gauge: Gauge, gauge_length_m: float) -> FloatArray:
        spot = place(self.geometry, gauge)
        if spot.beam == "H":
            element, motion = self._arms[spot.side], self._tip
            s = spot.position_m - self._inner
            outward = -1.0 if spot.face == "lower" else 1.0
            # Local y points up on the right arm, down on the left one, whose direction is -x.
            outward *= element.axes[0, 0]
        else:
            element, motion = self._vertical, self._joint
            s = self.geometry.d_m - spot.position_m
            outward = 1.0 if spot.side == "left" else -1.0
        if gauge in POINTS:
            s = element.length if s > 0.5 * element.length else 0.0
        half, slack = 0.5 * gauge_length_m, 1e-6 * element.length  # tolerance for an optimiser at a limit
        if not -slack <= s - half <= s + half <= element.length + slack:
            raise InputError(
                f"gauge of length {gauge_length_m!r} m at {spot.position_m!r} m on the {spot.side} of beam {spot.beam}"
                f": allowed is a gauge that lies between the beam's ends, {element.length!r} m apart"
            )
        ends = s - half, s + half  # as distances from A
        row: FloatArray = np.mean([_surface_strain(element, motion, end, outward) for end in ends], axis=0)
        return row / self._scale


def _solve(elements: list[_Element], loads: FloatArray) -> FloatArray:
    """Return the motion (u, v, rotation) of a body per newton of three loads, (3, 3), for E = 1 and width = 1."""
    stiffness = np.sum([e.motion.T @ e.stiffness[3:, 3:] @ e.motion for e in elements], axis=0)
    diagonal = np.diagonal(stiffness)
    if not (np.isfinite(stiffness).all() and (diagonal > 1e-300).all()):
        raise InputError(f"stiffness {diagonal.tolist()}: the body is too thin or too thick for floating point")
    root = np.sqrt(diagonal)
    scaled = stiffness / root[:, np.newaxis] / root
    motion: FloatArray = np.linalg.solve(scaled, loads / root[:, np.newaxis]) / root[:, np.newaxis]
    return motion


def _element(start: tuple[float, float], end: tuple[float, float], thickness: float, model: FrameModel) -> _Element:
    a, b = np.array(start), np.array(end)
    length = float(np.hypot(*(b - a)))
    if not 0.0 < length < math.inf:
        raise InputError(f"a beam of length {length!r} m: the body is too thick for floating point")
    c, s = (b - a) / length
    axes = np.array([[c, s], [-s, c]])
    turn = np.zeros((3, 3))
    turn[:2, :2], turn[2, 2] = axes, 1.0
    rigid_link = np.array([[1.0, 0.0, -b[1]], [0.0, 1.0, b[0]], [0.0, 0.0, 1.0]])
    stiffness = _stiffness(length, thickness, model)
    if model.root_rotation:  # springs in series at both ends: f = K (u - C f), so f = (I + K C)^-1 K u
        springs = np.array([0.0, 0.0, model.root_rotation / thickness / thickness] * 2)
        stiffness = np.linalg.solve(np.eye(6) + stiffness * springs, stiffness)
    return _Element(thickness, a, length, axes, stiffness, turn @ rigid_link)


def _stiffness(length: float, thickness: float, model: FrameModel) -> FloatArray:
    """Return the 6 x 6 stiffness matrix of a beam if E = width = 1 (Przemieniecki, Matrix Structural Analysis, 5.6)."""
    h, L = thickness, length
    shear_modulus = 0.5 / (1.0 + POISSON_RATIO)
    slender = h / L
    Phi = slender * slender / (shear_modulus * SHEAR_COEFFICIENT) if model.shear else 0.0
    k = slender * slender * slender / (12.0 * (1.0 + Phi))
    bend = k * np.array([
        [12.0, 6.0 * L, -12.0, 6.0 * L],
        [6.0 * L, (4.0 + Phi) * L * L, -6.0 * L, (2.0 - Phi) * L * L],
        [-12.0, -6.0 * L, 12.0, -6.0 * L],
        [6.0 * L, (2.0 - Phi) * L * L, -6.0 * L, (4.0 + Phi) * L * L],
    ])  # fmt: skip
    K = np.zeros((6, 6))
    K[np.ix_([0, 3], [0, 3])] = slender * np.array([[1.0, -1.0], [-1.0, 1.0]])
    K[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])] = bend
    return K


def _surface_strain(element: _Element, motion: FloatArray, s: float, outward: float) -> FloatArray:
    """Return strain (3,) per newton at distance s from A, on the face at local y = outward * thickness / 2."""
    forces = element.stiffness[:, 3:] @ (element.motion @ motion)
    h = element.thickness
    fraction = s / element.length
    bending = -(1.0 - fraction) * forces[2] + fraction * forces[5]
    strain: FloatArray = forces[3] / h - outward * 6.0 / h / h * bending
    return strain


# --- the loads that a body stands ---------------------------------------------------------------------------------
# The figure of the cross-section is not in the paper's text. Assumed: the slit, 0.25 mm wide as the cut, runs along the
# upper face of the horizontal beam, between the joint and the tip's ends.

AnyArray = npt.NDArray[Any]
"""Real, or complex for a complex step."""
PAPER_SLIT_M = 0.25e-3
_ROUNDING = 1e-12


def worst_stress(geometry: Geometry, load_newtons: float) -> float:
    """Return the largest stress on the beams in Pa, over all directions phi and contacts 0 to 180 degrees. F2 reaches
    +-P for any phi, and phi + pi turns every sign: the maximum of |g . F| is P (hypot(g1, g3) + |g2|)."""
    largest = max(math.hypot(g1, g3) + abs(g2) for g1, g2, g3 in stress_coefficients(geometry).values())
    return largest * load_newtons / geometry.width_m


def slit_closure(geometry: Geometry, load_newtons: float) -> float:
    """Return the most by which a load narrows the slit in metres, over the same loads (EULER_BERNOULLI)."""
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
    Raises InputError for angles that are not finite, or a gap that is not above 0."""
    if not (math.isfinite(theta_rad) and math.isfinite(phi_rad) and 0.0 < gap_m < math.inf):
        raise InputError(
            f"theta_rad = {theta_rad!r}, phi_rad = {phi_rad!r}, gap_m = {gap_m!r}: allowed are finite angles "
            "and a gap above 0"
        )
    F = np.array([math.sin(phi_rad), math.sin(phi_rad - theta_rad), math.cos(phi_rad)])
    frame = Frame(geometry)
    most = _largest(frame, F)
    return gap_m / most if most > _ROUNDING * _largest(frame, np.array([-1.0, 0.0, 0.0])) else math.inf


def _largest(frame: Frame, F: FloatArray) -> float:
    """The largest closure of an arm under F (3,), metres: of a cubic, at an end or where its slope is zero."""
    at, largest = np.array([0.0, 1.0, 2.0, 3.0]) / 3.0, -math.inf
    for arm, values in enumerate(frame.slit_closure(at) @ F):
        cubic = np.linalg.solve(np.vander(at), values)
        turns = [float(root.real) for root in np.roots(np.polyder(cubic)) if abs(root.imag) < 1e-9]
        places = [0.0, 1.0, *(turn for turn in turns if 0.0 < turn < 1.0)]
        largest = max(largest, float((frame.slit_closure(places)[arm] @ F).max()))
    return largest
