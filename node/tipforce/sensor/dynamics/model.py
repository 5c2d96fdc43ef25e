"""The tip on its beams as an oscillator: masses, modes, and the transfer from force to readings. A rigid half cylinder
on massless beams has three modes, and all gauges measure one elastic force; with mass there are six. Coordinates y =
(v, r rotation, u), metres, conjugate to F; small motions, no gravity, an assumed damping ratio per mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.plane_frame import Frame
from tipforce.sensor.structure.strain import Geometry

STEEL_DENSITY = 7850.0
"""kg/m3, assumed: the paper does not state it."""
HIGHEST_DAMPING_RATIO = 1e6
LARGEST_RATIO_OF_3, LARGEST_RATIO_OF_6 = 1e16, 1e12
"""Of omega^2, highest to lowest mode. Three modes keep their digits up to it; of six the highest keep at least four."""


@dataclass(frozen=True, slots=True)
class RigidBody:
    """A body that moves in the plane. Raises InputError for physically impossible values."""

    mass_kg: float
    centroid_m: float
    """Height of the centre of mass above the origin, away from the fixture; on the y-axis."""
    inertia_kg_m2: float
    """About the origin, not about the centre of mass."""

    def __post_init__(self) -> None:
        if not 0.0 < self.mass_kg < math.inf:
            raise InputError(f"mass_kg = {self.mass_kg!r}: allowed is a positive finite number")
        least = self.mass_kg * self.centroid_m * self.centroid_m
        if not least < self.inertia_kg_m2 < math.inf:
            raise InputError(
                f"inertia_kg_m2 = {self.inertia_kg_m2!r} about the origin: allowed is more than mass times "
                f"centroid_m squared, {least!r}, and finite"
            )

    def matrix(self, r_m: float) -> FloatArray:
        """Return the mass matrix (3, 3) in the coordinates y, kg."""
        m, offset = self.mass_kg, self.centroid_m / r_m
        # A rotation by +rotation moves the centre of mass, above the origin, towards -x.
        return np.array([[m, 0.0, 0.0], [0.0, self.inertia_kg_m2 / r_m / r_m, -m * offset], [0.0, -m * offset, m]])


def half_cylinder(geometry: Geometry, density_kg_m3: float = STEEL_DENSITY) -> RigidBody:
    """Return the tip: a full half cylinder of radius r and the body's width, flat side through the origin."""
    r = geometry.r_m
    mass = density_kg_m3 * 0.5 * math.pi * r * r * geometry.width_m
    return RigidBody(mass, 4.0 * r / (3.0 * math.pi), 0.5 * mass * r * r)


@dataclass(frozen=True, slots=True)
class Modes:
    """A structure in its modes. n = 3 or 6. A modal position z is in units of its own static response. z'' / omega^2 +
    2 zeta z' / omega + z = load_shape F for every mode; the others follow from z."""

    omega_rad_s: FloatArray
    """(n,), lowest first."""
    damping_ratio: FloatArray
    """(n,), 0 is undamped, 1 critical."""
    load_shape: FloatArray
    """(n, 3): modal load per newton of F."""
    force_shape: FloatArray
    """(3, n): elastic force in the arms of the horizontal beam per modal position; their gauges measure it as F."""
    vertical_force_shape: FloatArray
    """(3, n): the same for the vertical beam. Equal to force_shape if joint and beams are massless."""

    @property
    def frequency_hz(self) -> FloatArray:
        """Undamped natural frequencies, (n,), lowest first."""
        return self.omega_rad_s / (2.0 * math.pi)

    def with_damping(self, damping_ratio: float | Sequence[float]) -> Modes:
        """Return the same modes with other damping. Raises InputError for ratios out of range."""
        zeta = _damping(damping_ratio, len(self.omega_rad_s))
        return Modes(self.omega_rad_s, zeta, self.load_shape, self.force_shape, self.vertical_force_shape)


