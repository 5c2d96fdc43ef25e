"""The studies on finite elements: that of the report, and those of the bench."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from bench import fem_studies as studies
from bench.fem import main

from tipforce_lab.fem.mesh import GRADING, Resolution
from tipforce_lab.fem.plane_stress import Model, Solution, extrapolate_matrix, solve
from tipforce_lab.report.studies import structure
from tipforce_lab.report.studies.structure import distance, worst_error
from tipforce_lab.report.study import Effort, Study, Timing


@pytest.fixture(scope="module")
def base() -> Solution:
    return solve(Model(resolution=Resolution(3)))


@pytest.fixture(scope="module")
def runs() -> dict[float, studies.Convergence]:
    return {grading: studies.convergence(grading, (1, 2, 4)) for grading in (1.0, GRADING)}


def test_the_condition_numbers_have_a_limit(runs: dict[float, studies.Convergence]) -> None:
    limits = runs[GRADING].limits()
    for limit, full in zip(limits, (2.4937, 2.8062, 3.0778), strict=True):  # docs/finite-elements.md
        assert limit.value == pytest.approx(full, rel=5e-4)
        assert limit.error / limit.value < 2e-3


def test_graded_meshes_are_ahead(runs: dict[float, studies.Convergence]) -> None:
    limits = [limit.value for limit in runs[GRADING].limits()]
    matrix, error = extrapolate_matrix([level.matrix for level in runs[GRADING].levels])
    uniform, graded = (runs[grading].levels for grading in (1.0, GRADING))
    assert error < 5e-3
    for one, other in zip(uniform[1:], graded[1:], strict=True):
        assert one.unknowns == other.unknowns
        assert worst_error(other.conditions, limits) < worst_error(one.conditions, limits)
        assert distance(other.matrix, matrix) < 0.6 * distance(one.matrix, matrix)
    # Half as fine and four times fewer unknowns, still better than uniform.
    assert worst_error(graded[1].conditions, limits) < worst_error(uniform[2].conditions, limits)


def test_doubling_levels() -> None:
    levels = tuple(studies.Level(n, 0, 0.0, [1.0], np.zeros((1, 3)), 0.0) for n in (2, 3, 4, 6, 8, 12))
    assert [level.cells for level in studies.Convergence(1.0, levels).doubling()] == [3, 6, 12]


def test_corner_exponents_show() -> None:
    for found in studies.corner_exponents(4):
        assert found.observed == pytest.approx(found.theory, abs=0.05)


def test_ansys_is_reproduced_by_places_or_by_legs(base: Solution) -> None:
    found = {(match.what, match.case): match for match in studies.matches(base, 1)}
    for what in ("L, R inward", "legs thin"):
        two, three = found[what, "II"], found[what, "III"]
        assert two.conditions[1] == pytest.approx(3.36, abs=0.01)
        assert three.conditions[2] == pytest.approx(3.94, abs=0.01)
        assert two.value_mm == pytest.approx(three.value_mm, rel=0.06)  # one cause for both
    # Gauges centred on L and R reach one or the other, not both.
    assert found["L, R outward", "II"].conditions[2] < 3.7
    assert found["L, R outward", "III"].conditions[1] > 3.6


def test_no_places_reproduce_the_measurement(base: Solution) -> None:
    found = studies.best_for_measured(base, 7)
    assert found.worst > 0.1
    wanted = (3.50, 3.50, 3.34)
    assert max(abs(one - other) for one, other in zip(found.conditions, wanted, strict=True)) == pytest.approx(
        found.worst
    )


def test_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "GRADINGS", (GRADING,))
    monkeypatch.setattr(studies, "outline_variants", lambda _: {})
    monkeypatch.setattr(studies, "matches", lambda *_: [])
    main(["--quick"])
    out = capsys.readouterr().out
    assert "case II: 2.80" in out
    assert "| opening | " in out


@pytest.fixture(scope="module")
def found() -> tuple[dict[str, Study], int]:
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(structure, "timed", _once)
        studies = structure.studies(Effort(quick=True), lambda: steps.append(1))
    return {one.key: one for one in studies}, len(steps)


def _once(work: object, _: Effort) -> Timing:
    assert callable(work)
    work()
    return Timing(1.0, 1.0, 1.0, 1)


def test_the_steps_are_those_announced(found: tuple[dict[str, Study], int]) -> None:
    assert found[1] == structure.STEPS
    assert set(found[0]) == {"structure-condition", "structure-strain"}


def test_models_and_their_errors(found: tuple[dict[str, Study], int]) -> None:
    study = found[0]["structure-condition"]
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
