"""The three-dimensional beam model: Table 1 in the plane, equilibrium, torsion constants, and a plate as a check."""

from __future__ import annotations

from collections.abc import Callable
from math import exp, pi, radians, sqrt

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import Legendre, Polynomial

from tipforce.errors import InputError
from tipforce.sensor.structure.gauges import GaugePosition, nominal_position, strain_row
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.layouts import POINTS
from tipforce.sensor.structure.off_axis import (
    PlacedGauge,
    apparent_force,
    off_axis_wrenches,
    off_centre_wrenches,
    planar_part,
    torsion_constants,
    wrench_strain_matrix,
)
from tipforce.sensor.structure.strain import strain_matrix

FloatArray = npt.NDArray[np.float64]

ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)
Z_LOADS = off_axis_wrenches(FABRICATED, np.radians(np.arange(0.0, 181.0, 5.0)))
OFF_CENTRE = off_centre_wrenches(np.radians(np.arange(0.0, 360.0, 5.0)), 1e-3)


def at(*points: str, z: float = 0.0, angle: float = 0.0, geometry: Geometry = FABRICATED) -> list[PlacedGauge]:
    return [PlacedGauge(nominal_position(geometry, point), z, angle) for point in points]


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
@pytest.mark.parametrize("warping_held", [False, True])
def test_planar_part_is_table_1(geometry: Geometry, warping_held: bool) -> None:
    found = wrench_strain_matrix(geometry, at(*POINTS, geometry=geometry), warping_held=warping_held)
    expected = strain_matrix(geometry, POINTS)
    np.testing.assert_allclose(planar_part(geometry, found), expected, atol=1e-13 * np.abs(expected).max())


def test_planar_part_between_the_points() -> None:
    places = [
        GaugePosition("H", "right", 4e-3, "upper"),
        GaugePosition("H", "left", 7e-3),
        GaugePosition("V", "left", 5e-3),
    ]
    found = planar_part(ODD, wrench_strain_matrix(ODD, [PlacedGauge(place) for place in places]))
    np.testing.assert_allclose(found, [strain_row(ODD, *place) for place in places], rtol=1e-9, atol=1e-14)


def test_centred_axial_gauges_see_nothing_out_of_the_plane() -> None:
    for held in (False, True):
        matrix = wrench_strain_matrix(FABRICATED, at(*POINTS), warping_held=held)
        assert np.abs(matrix[:, 2:5]).max() <= 1e-15 * np.abs(matrix).max()
        for loads in (Z_LOADS, OFF_CENTRE):
            assert apparent_force(FABRICATED, "I", loads, warping_held=held).norm_newtons < 1e-12


def test_bending_along_z_by_hand() -> None:
    """The fixture end carries 1 N at the top of the tip with the whole lever."""
    z, E, b = 1e-3, FABRICATED.youngs_modulus_pascals, FABRICATED.width_m
    top = off_axis_wrenches(FABRICATED, 0.5 * pi)
    side = off_axis_wrenches(FABRICATED, 0.0)
    U, R = wrench_strain_matrix(FABRICATED, at("U", "R", z=z))
    lever = FABRICATED.r_m + FABRICATED.d_m + 0.5 * FABRICATED.h1_m
    assert U @ top == pytest.approx(-lever * z * 12.0 / (E * FABRICATED.h2_m * b**3), rel=1e-12)
    inertia = FABRICATED.h1_m * b**3 / 12.0
    # Clamped and guided arms: Fz/2 bends their ends by Fz a / 4, My = -r bends the outer one by r / 4 as well.
    assert R @ side == pytest.approx(0.25 * (FABRICATED.a_m + FABRICATED.r_m) * z / (E * inertia), rel=1e-9)


