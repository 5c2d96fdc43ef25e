"""Gauges on the faces, their convergence, the limit of a series, and corner exponents."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from tipforce.errors import InputError
from tipforce.sensor.structure.gauges import GaugePosition
from tipforce_lab.fem.mesh import GRADING, STATED, Outline, Resolution
from tipforce_lab.fem.plane_stress import (
    Model,
    Solution,
    corner_exponent,
    extrapolate,
    face,
    nearest_place,
    solve,
    strain_matrix,
)

FloatArray = npt.NDArray[np.float64]
GAUGES = ("S_H", "U")


@cache
def solved(cells: int, grading: float = GRADING) -> Solution:
    return solve(Model(resolution=Resolution(cells, grading)))


def test_a_gauge_is_the_mean_of_the_strain_along_it() -> None:
    place = GaugePosition("H", "right", 9e-3)
    surface = face(solved(2), place)
    # P2: strain is linear on each side, so the trapezoid of its ends, just inside, is exact.
    ends = np.unique(np.clip(surface.s_m, 8.5e-3, 9.5e-3))
    inside = np.stack([ends[:-1] + 1e-12, ends[1:] - 1e-12], axis=1)
    mean = np.sum(surface.strain(inside).mean(axis=1) * np.diff(ends)[:, np.newaxis], axis=0) / 1e-3
    np.testing.assert_allclose(strain_matrix(solved(2), [place])[0], mean * solved(2).scale, rtol=1e-6)


def test_a_short_gauge_is_a_point() -> None:
    place = [GaugePosition("V", "left", 7.1e-3), GaugePosition("H", "left", 7e-3, "upper")]
    short, point = (strain_matrix(solved(2), place, length) for length in (1e-6, 0.0))
    np.testing.assert_allclose(short, point, rtol=0, atol=1e-4 * np.abs(point).max())


def test_both_faces_of_the_horizontal_beam_bend_oppositely() -> None:
    lower, upper = strain_matrix(solved(3), [GaugePosition("H", "right", 5e-3, f) for f in ("lower", "upper")])
    assert lower[1] == pytest.approx(-upper[1], rel=1e-5)  # a moment bends
    assert lower[0] == pytest.approx(-upper[0], rel=0.1)  # and a force across also pulls a little
    assert lower[2] == pytest.approx(upper[2], rel=0.1)  # a force along pulls and hardly bends


def test_where_gauges_fit() -> None:
    round_corners = Outline(fillet_m=0.2e-3)
    assert nearest_place(STATED, "S_H").position_m == pytest.approx(0.5 * 0.653e-3 + 0.5e-3)
    assert nearest_place(STATED, "L").position_m == pytest.approx(14.5e-3)
    assert nearest_place(round_corners, "U").position_m == pytest.approx(14.3e-3)
    assert nearest_place(round_corners, "K_V").position_m == pytest.approx(0.7e-3)
    assert nearest_place(Outline(fixture_depth_m=0.0, fillet_m=0.2e-3), "T").position_m == pytest.approx(14.5e-3)


@pytest.mark.parametrize(
    ("place", "length_m", "message"),
    [
        (
            GaugePosition("H", "right", 0.6e-3),
            1e-3,
            "gauge H right 0.60 of 1 mm: allowed is a gauge between the corners",
        ),
        (GaugePosition("H", "left", 16.8e-3), 1e-3, "-17.000 and -0.327 mm along x"),
        (GaugePosition("V", "left", 14.8e-3), 1e-3, "between the corners of its face, -15.200"),
        (GaugePosition("H", "left", float("nan")), 1e-3, "allowed is a gauge between"),
        (GaugePosition("H", "up", 7e-3), 1e-3, "allowed are beam H or V"),  # type: ignore[arg-type]
        (GaugePosition("H", "left", 7e-3), -1.0, "gauge_length_m = -1.0: allowed is 0"),
    ],
)
def test_gauges_that_do_not_fit(place: GaugePosition, length_m: float, message: str) -> None:
    with pytest.raises(InputError) as caught:
        strain_matrix(solved(1), [place], length_m)
    assert message in str(caught.value)


def test_a_gauge_under_the_leg_is_allowed_where_the_face_runs_on() -> None:
    under = GaugePosition("H", "right", 15e-3)
    row, nominal = strain_matrix(solved(2), [under, nearest_place(STATED, "R")])
    assert abs(row[0]) < 0.8 * abs(nominal[0])
    with pytest.raises(InputError, match="between the corners"):
        strain_matrix(solve(Model(Outline(leg_below_m=2e-3), Resolution(1))), [under])


def test_averages_converge_and_faster_on_graded_meshes() -> None:
    reference = strain_matrix(solved(5), GAUGES)
    size = float(np.linalg.norm(reference))

    def errors(grading: float) -> list[float]:
        return [float(np.linalg.norm(strain_matrix(solved(n, grading), GAUGES) - reference)) / size for n in (1, 2, 4)]

    graded, uniform = errors(GRADING), errors(1.0)
    orders = [math.log2(errors[1] / errors[2]) for errors in (graded, uniform)]
    assert orders[0] > 1.0
    assert 0.0 < orders[1] < 0.6  # theory 0.5445, from below
    assert graded[1] < uniform[2]


def test_the_strain_in_the_corner_diverges_as_theory_says() -> None:
    values = [face(solved(n, 1.0), nearest_place(STATED, "S_H")).strain(0.5 * STATED.geometry.h2_m)[1] for n in (2, 4)]
    growth = math.log2(values[1] / values[0])
    assert growth == pytest.approx(1.0 - corner_exponent(1.5 * math.pi, "opening"), abs=0.06)


def test_corner_exponents_of_williams() -> None:
    assert corner_exponent(1.5 * math.pi, "opening") == pytest.approx(0.5444837, abs=1e-7)
    assert corner_exponent(1.5 * math.pi, "sliding") == pytest.approx(0.9085292, abs=1e-7)
    for mode in ("opening", "sliding"):  # a crack
        assert corner_exponent(2.0 * math.pi - 1e-9, mode) == pytest.approx(0.5, abs=1e-4)
    assert corner_exponent(math.pi + 1e-4, "opening") == pytest.approx(1.0, abs=1e-3)
    for angle, mode in ((1.1 * math.pi, "sliding"), (math.pi, "opening"), (7.0, "opening"), (4.0, "tearing")):
        with pytest.raises(InputError):
            corner_exponent(angle, mode)


def test_a_limit_is_found_with_its_order() -> None:
    for order in (0.5, 1.0, 2.2, 3.0):
        found = extrapolate([5.0, *(3.0 + 0.1 * 2.0 ** (-order * k) for k in range(3))])
        assert found.value == pytest.approx(3.0, abs=1e-12)
        assert found.order == pytest.approx(order, rel=1e-9)
        assert found.error == pytest.approx(1.25 * 0.1 * 2.0 ** (-order * 2), rel=1e-9)


def test_a_limit_that_cannot_be_seen() -> None:
    for values in ([1.0, 1.2, 1.1], [1.0, 1.1, 1.2], [1.0, 1.0, 1.0]):
        found = extrapolate(values)
        assert found.value == values[-1]
        assert math.isnan(found.order)
        assert found.error == pytest.approx(max(abs(np.diff(values))))
    steep = extrapolate([1.0, 1.1, 1.1001])
    assert steep.error == pytest.approx(1.25 * 1e-4 / 7.0)  # no more than third order is believed
    for bad in ([1.0, 2.0], [1.0, float("nan"), 2.0]):
        with pytest.raises(InputError, match="three or more finite numbers"):
            extrapolate(bad)
