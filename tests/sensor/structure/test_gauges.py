"""Strain anywhere along the beams: Table 1 at its points, linear between, and Figure 6 from it."""

from __future__ import annotations

from math import isnan

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce.sensor.structure.gauges import (
    GaugePosition,
    nominal_position,
    position_matrix,
    shifted,
    shifted_matrix,
    strain_row,
)
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.layouts import LAYOUTS, POINTS
from tipforce.sensor.structure.strain import condition_number, strain_matrix
from tipforce_lab.design.paper_figures import condition_against_shift, most_influential, shift_to_reach, slopes_per_mm

ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
def test_equals_table_1_at_the_points(geometry: Geometry) -> None:
    found = position_matrix(geometry, [nominal_position(geometry, point) for point in POINTS])
    expected = strain_matrix(geometry, POINTS)
    np.testing.assert_allclose(found, expected, rtol=4e-16, atol=1e-16 * np.abs(expected).max())


def test_linear_along_the_beams_and_bending_changes_sign_on_the_upper_face() -> None:
    for beam, length in (("H", ODD.a_m), ("V", ODD.d_m)):
        for side in ("left", "right"):
            ends = strain_row(ODD, beam, side, [0.0, length])  # type: ignore[arg-type]
            for part in (0.25, 0.5, 0.9):
                between = strain_row(ODD, beam, side, part * length)  # type: ignore[arg-type]
                np.testing.assert_allclose(between, (1.0 - part) * ends[0] + part * ends[1], rtol=1e-12, atol=1e-12)
    lower, upper = (strain_row(ODD, "H", "right", 3e-3, face) for face in ("lower", "upper"))
    np.testing.assert_allclose(lower[:2], -upper[:2])
    assert lower[2] == upper[2]


def test_moment_of_an_arm_follows_from_its_shear_force() -> None:
    """Equilibrium of an arm under F1: its two ends share half the load, so the moment falls by F1/2 per metre."""
    section_modulus = ODD.width_m * ODD.h1_m**2 / 6.0
    near, far = strain_row(ODD, "H", "right", [2e-3, 9e-3])[:, 0] * ODD.youngs_modulus_pascals * section_modulus
    assert (near - far) / 7e-3 == pytest.approx(0.5)


def test_shifts_are_inward() -> None:
    left = shifted(ODD, "L", 1e-3)
    assert left == GaugePosition("H", "left", left.position_m)
    assert left.position_m == pytest.approx(0.010)
    assert shifted(ODD, "S_V", 1e-3) == GaugePosition("V", "right", 1e-3)
    assert shifted(ODD, GaugePosition("V", "right", 0.016), 1e-3).position_m == pytest.approx(0.015)
    rows = shifted_matrix(ODD, "III", [1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(rows[2], strain_row(ODD, "V", "right", 0.014))
    assert shifted_matrix(ODD, "III", np.zeros((4, 5, 3))).shape == (4, 5, 3, 3)
    np.testing.assert_allclose(shifted_matrix(ODD, "III", 0.0), strain_matrix(ODD, "III"), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("H", "left", 0.0151), "allowed is 0 to 0.015"),
        (("V", "left", -1e-6), "allowed is 0 to 0.015"),
        (("V", "left", float("nan")), "allowed is 0 to 0.015"),
        (("X", "left", 0.0), "allowed are H or V"),
        (("H", "top", 0.0), "allowed are H or V, left or right"),
        (("H", "left", 0.0, "inner"), "lower or upper"),
    ],
)
def test_refuses(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        strain_row(FABRICATED, *arguments)  # type: ignore[arg-type]


def test_refuses_points_and_shapes() -> None:
    with pytest.raises(InputError, match="gauge point 'X'"):
        nominal_position(FABRICATED, "X")
    with pytest.raises(InputError, match=r"allowed is \(..., 3\)"):
        shifted_matrix(FABRICATED, "I", [0.0, 0.0])
    with pytest.raises(InputError, match="not in the layout"):
        shift_to_reach(FABRICATED, "I", 3.0, ("R",))


def test_figure_6_slopes_are_derivatives() -> None:
    for case in ("I", "II", "III"):
        for index, expected in enumerate(slopes_per_mm(FABRICATED, case)):
            step = np.eye(3)[index] * 1e-6
            ahead = condition_number(shifted_matrix(FABRICATED, case, step))
            slope = (ahead - condition_number(strain_matrix(FABRICATED, case))) / 1e-3
            assert expected == pytest.approx(slope, rel=2e-3)


def test_sg3_matters_most_in_case_i_near_its_points_only() -> None:
    assert [most_influential(FABRICATED, "I", mm * 1e-3) for mm in (0.01, 0.5, 1.0, 2.0)] == [3, 3, 3, 3]
    assert most_influential(FABRICATED, "I", 4e-3) != 3
    for mm in (0.01, 0.5, 1.0, 2.0, 4.0):
        assert most_influential(FABRICATED, "II", mm * 1e-3) == 1
        assert most_influential(FABRICATED, "III", mm * 1e-3) in (1, 2)


def test_all_row_shifts_every_gauge() -> None:
    found = condition_against_shift(FABRICATED, "II", [0.0, 1e-3])
    assert found.shape == (4, 2)
    assert found[3, 1] == pytest.approx(condition_number(shifted_matrix(FABRICATED, "II", 1e-3)))
    np.testing.assert_allclose(found[:, 0], condition_number(strain_matrix(FABRICATED, "II")))


def test_one_shift_of_the_outer_gauges_explains_the_finite_elements() -> None:
    first = shift_to_reach(FABRICATED, "I", 2.53, LAYOUTS["I"])
    second = shift_to_reach(FABRICATED, "II", 3.36, ("L",), 0.5e-3)
    third = shift_to_reach(FABRICATED, "III", 3.94, ("L", "R"), 0.5e-3)
    assert first == pytest.approx(0.39e-3, abs=5e-6)
    assert second == pytest.approx(1.96e-3, abs=5e-6)
    assert third == pytest.approx(2.01e-3, abs=5e-6)
    reached = condition_number(shifted_matrix(FABRICATED, "II", [second, 0.5e-3, 0.5e-3]))
    assert reached == pytest.approx(3.36, abs=1e-5)
    assert isnan(shift_to_reach(FABRICATED, "II", 3.36, ("S_H",)))