def modes(
    geometry: Geometry,
    damping_ratio: float | Sequence[float] = 0.0,
    tip: RigidBody | None = None,
    joint: RigidBody | None = None,
    beam_density_kg_m3: float = 0.0,
) -> Modes:
    """Return the modes: 3 if joint and beams are massless, else 6. damping_ratio: one, or each, lowest first; tip:
    default half_cylinder(geometry); joint: a rigid block at the origin. Raises InputError."""
    if not 0.0 <= beam_density_kg_m3 < math.inf:
        raise InputError(f"beam_density_kg_m3 = {beam_density_kg_m3!r}: allowed is 0 (neglected) or more, finite")
    frame, r = Frame(geometry), geometry.r_m
    tip_mass = (tip or half_cylinder(geometry)).matrix(r)
    arms, vertical = compliances(frame)
    if joint is None and beam_density_kg_m3 == 0.0:
        omega, L, Q = _eigen(tip_mass, arms + vertical, geometry)
        load_shape, force_shape = np.linalg.solve(L, np.eye(3)).T @ Q, L @ Q
        return Modes(omega, _damping(damping_ratio, 3), load_shape.T, force_shape, force_shape)
    # Unknowns: the joint's motion and the tip's motion relative to it. Rigid motions about one origin add up.
    mass = np.block([[tip_mass, tip_mass], [tip_mass, tip_mass]])
    if joint is not None:
        mass[:3, :3] += joint.matrix(r)
    if beam_density_kg_m3 > 0.0:
        mass += beam_mass_matrix(geometry, beam_density_kg_m3)
    zero = np.zeros((3, 3))
    omega, L, Q = _eigen(mass, np.block([[vertical, zero], [zero, arms]]), geometry)
    shapes = np.linalg.solve(L.T, Q)
    force = L @ Q
    return Modes(omega, _damping(damping_ratio, 6), (shapes[:3] + shapes[3:]).T, force[3:], force[:3])


def compliances(frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Return the compliances (3, 3), m/N in the coordinates y, of the arms and of the vertical beam."""
    r = frame.geometry.r_m
    order = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, r], [1.0, 0.0, 0.0]])  # y from (u, v, rotation)
    arms, vertical = (order @ motion for motion in frame.motions())
    return 0.5 * (arms + arms.T), 0.5 * (vertical + vertical.T)


def _eigen(mass: FloatArray, compliance: FloatArray, geometry: Geometry) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return omega, and L, Q with mass = L L^T and L^T compliance L = Q diag(1 / omega^2) Q^T."""
    try:
        L = np.asarray(np.linalg.cholesky(mass), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise InputError("the masses do not form a positive definite matrix: allowed are bodies with mass") from None
    A = L.T @ compliance @ L
    if not np.isfinite(A).all():
        raise InputError(f"h1_m = {geometry.h1_m!r}, h2_m = {geometry.h2_m!r}: too thin, a compliance is not finite")
    values, Q = jacobi(0.5 * (A + A.T))
    limit = LARGEST_RATIO_OF_3 if len(mass) == 3 else LARGEST_RATIO_OF_6
    if not (values[-1] > 1e-300 and values[0] <= limit * values[-1]):
        raise InputError(
            f"h1_m = {geometry.h1_m!r}, h2_m = {geometry.h2_m!r}: omega^2 of the stiffest mode is more than {limit:g} "
            f"times that of the softest, too much for floating point with {len(mass)} modes; allowed is less"
        )
    return np.asarray(1.0 / np.sqrt(values), dtype=np.float64), L, Q


def _damping(damping_ratio: float | Sequence[float], n: int) -> FloatArray:
    zeta = np.array(damping_ratio, dtype=np.float64)
    if zeta.shape not in {(), (n,)}:
        raise InputError(f"damping_ratio has the shape {zeta.shape}: allowed is one number, or {n} for {n} modes")
    if not ((zeta >= 0.0) & (zeta <= HIGHEST_DAMPING_RATIO)).all():
        raise InputError(f"damping_ratio = {zeta.tolist()}: allowed is 0 to {HIGHEST_DAMPING_RATIO:g}")
    return np.broadcast_to(zeta, (n,)).copy()


def beam_mass_matrix(geometry: Geometry, density_kg_m3: float) -> FloatArray:
    """Return the mass matrix (6, 6), kg, for (motion of the joint, motion of the tip relative to it), each as y.
    Consistent masses of Hermite's cubic and linear stretch: shear, roots and rotatory inertia are neglected."""
    g = geometry
    total = np.zeros((6, 6))
    for sign in (-1.0, 1.0):
        local = _local_mass(g.a_m, g.h1_m * g.width_m * density_kg_m3)
        near = _end(g, (0.0, 0.0), (sign, 0.0))
        far = _end(g, (sign * g.a_m, 0.0), (sign, 0.0))
        ends = np.block([[near, np.zeros((3, 3))], [far, far]])
        total += ends.T @ local @ ends
    local = _local_mass(g.d_m, g.h2_m * g.width_m * density_kg_m3)
    on_joint = _end(g, (0.0, -0.5 * g.h1_m), (0.0, 1.0))
    total[:3, :3] += on_joint.T @ local[3:, 3:] @ on_joint
    return total


def _local_mass(length: float, mass_per_length: float) -> FloatArray:
    """Return rows along, across, rotation at either end (Przemieniecki, Theory of Matrix Structural Analysis, 11.3)."""
    L = length
    bend = np.array([
        [156.0, 22.0 * L, 54.0, -13.0 * L],
        [22.0 * L, 4.0 * L * L, 13.0 * L, -3.0 * L * L],
        [54.0, 13.0 * L, 156.0, -22.0 * L],
        [-13.0 * L, -3.0 * L * L, -22.0 * L, 4.0 * L * L],
    ])  # fmt: skip
    M = np.zeros((6, 6))
    M[np.ix_([0, 3], [0, 3])] = np.array([[140.0, 70.0], [70.0, 140.0]])
    M[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])] = bend
    return M * (mass_per_length * L / 420.0)


