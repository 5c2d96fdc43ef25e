"""The frame against Table 1 and closed forms for shear, roots and joint; the three-dimensional beam model beside it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import exp, pi, radians, sqrt

import numpy as np
import pytest
from numpy.polynomial import Legendre, Polynomial

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor import FABRICATED, Geometry, strain_matrix, strain_row
from tipforce.sensor.structure import off_axis, plane_frame
from tipforce.sensor.structure.layouts import POINTS
from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, EULER_BERNOULLI, TIMOSHENKO, Frame, FrameModel
from tipforce.sensor.structure.strain import GaugePosition, gauge_matrix, nominal_position, position_matrix

ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)
"""All dimensions different, so that no symbol can stand in for another."""
ROW = {point: index for index, point in enumerate(POINTS)}
Z_LOADS = off_axis.off_axis_wrenches(FABRICATED, np.radians(np.arange(0.0, 181.0, 5.0)))


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
def test_anywhere_along_the_beams(geometry: Geometry) -> None:
    a, d = geometry.a_m, geometry.d_m
    places = [
        *(GaugePosition("H", side, x * a, face) for side in ("left", "right") for face in ("lower", "upper")
          for x in (0.0, 0.2, 0.5, 1.0)),
        *(GaugePosition("V", side, x * d) for side in ("left", "right") for x in (0.0, 0.3, 1.0)),
    ]  # fmt: skip
    theory = np.array([strain_row(geometry, *place) for place in places])
    scale = np.abs(theory).max(axis=1, keepdims=True)
    np.testing.assert_allclose(Frame(geometry).strain_matrix(places) / scale, theory / scale, rtol=0, atol=1e-12)


def end_moments(geometry: Geometry, model: FrameModel) -> tuple[float, float]:
    """(joint, tip) end moment of an arm per newton of F2 and metre of r, E = b = 1: slope-deflection by hand."""
    h, inner = geometry.h1_m, 0.5 * geometry.h2_m if model.finite_joint else 0.0
    length = geometry.a_m - inner
    k = length / (6.0 * h**3 / 12.0)
    shear = (
        2.0 * (1.0 + plane_frame.POISSON_RATIO) / (plane_frame.SHEAR_COEFFICIENT * h * length) if model.shear else 0.0
    )
    spring = model.root_rotation / h**2
    # Rotation of the ends against the chord; the tip turns by 1 and lifts the arm's end by a.
    flexibility = np.array([[2 * k + shear + spring, shear - k], [shear - k, 2 * k + shear + spring]])
    chord = geometry.a_m / length
    joint, tip = np.linalg.solve(flexibility, [-chord, 1.0 - chord])
    force = -(joint + tip) / length
    total = 2.0 * (force * geometry.a_m + tip)  # what both arms take off the tip
    return joint / total, tip / total


@pytest.mark.parametrize(
    "model",
    [EULER_BERNOULLI, TIMOSHENKO, FrameModel(root_rotation=plane_frame.HALF_PLANE_ROTATION), ELASTIC_ROOTS,
     FrameModel(finite_joint=True), FrameModel(shear=True, root_rotation=20.0, finite_joint=True)],
)  # fmt: skip
@pytest.mark.parametrize("geometry", [FABRICATED, ODD, FABRICATED.thin(3e-3)])
def test_shear_roots_and_joint_by_slope_deflection(geometry: Geometry, model: FrameModel) -> None:
    found, table = Frame(geometry, model).strain_matrix(POINTS), strain_matrix(geometry, POINTS)
    joint, tip = end_moments(geometry, model)
    section = geometry.width_m * geometry.youngs_modulus_pascals * geometry.h1_m**2 / 6.0
    r = geometry.r_m
    assert found[ROW["S_H"], 1] == pytest.approx(-joint * r / section, rel=1e-9)
    assert found[ROW["R"], 1] == pytest.approx(tip * r / section, rel=1e-9, abs=1e-9 * r / section)
    for point in ("T", "U", "K_V", "S_V"):  # the vertical beam is statically determinate: nothing changes it
        np.testing.assert_allclose(found[ROW[point]], table[ROW[point]], rtol=1e-9)


def test_the_rotation_of_a_half_plane() -> None:
    # The double integral of x y ln|x - y| over [-1/2, 1/2]^2 is -1/16; times -(2/pi) 12^2 it is 18/pi.
    x, weight = (np.asarray(part) / 2 for part in np.polynomial.legendre.leggauss(500))

    def antiderivative(t: FloatArray) -> FloatArray:
        log = np.log(np.abs(t))
        result: FloatArray = x * (t * log - t) - t * t * (log / 2 - 0.25)
        return result

    integral = float(np.sum(weight * x * (antiderivative(x + 0.5) - antiderivative(x - 0.5))))
    assert integral == pytest.approx(-1 / 16, rel=1e-4)
    assert pytest.approx(-2 / pi * 144 * integral, rel=1e-4) == plane_frame.HALF_PLANE_ROTATION


def test_a_gauge_averages_over_its_length() -> None:
    frame = Frame(ODD, ELASTIC_ROOTS)
    for place in (GaugePosition("H", "left", 4e-3), GaugePosition("V", "right", 9e-3)):
        ends = [place._replace(position_m=place.position_m + shift) for shift in (-2e-3, 2e-3)]
        np.testing.assert_allclose(
            frame.strain_matrix([place], 4e-3)[0], frame.strain_matrix(ends).mean(axis=0), rtol=1e-12
        )


def test_the_slit_closes_as_beam_theory_says() -> None:
    for geometry in (FABRICATED, ODD):
        widest = geometry.r_m / (2.0 * geometry.a_m + 3.0 * geometry.r_m)
        closure = Frame(geometry).slit_closure([widest, *np.linspace(0.0, 1.0, 201)]) * 4.4
        worst = np.max(np.hypot(closure[..., 0], closure[..., 2]) + np.abs(closure[..., 1]))
        assert worst == pytest.approx(plane_frame.slit_closure(geometry, 4.4), rel=1e-9)
        np.testing.assert_allclose(closure[:, -1], 0.0, atol=1e-12 * worst)
    assert plane_frame.slit_closure(FABRICATED, 4.4) == pytest.approx(72.4e-6, rel=1e-3)


INSIDE, JOINT = Frame(FABRICATED).strain_matrix, FrameModel(finite_joint=True)
TWICE = ("U", GaugePosition("V", "right", FABRICATED.d_m), "L")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(INSIDE, ["X"]), "gauge point 'X' is not known"),
        (partial(INSIDE, ["K_H"], 1e-3), "allowed is a gauge that lies between the beam's ends"),
        (partial(INSIDE, [GaugePosition("H", "left", 14.9e-3)], 1e-3), "at 0.0149 m on the left of beam H"),
        (partial(INSIDE, [GaugePosition("V", "left", -1e-3)]), "allowed is a gauge that lies between"),
        (partial(INSIDE, ["K_H"], -1.0), "gauge of length -1.0 m"),
        (partial(INSIDE, ["K_H"], float("nan")), "gauge of length nan m"),
        (partial(Frame(FABRICATED, JOINT).strain_matrix, [GaugePosition("H", "left", 0.1e-3)]), "the beam's ends"),
        (partial(Frame, replace(FABRICATED, h2_m=0.04), JOINT), "a finite joint must be narrower"),
        (partial(gauge_matrix, FABRICATED, TWICE), "gauge point V right 15.00 is given more than once"),
        (partial(gauge_matrix, FABRICATED, ["U", "L"]), "a layout of 2 gauge points: allowed are 3 to 8"),
        (partial(gauge_matrix, FABRICATED, ["U", "L", GaugePosition("H", "right", float("nan"))]), "position_m"),
        (partial(off_axis.torsion_constants, 1.0, 1.1), "thickness"),
    ],
)
def test_what_cannot_be_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert message in str(caught.value)
    assert Frame(FABRICATED, JOINT).strain_matrix(["K_H"]).shape == (1, 3)


def test_gauge_matrix_mixes_points_and_places() -> None:
    place = GaugePosition("V", "right", 7e-3)
    A = gauge_matrix(FABRICATED, ["K_H", place, "L"])
    assert np.array_equal(A[[0, 2]], strain_matrix(FABRICATED, POINTS)[[ROW["K_H"], ROW["L"]]])
    assert np.array_equal(A[1], strain_row(FABRICATED, *place))


def at(*points: str, z: float = 0.0, angle: float = 0.0, geometry: Geometry = FABRICATED) -> list[off_axis.PlacedGauge]:
    return [off_axis.PlacedGauge(nominal_position(geometry, point), z, angle) for point in points]


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
@pytest.mark.parametrize("warping_held", [False, True])
def test_planar_part_is_table_1_made_continuous(geometry: Geometry, warping_held: bool) -> None:
    between = [GaugePosition("H", "right", 4e-3, "upper"), GaugePosition("H", "left", 7e-3)]
    placed = [off_axis.PlacedGauge(place) for place in (*between, GaugePosition("V", "left", 5e-3))]
    placed += at(*POINTS, geometry=geometry)
    found = off_axis.planar_part(geometry, off_axis.wrench_strain_matrix(geometry, placed, warping_held=warping_held))
    expected = position_matrix(geometry, [gauge.position for gauge in placed])
    np.testing.assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())


def test_bending_along_z_by_hand() -> None:
    """The fixture end carries 1 N at the top of the tip with the whole lever."""
    z, E, b = 1e-3, FABRICATED.youngs_modulus_pascals, FABRICATED.width_m
    top = off_axis.off_axis_wrenches(FABRICATED, 0.5 * pi)
    side = off_axis.off_axis_wrenches(FABRICATED, 0.0)
    U, R = off_axis.wrench_strain_matrix(FABRICATED, at("U", "R", z=z))
    lever = FABRICATED.r_m + FABRICATED.d_m + 0.5 * FABRICATED.h1_m
    assert U @ top == pytest.approx(-lever * z * 12.0 / (E * FABRICATED.h2_m * b**3), rel=1e-12)
    inertia = FABRICATED.h1_m * b**3 / 12.0
    # Clamped and guided arms: Fz/2 bends their ends by Fz a / 4, My = -r bends the outer one by r / 4 as well.
    assert R @ side == pytest.approx(0.25 * (FABRICATED.a_m + FABRICATED.r_m) * z / (E * inertia), rel=1e-9)


def test_mirror_symmetry_about_the_middle_plane() -> None:
    """A gauge at -z, turned the other way, reads planar loads alike and loads out of the plane with opposite sign."""
    flip = np.array([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    for held in (False, True):
        one = off_axis.wrench_strain_matrix(ODD, at(*POINTS, z=8e-4, angle=0.1, geometry=ODD), warping_held=held)
        other = off_axis.wrench_strain_matrix(ODD, at(*POINTS, z=-8e-4, angle=-0.1, geometry=ODD), warping_held=held)
        np.testing.assert_allclose(one * flip, other, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    ("width", "J_factor", "W_factor"),
    [(1.0, 0.1406, 0.2082), (2.0, 0.2287, 0.2459), (10.0, 0.3123, 0.3123), (1000.0, 0.3331, 0.3331)],
)
def test_torsion_constants_of_textbooks(width: float, J_factor: float, W_factor: float) -> None:
    J, W = off_axis.torsion_constants(width, 1.0)
    assert J / width == pytest.approx(J_factor, abs=1e-4)
    assert W / width == pytest.approx(W_factor, abs=1e-4)


@pytest.mark.parametrize(
    ("error", "free", "held"),
    [({"misalignment_rad": radians(1.0)}, 0.0456, 0.0012), ({"lateral_offset_m": 1e-3}, 0.0300, 0.5705),
     ({"lateral_offset_m": 1e-4}, 0.0030, 0.05705)],
)  # fmt: skip
def test_a_misaligned_gauge_sees_free_warping_and_an_offset_one_held(
    error: dict[str, float], free: float, held: float
) -> None:
    for warping_held, expected in ((False, free), (True, held)):
        found = off_axis.apparent_force(FABRICATED, "I", Z_LOADS, warping_held=warping_held, **error)
        assert found.norm_newtons == pytest.approx(expected, rel=1e-3, abs=5e-5)


def test_free_middle_of_a_long_strip_is_st_venant() -> None:
    long = Geometry(0.5, 0.5, 0.015, 0.0004, 0.000653, 0.01, 205e9)
    gauge = [off_axis.PlacedGauge(GaugePosition("V", "right", 0.25), 1e-3, 0.05)]
    free, held = (off_axis.wrench_strain_matrix(long, gauge, warping_held=held)[0] for held in (False, True))
    np.testing.assert_allclose(held, free, rtol=1e-12)
    assert np.isfinite(off_axis.wrench_strain_matrix(Geometry(50.0, 50.0, 0.015, 1e-5, 1e-5, 1e-3, 205e9), gauge)).all()


def test_held_warping_against_a_plate() -> None:
    """A clamped strip as a Kirchhoff plate (Ritz, polynomials): stiffness and the mean strain of a 1 mm gauge."""
    L, b, nu, z = 15.0, 10.0, 0.29, 1.0
    decay, GJ = b * sqrt((1.0 + nu) / 24.0), 2.0 * (1.0 - nu) * b  # per plate stiffness D
    torque, strain = _twisted_plate(L, b, nu)
    assert torque == pytest.approx(GJ / (L - 2.0 * decay * np.tanh(0.5 * L / decay)), rel=0.03)
    s = np.linspace(0.0, 1.0, 41)
    mean = float(strain(s, z).mean()) / torque
    bent = (np.exp(-s / decay) - np.exp((s - L) / decay)) / (1.0 + exp(-L / decay)) / decay
    assert mean == pytest.approx(float(bent.mean()) * z / GJ, rel=0.12)


def _twisted_plate(L: float, b: float, nu: float) -> tuple[float, Callable[[FloatArray, float], FloatArray]]:
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

    def curvature(at_x: FloatArray, at_z: float) -> FloatArray:
        along: FloatArray = np.array([second(shape, 2, at_x, np.array([at_z]))[:, 0] for shape in basis])
        return c @ along

    xx, xz, zz = (np.array([second(shape, dx, x, z) for shape in basis]) for dx in (2, 1, 0))

    def inner(one: FloatArray, other: FloatArray) -> FloatArray:
        product: FloatArray = np.einsum("ixz,jxz,xz->ij", one, other, weight, optimize=True)
        return product

    K = inner(xx, xx) + inner(zz, zz) + nu * (inner(xx, zz) + inner(zz, xx)) + 2.0 * (1.0 - nu) * inner(xz, xz)
    c = np.concatenate([[1.0], np.linalg.solve(K[1:, 1:], -K[1:, 0])])
    return float(c @ K @ c), curvature
