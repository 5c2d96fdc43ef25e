"""Gauges on the faces, their convergence, corner exponents; the studies of the report and of the bench."""

import math
import sys
from functools import cache

import numpy as np
import pytest
from bench import fem as studies

from tipforce.errors import InputError
from tipforce.sensor.structure.strain import GaugePosition
from tipforce_lab.fem import Model, Resolution, corner_exponent, solve, strain_matrix
from tipforce_lab.fem.mesh import GRADING, STATED, Outline
from tipforce_lab.fem.plane_stress import Solution, extrapolate, face, nearest_place
from tipforce_lab.report.studies import structure
from tipforce_lab.report.study import Effort, Study, Timing

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


@pytest.fixture(scope="module")
def runs() -> dict[float, studies.Convergence]:
    return {grading: studies.convergence(grading, (1, 2, 4)) for grading in (1.0, GRADING)}


def test_the_condition_numbers_have_a_limit(runs: dict[float, studies.Convergence]) -> None:
    limits = runs[GRADING].limits()
    for limit, full in zip(limits, (2.4937, 2.8062, 3.0778), strict=True):  # docs/finite-elements.md
        assert limit.value == pytest.approx(full, rel=5e-4)
        assert limit.error / limit.value < 2e-3


def test_doubling_levels() -> None:
    levels = tuple(studies.Level(n, 0, 0.0, [1.0], np.zeros((1, 3)), 0.0) for n in (2, 3, 4, 6, 8, 12))
    assert [level.cells for level in studies.Convergence(1.0, levels).doubling()] == [3, 6, 12]


def test_corner_exponents_show() -> None:
    for found in studies.corner_exponents(4):
        assert found.observed == pytest.approx(found.theory, abs=0.05)


def test_ansys_is_reproduced_by_places_or_by_legs() -> None:
    found = {(match.what, match.case): match for match in studies.matches(solved(3), 1)}
    for what in ("L, R inward", "legs thin"):
        two, three = found[what, "II"], found[what, "III"]
        assert two.conditions[1] == pytest.approx(3.36, abs=0.01)
        assert three.conditions[2] == pytest.approx(3.94, abs=0.01)
        assert two.value_mm == pytest.approx(three.value_mm, rel=0.06)  # one cause for both
    # Gauges centred on L and R reach one or the other, not both.
    assert found["L, R outward", "II"].conditions[2] < 3.7
    assert found["L, R outward", "III"].conditions[1] > 3.6


def test_no_places_reproduce_the_measurement() -> None:
    found = studies.best_for_measured(solved(3), 7)
    assert found.worst > 0.1
    wanted = (3.50, 3.50, 3.34)
    assert max(abs(one - other) for one, other in zip(found.conditions, wanted, strict=True)) == pytest.approx(
        found.worst
    )


def test_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "GRADINGS", (GRADING,))
    monkeypatch.setattr(studies, "outline_variants", lambda _: {})
    monkeypatch.setattr(studies, "matches", lambda *_: [])
    studies.main(["--quick"])
    out = capsys.readouterr().out
    assert "case II: 2.80" in out
    assert "| opening | " in out


@pytest.fixture(scope="module")
def found() -> dict[str, Study]:
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(structure, "timed", _once)
        studies = structure.studies(Effort(quick=True), lambda: steps.append(1))
    assert len(steps) == structure.STEPS
    return {one.key: one for one in studies}


def _once(work: object, _: Effort) -> Timing:
    assert callable(work)
    work()
    return Timing(1.0, 1.0, 1.0, 1)


def test_models_and_their_errors(found: dict[str, Study]) -> None:
    assert set(found) == {"structure-condition", "structure-strain"}
    study = found["structure-condition"]
    errors = {one.method: [point.error for point in one.points] for one in study.series}
    assert study.reference_error < 2e-3
    assert errors["Table 1, at its points"][0] == pytest.approx(0.12, abs=0.01)
    # The frame without shear and root springs is Table 1 in another place of the code.
    assert errors["frame, Euler-Bernoulli"] == pytest.approx(errors["Table 1, where 1 mm gauges fit"], rel=1e-9)
    assert errors["frame, roots that rotate"] < errors["frame, Timoshenko"] < errors["frame, Euler-Bernoulli"]
    graded, uniform = errors["FE, graded meshes"], errors["FE, uniform meshes"]
    assert graded[-1] < 0.5 * uniform[-1]
    assert (np.diff(graded) < 0.0).all()
    assert all("infinite" not in remark and "nan" not in remark for remark in study.remarks)
    assert "3.078" in study.reference


def test_without_scikit_fem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    steps: list[int] = []
    studies = structure.studies(Effort(quick=True), lambda: steps.append(1))
    assert len(steps) == structure.STEPS
    for study in studies:
        assert not study.series
        assert any('pip install "tipforce[fem]"' in reason for reason in study.left_out.values())