def _end(geometry: Geometry, place: tuple[float, float], direction: tuple[float, float]) -> FloatArray:
    """Return the local displacement (along, across, rotation) of a place per body motion y = (v, r rotation, u)."""
    (x, y), (c, s), r = place, direction, geometry.r_m
    u, v = np.array([0.0, -y / r, 1.0]), np.array([1.0, x / r, 0.0])
    return np.array([c * u + s * v, -s * u + c * v, [0.0, 1.0 / r, 0.0]])


_SWEEPS = 60


def jacobi(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (values (n,), vectors (n, n) as columns), largest first, by Jacobi's rotations: unlike numpy.linalg.eigh,
    small eigenvalues keep their digits (Demmel, Veselic 1992)."""
    A, Q = matrix.copy(), np.eye(len(matrix))
    pairs = [(i, j) for i in range(len(A)) for j in range(i + 1, len(A))]
    for _ in range(_SWEEPS):
        rotated = False
        for i, j in pairs:
            if abs(A[i, j]) > 1e-17 * math.sqrt(abs(A[i, i])) * math.sqrt(abs(A[j, j])):
                rotated = _rotate(A, Q, i, j) or rotated
        if not rotated:
            break
    order = np.argsort(-np.diagonal(A))
    return np.diagonal(A)[order], Q[:, order]


def _rotate(A: FloatArray, Q: FloatArray, i: int, j: int) -> bool:
    a, b, g = float(A[i, i]), float(A[j, j]), float(A[i, j])
    half = 0.5 * (b - a) / g
    tangent = math.copysign(1.0, half) / (abs(half) + math.hypot(1.0, half))
    c = 1.0 / math.hypot(1.0, tangent)
    s = tangent * c
    for M in (A.T, A, Q):  # rows, then columns: A.T is a view
        x, y = M[:, i].copy(), M[:, j].copy()
        M[:, i], M[:, j] = c * x - s * y, s * x + c * y
    # Set the exact diagonal: the products above would leave rounding of the larger entry in the smaller.
    A[i, i], A[j, j] = a - tangent * g, b + tangent * g
    A[i, j] = A[j, i] = 0.0
    return a != A[i, i] or b != A[j, j] or abs(tangent) > 1e-16
