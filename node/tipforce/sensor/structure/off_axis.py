"""Loads out of the plane by a three-dimensional beam model (section 3.3 of the paper). x along the horizontal beam, y
from fixture to tip, z along the width; origin in the middle. Rigid tip and joint; Euler-Bernoulli bending, axial force,
St Venant's torsion with warping free, or (Vlasov) restrained at every end: its shear then gives way to an axial strain
y z phi''. Neglected: shear, corners."""

import itertools
from math import cos, exp, pi, sin, sqrt, tanh
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.structure.layouts import Layout, layout
from tipforce.sensor.structure.plane_frame import POISSON_RATIO
from tipforce.sensor.structure.strain import GaugePosition, Geometry, nominal_position


class PlacedGauge(NamedTuple):
    """One gauge with its placement errors."""

    position: GaugePosition
    lateral_offset_m: float = 0.0
    """Off the centre line of the beam, along z."""
    misalignment_rad: float = 0.0
    """From the axis of the beam (x or y) towards z."""


class ApparentForce(NamedTuple):
    """Apparent force per newton of an unwanted load: components of F, all from the worst signs and angle."""

    P_newtons: float
    """Largest hypot(F1, F3)."""
    F2_newtons: float
    """Largest |F2|."""
    norm_newtons: float
    """Largest |F|."""


class _Section:
    """Stiffnesses of one beam. thickness_m lies in the plane of the sensor, width along z."""

    def __init__(self, geometry: Geometry, length_m: float, h: float, warping_held: bool) -> None:
        self.length_m, self.thickness_m, self.width_m = length_m, h, geometry.width_m
        b, E = geometry.width_m, geometry.youngs_modulus_pascals
        G = 0.5 * E / (1.0 + POISSON_RATIO)
        J, W = torsion_constants(b, h)
        self.axial = E * b * h  # newtons
        self.bend_in_plane, self.bend_out_of_plane = E * b * h**3 / 12.0, E * h * b**3 / 12.0  # N m^2
        self.twist = G * J  # N m^2
        self.surface_shear = 1.0 / (G * W)  # largest shear strain on the wide face per newton metre of torque
        # sqrt(E Cw / G J): decay length of restrained warping; 0 if warping is free.
        self.decay_m = sqrt(E * (b * h) ** 3 / 144.0 / (G * J)) if warping_held else 0.0
        self._centre_shear = 1.5 / (G * b * h)

    def lateral_shear(self, z: float) -> float:
        """Return the shear strain on the face per newton along z: a parabola over the width."""
        return self._centre_shear * (1.0 - (2.0 * z / self.width_m) ** 2)

    def torsion_profile(self, s: float) -> tuple[float, float]:
        """Return (phi' G J / T, its derivative along s) at s from one end; warping is restrained at both ends."""
        if self.decay_m == 0.0:
            return 1.0, 0.0
        # Decaying exponentials from both ends: cosh of a long beam would overflow.
        near, far = exp(-s / self.decay_m), exp((s - self.length_m) / self.decay_m)
        both = 1.0 + exp(-self.length_m / self.decay_m)
        return 1.0 - (near + far) / both, (near - far) / both / self.decay_m


def torsion_constants(width_m: float, thickness_m: float) -> tuple[float, float]:
    """Return (J, W) of a rectangle, m^4, m^3 (St Venant). Raises InputError where thickness is not the smaller side."""
    if not 0.0 < thickness_m <= width_m:
        raise InputError(f"thickness {thickness_m!r} m of a beam {width_m!r} m wide: allowed is above 0, up to it")
    slenderness = width_m / thickness_m
    odd = range(1, 40, 2)
    stiff = sum(tanh(0.5 * n * pi * slenderness) / n**5 for n in odd)
    J = width_m * thickness_m**3 / 3.0 * (1.0 - 192.0 / pi**5 / slenderness * stiff)
    decays = ((n, exp(-0.5 * n * pi * slenderness)) for n in odd)
    shear = 1.0 - 8.0 / pi**2 * sum(2.0 * e / (1.0 + e * e) / n**2 for n, e in decays)
    return J, J / (thickness_m * shear)


