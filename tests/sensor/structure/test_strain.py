"""Table 1 against the paper's equations (2) to (15) and Figure 6; strain anywhere along the beams; what is refused."""

import itertools
from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from functools import partial
from math import cos, isnan, pi, sin

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure import quality, strain
from tipforce.sensor.structure.layouts import LAYOUTS, POINTS, layout, layout_code
from tipforce.sensor.structure.strain import FABRICATED, THIN_BEAM_RATIO, Geometry
from tipforce_lab.design.sections import most_influential, shift_to_reach, slopes_per_mm

ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)
"""All dimensions different, so that no symbol can stand in for another."""


def stresses_by_equations(geometry: Geometry, P: float, phi: float, theta: float) -> dict[str, float]:
    """Equations (2) to (15) one by one: unit width, the paper's signs."""
    a, d, r, h1, h2 = geometry.a_m, geometry.d_m, geometry.r_m, geometry.h1_m, geometry.h2_m
    Px, Py = P * cos(phi), P * sin(phi)
    Mx, My = Px * r * sin(theta), -Py * r * cos(theta)
    x = {
        "L": -3 * Mx / (2 * h1**2) - Px / (2 * h1),
        "K_H": 3 * Mx / h1**2 - Px / (2 * h1),
        "T": 6 / h2**2 * -Px * (d + r * sin(theta) + h1 / 2),
        "K_V": 6 / h2**2 * -Px * (r * sin(theta) + h1 / 2),
    }
    x |= {"R": -x["L"], "S_H": -x["K_H"], "U": -x["T"], "S_V": -x["K_V"]}
    y = {
        "L": -3 * Py * a / (2 * h1**2) - 3 * My / (2 * h1**2),
        "K_H": 3 * Py * a / (2 * h1**2) + 3 * My / h1**2,
        "T": -6 / h2**2 * My - Py / h2,
        "K_V": -6 / h2**2 * My - Py / h2,
        "R": -3 * Py * a / (2 * h1**2) + 3 * My / (2 * h1**2),
        "S_H": 3 * Py * a / (2 * h1**2) - 3 * My / h1**2,
        "U": 6 / h2**2 * My - Py / h2,
        "S_V": 6 / h2**2 * My - Py / h2,
    }
    return {point: x[point] + y[point] for point in POINTS}


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
def test_table_1_is_equations_2_to_15(geometry: Geometry) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        P, phi, theta = rng.uniform(0.1, 10), rng.uniform(-pi, pi), rng.uniform(0, pi)
        expected = stresses_by_equations(geometry, P, phi, theta)
        F = force_vector(P, phi, theta)
        for point, coefficients in quality.stress_coefficients(geometry).items():
            scale = P * max(abs(g) for g in coefficients)
            assert float(np.dot(coefficients, F)) == pytest.approx(expected[point], abs=1e-12 * scale), point


def test_thin_limit_is_the_scaled_strain_matrix() -> None:
    G = FABRICATED.thin(1e-9)
    unit = 1.5 * G.a_m / (G.h1_m**2 * G.width_m * G.youngs_modulus_pascals)
    np.testing.assert_allclose(strain.strain_matrix(G, POINTS) / unit, quality.thin_limit_matrix(POINTS), atol=1e-6)


def test_mirror_keeps_condition_number_and_sign() -> None:
    flip = np.diag([1.0, -1.0, -1.0])
    for triple in [*LAYOUTS.values(), *itertools.combinations(POINTS, 3)]:
        A, B = strain.strain_matrix(FABRICATED, triple), strain.strain_matrix(FABRICATED, quality.mirror(triple))
        np.testing.assert_allclose(B, A @ flip, rtol=1e-14)


def test_thin_beam_ratio_equalises_the_stresses() -> None:
    assert pytest.approx(1.633, abs=5e-4) == THIN_BEAM_RATIO
    thin = quality.thin_limit_matrix(("K_H", "S_H", "T", "U"))
    phi, theta = np.meshgrid(np.radians(np.arange(-180, 181)), np.radians(np.arange(0, 181)))
    largest = np.abs(thin @ force_vector(1.0, phi, theta).reshape(-1, 3).T).max(axis=1)
    assert largest == pytest.approx([3.0] * 4, rel=1e-3)


def test_geometry_is_frozen_and_has_a_thin_limit() -> None:
    with pytest.raises(FrozenInstanceError):
        FABRICATED.a_m = 1.0  # type: ignore[misc]
    thin = FABRICATED.thin(1e-6)
    assert thin.h2_m == THIN_BEAM_RATIO * 1e-6
    assert replace(thin, h1_m=FABRICATED.h1_m, h2_m=FABRICATED.h2_m) == FABRICATED
    with pytest.raises(InputError, match="h1_m"):
        FABRICATED.thin(0.0)


def test_named_layouts_and_their_mirrors() -> None:
    for name in ("I", "II", "III"):
        assert layout(name) == LAYOUTS[name]
        assert quality.mirror(name) == layout(name + "'")
        assert quality.mirror(quality.mirror(name)) == layout(name)


