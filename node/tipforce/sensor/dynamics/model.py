"""The tip on its beams as an oscillator: masses, modes, and how a force becomes what the gauges see.

Bodies: the tip is rigid, a half cylinder of steel, joined to the outer beam ends by rigid massless legs; the fixture
does not move. The joint is massless and so are the beams unless asked for: then the same force F passes both beams,
three modes remain, and all gauges see one elastic force. With a joint or beams that have mass there are six modes, the
joint's far above, and the gauges of the arms and of the vertical beam see different forces.

Coordinates are y = (v, r rotation, u): the motion that F = (F1, F2, F3) does work on, in metres. Small motions; no
gravity; damping is one ratio per mode, nothing that the paper measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.beam_mass import beam_mass_matrix
from tipforce.sensor.dynamics.eigen import jacobi
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.plane_frame import EULER_BERNOULLI, Frame, FrameModel

STEEL_DENSITY = 7850.0
"""kg/m3, assumed: the paper does not state it."""
HIGHEST_DAMPING_RATIO = 1e6
LARGEST_RATIO_OF_3, LARGEST_RATIO_OF_6 = 1e16, 1e12
"""Of omega^2, highest to lowest mode. Three modes keep their digits up to it; of six the highest keep four at least."""


@dataclass(frozen=True, slots=True)
class RigidBody:
    """A body that moves in the plane. Raises InputError for values that no body has."""

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
        # A turn by +rotation moves the centre of mass, above the origin, towards -x.
        return np.array(
            [[m, 0.0, 0.0], [0.0, self.inertia_kg_m2 / r_m / r_m, -m * offset], [0.0, -m * offset, m]],
        )


def half_cylinder(geometry: Geometry, density_kg_m3: float = STEEL_DENSITY) -> RigidBody:
    """Return the tip: a full half cylinder of radius r and the body's width, flat side through the origin."""
    r = geometry.r_m
    mass = density_kg_m3 * 0.5 * math.pi * r * r * geometry.width_m
    return RigidBody(mass, 4.0 * r / (3.0 * math.pi), 0.5 * mass * r * r)


@dataclass(frozen=True, slots=True)
class Modes:
    """A structure in its modes. n = 3 or 6. A modal position z is in units of its own static response.

    z'' / omega^2 + 2 zeta z' / omega + z = load_shape F for every mode; the others follow from z.
    """

    omega_rad_s: FloatArray
    """(n,), lowest first."""
    damping_ratio: FloatArray
    """(n,), 0 is undamped, 1 critical."""
    load_shape: FloatArray
    """(n, 3): modal load per newton of F."""
    force_shape: FloatArray
    """(3, n): elastic force in the arms of the horizontal beam per modal position; what their gauges see as F."""
    vertical_force_shape: FloatArray
    """(3, n): the same for the vertical beam. Equal to force_shape where joint and beams have no mass."""

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
    model: FrameModel = EULER_BERNOULLI,
) -> Modes:
    """Return the modes of one body: 3 where joint and beams are massless, else 6.

    damping_ratio: one for all modes or one for each, lowest first. tip: half_cylinder(geometry) if None. joint: a
    rigid block at the origin. beam_density_kg_m3: of the beams, 0 leaves their mass out. Raises InputError for a body
    whose stiffness or frequencies floating point cannot hold, a joint without mass beside massless beams, or damping
    ratios out of range or in wrong number.
    """
    if not 0.0 <= beam_density_kg_m3 < math.inf:
        raise InputError(f"beam_density_kg_m3 = {beam_density_kg_m3!r}: allowed is 0 (left out) or more, finite")
    frame, r = Frame(geometry, model), geometry.r_m
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
        mass += beam_mass_matrix(geometry, beam_density_kg_m3, model)
    zero = np.zeros((3, 3))
    omega, L, Q = _eigen(mass, np.block([[vertical, zero], [zero, arms]]), geometry)
    shapes = np.linalg.solve(L.T, Q)
    force = L @ Q
    return Modes(omega, _damping(damping_ratio, 6), (shapes[:3] + shapes[3:]).T, force[3:], force[:3])


def compliances(frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Return the compliance (3, 3), m/N in the coordinates y, of the arms and of the vertical beam: their sum is the
    tip's against the fixture.
    """
    r = frame.geometry.r_m
    order = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, r], [1.0, 0.0, 0.0]])  # y from (u, v, rotation)
    arms, vertical = order @ frame.tip_motion(), order @ frame.joint_motion()
    return 0.5 * (arms + arms.T), 0.5 * (vertical + vertical.T)


def _eigen(mass: FloatArray, compliance: FloatArray, geometry: Geometry) -> tuple[FloatArray, FloatArray, FloatArray]:
    """omega, and L, Q with mass = L L^T and L^T compliance L = Q diag(1 / omega^2) Q^T."""
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