def wrench_strain_matrix(geometry: Geometry, gauges: list[PlacedGauge], *, warping_held: bool = False) -> FloatArray:
    """Return the strain per unit of a wrench on the tip, (n, 6), tension positive: (Fx, Fy, Fz, Mx, My, Mz) about the
    origin, N and N m. Raises InputError for a beam that is thicker than wide."""
    horizontal = _Section(geometry, geometry.a_m, geometry.h1_m, warping_held)
    vertical = _Section(geometry, geometry.d_m, geometry.h2_m, warping_held)
    arms = _arm_loads(horizontal)
    rows = []
    for gauge in gauges:
        if gauge.position.beam == "H":
            strain, shear = _on_arm(horizontal, arms, gauge)
        else:
            strain, shear = _on_stem(geometry, vertical, gauge)
        c, s = cos(gauge.misalignment_rad), sin(gauge.misalignment_rad)
        rows.append(strain * (c * c - POISSON_RATIO * s * s) + shear * (s * c))
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def planar_part(geometry: Geometry, wrench_matrix: FloatArray) -> FloatArray:
    """Return the part of the (n, 6) matrix for F = (F1, F2, F3): (n, 3). F1 = Fy, F2 = Mz / r, F3 = Fx."""
    return np.ascontiguousarray(wrench_matrix[:, [1, 5, 0]] * [1.0, geometry.r_m, 1.0])


def off_axis_wrenches(geometry: Geometry, theta_rad: npt.ArrayLike) -> FloatArray:
    """Return the wrenches of 1 N along z at the contact angles theta, shape (..., 6)."""
    theta = floats("theta", theta_rad)
    zero, one = np.zeros_like(theta), np.ones_like(theta)
    r = geometry.r_m
    return np.stack((zero, zero, one, r * np.sin(theta), -r * np.cos(theta), zero), axis=-1)


def off_centre_wrenches(phi_rad: npt.ArrayLike, z_m: float) -> FloatArray:
    """Return the addition to the planar wrench by 1 N in the plane, applied z_m off the middle plane: (..., 6)."""
    phi = floats("phi", phi_rad)
    zero = np.zeros_like(phi)
    return np.stack((zero, zero, zero, -z_m * np.sin(phi), z_m * np.cos(phi), zero), axis=-1)


def apparent_force(
    geometry: Geometry,
    gauges: Layout,
    wrenches: FloatArray,
    *,
    lateral_offset_m: float = 0.0,
    misalignment_rad: float = 0.0,
    warping_held: bool = False,
    inward_m: float = 0.0,
) -> ApparentForce:
    """Return the worst force that a planar calibration computes from unwanted wrenches (m, 6), with gauges misplaced at
    worst signs and calibrated there. inward_m: of their middles from the fixed ends. Raises InputError."""
    nominal = [nominal_position(geometry, point) for point in layout(gauges)]
    places = [place._replace(position_m=abs(place.position_m - inward_m)) for place in nominal]
    wrenches = np.atleast_2d(floats("wrenches", wrenches))
    if wrenches.ndim != 2 or wrenches.shape[1] != 6 or not len(wrenches):
        raise InputError(f"wrenches have the shape {wrenches.shape}: allowed is (m, 6)")
    worst = np.zeros(3)
    for signs in itertools.product((-1.0, 1.0), repeat=len(places)):
        errors = ((sign * lateral_offset_m, sign * misalignment_rad) for sign in signs)
        placed = [PlacedGauge(place, *error) for place, error in zip(places, errors, strict=True)]
        matrix = wrench_strain_matrix(geometry, placed, warping_held=warping_held)
        F = wrenches @ matrix.T @ np.linalg.pinv(planar_part(geometry, matrix)).T
        found = (np.hypot(F[:, 0], F[:, 2]).max(), np.abs(F[:, 1]).max(), np.linalg.norm(F, axis=1).max())
        worst = np.maximum(worst, found)
    return ApparentForce(*(float(value) for value in worst))


