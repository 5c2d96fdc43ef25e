"""The study of integrators: four tasks, every method in each, and what is unstable is said."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest

from tipforce_lab.dynamics.impact import Striker
from tipforce_lab.report.studies import integrators
from tipforce_lab.report.study import Effort, Study, Timing


def once(works: Sequence[Callable[[], object]], *_arguments: object, **named: object) -> list[Timing]:
    """In place of ``timed_together``: no run beyond the one for the error, which must have warmed them up."""
    assert named["warm"]
    return [Timing(1e-6, 1e-6, 1e-6, 2, 1e-6) for _ in works]


@pytest.fixture(scope="module")
def found() -> dict[str, Study]:
    """All four, with one coarse and one finer setting of each method."""
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(integrators._SUBSTEPS, True, (1, 4))
        patch.setitem(integrators._TOLERANCES, True, (1e-3, 1e-5))
        patch.setattr(integrators, "timed_together", once)
        patch.setattr("tipforce_lab.report.studies.integrators.time.process_time", float)  # no setting takes too long
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
        assert study.check_difference is not None
        assert study.check_difference < {"smooth": 1e-13, "step": 1e-10, "tap": 1e-12, "impact": 1e-11}[key]
        assert not study.left_out
        for series in study.series:
            assert all(point.timing.seconds > 0.0 and point.timing.runs == 2 for point in series.points)
            assert all(point.timing.cpu_seconds is not None for point in series.points)


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


def test_the_independent_check_finds_a_wrong_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    from tipforce.sensor.dynamics import first_order_hold
    from tipforce_lab.dynamics import integrators as closed_forms

    right = first_order_hold.hold

    def wrong(x: float, zeta: float) -> first_order_hold.Hold:
        found = right(x, zeta)
        return found._replace(p12=found.p12 * (1.0 + 1e-8))

    monkeypatch.setattr(closed_forms, "hold", wrong)
    task = integrators.TASKS["tap"]()
    assert integrators.relative(integrators.checked(task), task.wanted) > 1e-10


def test_the_independent_impact_finds_another_contact() -> None:
    task = integrators.struck()
    softer = Striker(0.01, 0.3, 1e7 * (1.0 + 1e-6))
    assert integrators.relative(integrators.checked(task, softer), task.wanted) > 1e-9