@pytest.mark.parametrize(
    ("gauges", "code"),
    [("I", 1), ("II", 2), ("III", 3), ("I'", 255), (["L", "R", "U"], 3), (["U", "R", "L"], 255), (POINTS, 255)],
)
def test_layout_codes(gauges: str | list[str], code: int) -> None:
    assert layout_code(gauges) == code


def test_shifts_are_inward() -> None:
    left = quality.shifted(ODD, "L", 1e-3)
    assert left == strain.GaugePosition("H", "left", left.position_m)
    assert left.position_m == pytest.approx(0.010)
    assert quality.shifted(ODD, "S_V", 1e-3) == strain.GaugePosition("V", "right", 1e-3)
    assert quality.shifted(ODD, strain.GaugePosition("V", "right", 0.016), 1e-3).position_m == pytest.approx(0.015)
    rows = quality.shifted_matrix(ODD, "III", [1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(rows[2], strain.strain_row(ODD, "V", "right", 0.014))
    assert quality.shifted_matrix(ODD, "III", np.zeros((4, 5, 3))).shape == (4, 5, 3, 3)
    np.testing.assert_allclose(
        quality.shifted_matrix(ODD, "III", 0.0), strain.strain_matrix(ODD, "III"), rtol=1e-14, atol=1e-14
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(layout, "IV"), "layout 'IV' is not known: allowed are I, II, III, I', II', III'"),
        (partial(layout, ("L", "R", "X")), "gauge point 'X' is not known: allowed are L, R, T, U, K_H, S_H, K_V, S_V"),
        (partial(layout, ("L", "R")), "a layout of 2 gauge points: allowed are 3 to 8"),
        (partial(quality.row_equilibrated_condition_number, [1, 2, 3]), "shape (3,): allowed are (n, 3)"),
        (partial(layout, ("L", "R", "U", "R")), "gauge point R is given more than once"),
        (partial(layout, (*POINTS, "L")), "a layout of 9 gauge points: allowed are 3 to 8"),
        (partial(strain.strain_row, FABRICATED, "H", "left", 0.0151), "allowed is 0 to 0.015"),
        (partial(strain.strain_row, FABRICATED, "V", "left", -1e-6), "allowed is 0 to 0.015"),
        (partial(strain.strain_row, FABRICATED, "V", "left", float("nan")), "allowed is 0 to 0.015"),
        (partial(strain.strain_row, FABRICATED, "X", "left", 0.0), "allowed are H or V"),  # type: ignore[arg-type]
        (partial(strain.strain_row, FABRICATED, "H", "top", 0.0), "are H or V, left or right"),  # type: ignore[arg-type]
        (partial(strain.strain_row, FABRICATED, "H", "left", 0.0, "inner"), "lower or upper"),  # type: ignore[arg-type]
        (partial(strain.nominal_position, FABRICATED, "X"), "gauge point 'X'"),
        (partial(quality.shifted_matrix, FABRICATED, "I", [0.0, 0.0]), "allowed is (..., 3)"),
        (partial(shift_to_reach, FABRICATED, "I", 3.0, ("R",)), "not in the layout"),
    ],
)
def test_refuses(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError) as error:
        call()
    assert message in str(error.value)


def test_figure_6_slopes_are_derivatives() -> None:
    for case in ("I", "II", "III"):
        for index, expected in enumerate(slopes_per_mm(FABRICATED, case)):
            ahead = quality.condition_number(quality.shifted_matrix(FABRICATED, case, np.eye(3)[index] * 1e-6))
            slope = (ahead - quality.condition_number(strain.strain_matrix(FABRICATED, case))) / 1e-3
            assert expected == pytest.approx(slope, rel=2e-3)


def test_sg3_matters_most_in_case_i_near_its_points_only() -> None:
    assert [most_influential(FABRICATED, "I", mm * 1e-3) for mm in (0.01, 0.5, 1.0, 2.0)] == [3, 3, 3, 3]
    assert most_influential(FABRICATED, "I", 4e-3) != 3
    for mm in (0.01, 0.5, 1.0, 2.0, 4.0):
        assert most_influential(FABRICATED, "II", mm * 1e-3) == 1
        assert most_influential(FABRICATED, "III", mm * 1e-3) in (1, 2)


def test_one_shift_of_the_outer_gauges_explains_the_finite_elements() -> None:
    assert shift_to_reach(FABRICATED, "I", 2.53, LAYOUTS["I"]) == pytest.approx(0.39e-3, abs=5e-6)
    second = shift_to_reach(FABRICATED, "II", 3.36, ("L",), 0.5e-3)
    reached = quality.condition_number(quality.shifted_matrix(FABRICATED, "II", [second, 0.5e-3, 0.5e-3]))
    assert reached == pytest.approx(3.36, abs=1e-5)
    assert isnan(shift_to_reach(FABRICATED, "II", 3.36, ("S_H",)))
