"""The study of integrators: four tasks, every method in each, and what is unstable is said."""

from __future__ import annotations

import math

import pytest

from tipforce_tools.report.studies import integrators
from tipforce_tools.report.study import Effort, Study


@pytest.fixture(scope="module")
def found() -> dict[str, Study]:
    """All four, with one coarse and one finer setting of each method."""
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(integrators, "_substeps", lambda _: (1, 4))
        patch.setattr(integrators, "_tolerances", lambda _: (1e-3, 1e-5))
        studies = integrators.studies(Effort(quick=True), lambda: steps.append(1))
    assert len(steps) == integrators.STEPS
    return {study.key.removeprefix("integrators-"): study for study in studies}


def test_each_task_compares_all_methods(found: dict[str, Study]) -> None:
    assert set(found) == {"smooth", "step", "tap", "impact"}
    others = ["RK4", "Newmark", "generalised-alpha 0.8", "Radau", "BDF", "LSODA", "DOP853"]
    for key, study in found.items():
        first = "events (exact)" if key == "impact" else "held step (exact)"
        assert [series.method for series in study.series] == [first, *others]
        assert 0.0 < study.reference_error < 1e-12
        assert not study.left_out
        for series in study.series:
            assert all(point.timing.seconds > 0.0 for point in series.points)


def test_finer_settings_are_better(found: dict[str, Study]) -> None:
    for key in ("smooth", "tap"):
        for series in found[key].series:
            assert series.points[-1].error < series.points[0].error, (key, series.method)


def test_the_held_step_is_exact_for_a_step_and_rk4_is_shown_unstable(found: dict[str, Study]) -> None:
    held, rk4 = found["step"].series[:2]
    assert max(point.error for point in held.points) < 1e-12
    assert all(math.isinf(point.error) for point in rk4.points)
    assert any("RK4 is unstable" in remark for remark in found["step"].remarks)
    assert any("stability limit" in remark for remark in found["step"].remarks)
    assert found["impact"].series[0].points[0].error <= found["impact"].reference_error