def _arm_loads(beam: _Section) -> dict[str, FloatArray]:
    """Return per arm the (6, 6) map from a wrench on the tip to its load: two springs in parallel."""
    L, in_plane, out = beam.length_m, beam.bend_in_plane, beam.bend_out_of_plane
    # Restrained warping stiffens the ends: what is left twists freely.
    held = 2.0 * beam.decay_m * tanh(0.5 * L / beam.decay_m) if beam.decay_m else 0.0
    twist = (L - held) / beam.twist
    diagonal = [L / beam.axial, L**3 / 3 / in_plane, L**3 / 3 / out, twist, L / out, L / in_plane]
    stiffness, transform = {}, {}
    for side, sign in (("left", -1.0), ("right", 1.0)):
        flexibility = np.diag(diagonal)
        flexibility[1, 5] = flexibility[5, 1] = 0.5 * sign * L * L / in_plane
        flexibility[2, 4] = flexibility[4, 2] = -0.5 * sign * L * L / out
        stiffness[side] = np.linalg.inv(flexibility)
        # A rotation of the tip moves the arm's end at (sign L, 0, 0): theta x p.
        transform[side] = np.eye(6)
        transform[side][1, 5], transform[side][2, 4] = sign * L, -sign * L
    total = sum(transform[side].T @ stiffness[side] @ transform[side] for side in transform)
    motion = np.linalg.inv(np.asarray(total))
    return {side: stiffness[side] @ transform[side] @ motion for side in transform}


def _on_arm(beam: _Section, arms: dict[str, FloatArray], gauge: PlacedGauge) -> tuple[FloatArray, FloatArray]:
    """Return (axial strain, shear strain xz) per unit of wrench, (6,) each, on a face of the horizontal beam."""
    side, s, z = gauge.position.side, gauge.position.position_m, gauge.lateral_offset_m
    sign = -1.0 if side == "left" else 1.0
    y = -0.5 * beam.thickness_m if gauge.position.face == "lower" else 0.5 * beam.thickness_m
    Fx, Fy, Fz, Mx, My, Mz = arms[side]
    lever = sign * (beam.length_m - s)
    My, Mz = My - lever * Fz, Mz + lever * Fy
    straight, bent = beam.torsion_profile(s)
    strain = sign * (Fx / beam.axial + My * (z / beam.bend_out_of_plane) - Mz * (y / beam.bend_in_plane))
    strain = strain + Mx * (y * z * bent / beam.twist)
    shear = sign * (Fz * beam.lateral_shear(z) + np.sign(y) * straight * beam.surface_shear * Mx)
    return strain, shear


def _on_stem(geometry: Geometry, beam: _Section, gauge: PlacedGauge) -> tuple[FloatArray, FloatArray]:
    """Return (axial strain, shear strain yz) per unit of wrench, (6,) each, on a face of the vertical beam."""
    s, z = gauge.position.position_m, gauge.lateral_offset_m
    x = -0.5 * beam.thickness_m if gauge.position.side == "left" else 0.5 * beam.thickness_m
    Fx, Fy, Fz, Mx, My, Mz = np.eye(6)
    lever = 0.5 * geometry.h1_m + s
    Mx, Mz = Mx + lever * Fz, Mz - lever * Fx
    straight, bent = beam.torsion_profile(s)
    strain = Fy / beam.axial - Mx * (z / beam.bend_out_of_plane) + Mz * (x / beam.bend_in_plane)
    strain = strain + My * (x * z * bent / beam.twist)
    shear = Fz * beam.lateral_shear(z) - np.sign(x) * straight * beam.surface_shear * My
    return strain, shear