def test_mirror_symmetry_about_the_middle_plane() -> None:
    """A gauge at -z, turned the other way, reads planar loads alike and loads out of the plane with opposite sign."""
    flip = np.array([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    for held in (False, True):
        one = wrench_strain_matrix(ODD, at(*POINTS, z=8e-4, angle=0.1, geometry=ODD), warping_held=held)
        other = wrench_strain_matrix(ODD, at(*POINTS, z=-8e-4, angle=-0.1, geometry=ODD), warping_held=held)
        np.testing.assert_allclose(one * flip, other, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    ("width", "J_factor", "W_factor"),
    [(1.0, 0.1406, 0.2082), (2.0, 0.2287, 0.2459), (10.0, 0.3123, 0.3123), (1000.0, 0.3331, 0.3331)],
)
def test_torsion_constants_of_textbooks(width: float, J_factor: float, W_factor: float) -> None:
    J, W = torsion_constants(width, 1.0)
    assert J / width == pytest.approx(J_factor, abs=1e-4)
    assert W / width == pytest.approx(W_factor, abs=1e-4)
    with pytest.raises(InputError, match="thickness"):
        torsion_constants(1.0, 1.1)


def test_misaligned_gauge_sees_the_shear_of_torsion_only_where_warping_is_free() -> None:
    free, held = (
        apparent_force(FABRICATED, "I", Z_LOADS, misalignment_rad=radians(1.0), warping_held=held).norm_newtons
        for held in (False, True)
    )
    assert free == pytest.approx(0.0456, abs=5e-5)
    assert held == pytest.approx(0.0012, abs=5e-5)


def test_offset_gauge_sees_held_warping() -> None:
    free, held = (
        apparent_force(FABRICATED, "I", Z_LOADS, lateral_offset_m=1e-3, warping_held=held).norm_newtons
        for held in (False, True)
    )
    assert free == pytest.approx(0.0300, abs=5e-5)
    assert held == pytest.approx(0.5705, abs=5e-4)
    tenth = apparent_force(FABRICATED, "I", Z_LOADS, lateral_offset_m=1e-4, warping_held=True).norm_newtons
    assert tenth == pytest.approx(0.1 * held, rel=1e-3)


def test_free_middle_of_a_long_strip_is_st_venant() -> None:
    long = Geometry(0.5, 0.5, 0.015, 0.0004, 0.000653, 0.01, 205e9)
    gauge = [PlacedGauge(GaugePosition("V", "right", 0.25), 1e-3, 0.05)]
    free, held = (wrench_strain_matrix(long, gauge, warping_held=held)[0] for held in (False, True))
    np.testing.assert_allclose(held, free, rtol=1e-12)
    assert np.isfinite(wrench_strain_matrix(Geometry(50.0, 50.0, 0.015, 1e-5, 1e-5, 1e-3, 205e9), gauge)).all()


def test_held_warping_against_a_plate() -> None:
    """A clamped strip as a Kirchhoff plate (Ritz, polynomials): stiffness and the mean strain of a 1 mm gauge."""
    L, b, nu, z = 15.0, 10.0, 0.29, 1.0
    decay, GJ = b * sqrt((1.0 + nu) / 24.0), 2.0 * (1.0 - nu) * b  # per plate stiffness D
    torque, strain = _twisted_plate(L, b, nu)
    assert torque == pytest.approx(GJ / (L - 2.0 * decay * np.tanh(0.5 * L / decay)), rel=0.03)
    mean = float(np.mean([strain(s, z) for s in np.linspace(0.0, 1.0, 41)])) / torque
    s = np.linspace(0.0, 1.0, 41)
    bent = (np.exp(-s / decay) - np.exp((s - L) / decay)) / (1.0 + exp(-L / decay)) / decay
    assert mean == pytest.approx(float(bent.mean()) * z / GJ, rel=0.12)


def _twisted_plate(L: float, b: float, nu: float) -> tuple[float, Callable[[float, float], float]]:
    """Torque per unit rotation of one end (over D), and the curvature w_xx at (x, z): both ends hold the warping."""
    points, weights = np.polynomial.legendre.leggauss(40)
    x, z = 0.5 * L * (points + 1.0), 0.5 * b * points
    weight = np.outer(weights * 0.5 * L, weights * 0.5 * b)
    clamped = Polynomial([0, 0, 1]) * Polynomial([1, -1]) ** 2
    shapes = [
        (clamped * Legendre.basis(i, domain=[0, 1]).convert(kind=Polynomial), j) for i in range(8) for j in (1, 3, 5, 7)
    ]
    basis = [(Polynomial([0, 0, 3, -2]), 1), *shapes]

    def second(shape: tuple[Polynomial, int], dx: int, xs: FloatArray, zs: FloatArray) -> FloatArray:
        dz, across = 2 - dx, Polynomial([0.0] * shape[1] + [1.0])
        along = shape[0].deriv(dx)(xs / L) / L**dx if dx else shape[0](xs / L)
        widths = across.deriv(dz)(2.0 * zs / b) if dz else across(2.0 * zs / b)
        product: FloatArray = np.outer(along, widths * (0.5 * b) ** (1 - dz))
        return product

    def curvature(at_x: float, at_z: float) -> float:
        return float(
            sum(k * second(s, 2, np.array([at_x]), np.array([at_z])) for k, s in zip(c, basis, strict=True))[0, 0]
        )

    xx, xz, zz = (np.array([second(shape, dx, x, z) for shape in basis]) for dx in (2, 1, 0))

    def inner(one: FloatArray, other: FloatArray) -> FloatArray:
        product: FloatArray = np.einsum("ixz,jxz,xz->ij", one, other, weight, optimize=True)
        return product

    K = inner(xx, xx) + inner(zz, zz) + nu * (inner(xx, zz) + inner(zz, xx)) + 2.0 * (1.0 - nu) * inner(xz, xz)
    c = np.concatenate([[1.0], np.linalg.solve(K[1:, 1:], -K[1:, 0])])
    return float(c @ K @ c), curvature
