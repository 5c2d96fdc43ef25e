"""Studies: how a method is timed; decoders, calibration fits, honesty, integrators: what theory says of them."""

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding import judged
from tipforce.sensor.dynamics import first_order_hold
from tipforce_lab.dynamics.impact import Striker
from tipforce_lab.report.studies import decoders, fits, honesty, integrators
from tipforce_lab.report.study import Counted, Effort, Study, Timing, timed, timed_together
from tools.report.made import Tiny, at_once

SECONDS = 3.0
NODE, FAULTS, DECODE, ESTIMATE, BARE = range(len(honesty.METHODS))


class Clock:
    """Nanoseconds that only work lets pass."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = 0
        self.calls = 0
        monkeypatch.setattr("tipforce_lab.report.study.time.perf_counter_ns", lambda: self.now_ns)
        monkeypatch.setattr("tipforce_lab.report.study.time.process_time_ns", lambda: self.now_ns // 2)

    def work(self) -> None:
        self.calls += 1
        self.now_ns += 1_000_000 if self.calls > 1 else 5_000_000_000  # the first call is slow


def test_a_time_is_per_unit_and_without_the_first_call(monkeypatch: pytest.MonkeyPatch) -> None:
    timing = timed(Clock(monkeypatch).work, Effort(quick=True), units=10, at_least_s=0.02)
    assert timing.first_quartile_s == timing.cpu_seconds == timing.work_seconds == pytest.approx(0.5e-4)
    assert timing.seconds == pytest.approx(1e-4)
    assert timing.runs == 3
    clock = Clock(monkeypatch)
    assert timed(clock.work, Effort(), at_least_s=0.02).runs == 7
    assert clock.calls >= 7 * 20, "each run is long enough for the clock"


def test_methods_are_timed_in_turn_and_warm(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine becomes slower and slower: each method still has its share of the slow and of the fast runs."""
    clock, order = Clock(monkeypatch), []

    def work(name: str, ns: int) -> None:
        order.append(name)
        clock.now_ns += ns * len(order)

    one, two = timed_together(
        [lambda: work("a", 1_000_000), lambda: work("b", 2_000_000)], Effort(quick=True), at_least_s=1e-9, warm=True
    )
    assert order == ["a", "b"] + ["a", "b"] * 3  # once for the number of repeats
    assert 1.5 < two.seconds / one.seconds < 2.5
    assert Timing(2.0, 1.0, 3.0, 3).work_seconds == 2.0


def test_all_decoders_agree_to_rounding_and_one_shows_unknown_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoders, "timed", at_once)
    monkeypatch.setattr(decoders, "BATCHES", (1, 10, 300))
    steps: list[None] = []
    (found,) = decoders.studies(Tiny(), lambda: steps.append(None))
    assert [one.method for one in found.series] == [
        decoders.OURS, decoders.BY_HAND, decoders.CANTOOLS, decoders.CANOPEN,
    ]  # fmt: skip
    assert len(steps) == 6
    # 2^-53 of at most 32767 steps; one more rounding where a decoder multiplies by 0.001.
    for one in found.series:
        assert all(0.0 <= point.error <= 2.0**-52 * 32768 for point in one.points), one.method
    shown = [remark for remark in found.remarks if "decoded as numbers" in remark]
    assert len(shown) == 1
    assert shown[0].startswith(decoders.CANOPEN)


def test_a_wrong_value_is_an_error_of_its_steps() -> None:
    message = next(m for m in tpdo_messages(3) if m.name == "Contact")
    data = [struct.pack("<hhhBB", 1000, decoders.UNKNOWN, -1, 0, 0)]
    error, unknown_shown = decoders.judge([(1.002, None, -0.01)], data, message)
    assert error == pytest.approx(2.0)
    assert unknown_shown == 0
    assert decoders.judge([(1.0, -327.68, -0.01)], data, message)[1] == 1


def test_each_method_gives_every_signal() -> None:
    message = next(m for m in tpdo_messages(3) if m.name == "Contact")
    data = bytes.fromhex("e803102770fe8107")  # P 1.000 N, phi 100.00, theta -4.00 degrees, bits 0 and 7, counter 7
    for method, decode in decoders.others(message).items():
        found = decode(data)
        assert set(found) == {signal.name for signal in message.signals}, method
        assert [found[name] for name in decoders.MEASURED] == pytest.approx([1.0, 100.0, -4.0]), method
        on = {signal.name for signal in message.signals if signal.bits == 1 and found[signal.name]}
        assert (on, found["counter"]) == ({"contact", "fault"}, 7), method


@pytest.fixture(scope="module")
def fit_studies() -> dict[str, Study]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fits, "timed", at_once)
        patch.setattr(fits, "LOADS", (12, 50, 200))
        patch.setattr(Tiny, "pick", lambda *_: 5)
        return {one.key: one for one in fits.studies(Tiny(), lambda: None)}


def errors(study: Study) -> dict[str, np.ndarray]:
    return {one.method: np.array([point.error for point in one.points]) for one in study.series}


def test_the_error_falls_with_the_root_of_the_number_of_loads(fit_studies: dict[str, Study]) -> None:
    full = errors(fit_studies["fits"])[fits.FULL]
    assert (np.diff(full) < 0.0).all()
    assert np.polyfit(np.log([50, 200]), np.log(full[1:]), 1)[0] == pytest.approx(-0.5, abs=0.25)


def test_without_an_offset_more_loads_do_not_help(fit_studies: dict[str, Study]) -> None:
    clean = errors(fit_studies["fits"])
    assert clean[fits.LINEAR][-1] > 50.0 * clean[fits.FULL][-1]
    assert clean[fits.LINEAR][-1] > 0.5 * clean[fits.LINEAR][0]


def test_least_squares_are_as_good_until_there_are_outliers(fit_studies: dict[str, Study]) -> None:
    clean, odd = errors(fit_studies["fits"]), errors(fit_studies["fits-outliers"])
    assert clean[fits.AFFINE] == pytest.approx(clean[fits.FULL], rel=0.1)
    assert odd[fits.AFFINE][-1] > 5.0 * odd[fits.FULL][-1]
    assert odd[fits.FULL][-1] < 1.5 * clean[fits.FULL][-1]


def test_a_refusal_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(_rig: object) -> fits.Fitted:
        raise InputError("too few rows")

    monkeypatch.setattr(fits, "timed", at_once)
    monkeypatch.setattr(fits, "LOADS", (6,))
    monkeypatch.setitem(fits._METHODS, fits.FULL, refusing)
    for one in fits.studies(Tiny(), lambda: None):
        assert one.left_out == {f"{fits.FULL}, 6 loads": "refused: too few rows"}
        assert fits.FULL not in [series.method for series in one.series]


@pytest.fixture(scope="module")
def finger(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibration]:
    """Four gauges, calibrated by the command."""
    folder = tmp_path_factory.mktemp("finger")
    return folder, honesty.calibrated(folder, 4, np.random.default_rng(3))


def counts(finger: tuple[Path, Calibration], fault: str, seed: int = 1) -> list[Counted]:
    return honesty._counts(finger[0], honesty._scene(fault, 4, SECONDS, np.random.default_rng(seed)), finger[1])


def test_a_good_finger_says_ok_and_is_right(finger: tuple[Path, Calibration]) -> None:
    for cell in counts(finger, "none"):
        assert cell.rows == 150
        assert cell.ok > 0.98 * cell.rows
        assert cell.wrong == 0


@pytest.mark.parametrize("fault", ["open", "saturate", "drift"])
def test_a_broken_gauge_is_no_longer_ok(finger: tuple[Path, Calibration], fault: str) -> None:
    before = honesty.FAULT_FROM * 150
    for cell in counts(finger, fault):
        assert 0.9 * before < cell.ok < 0.6 * cell.rows
        assert cell.wrong == 0


def test_silence_and_overload_are_not_ok(finger: tuple[Path, Calibration]) -> None:
    silent, overload = counts(finger, "silent"), counts(finger, "overload")
    assert silent[NODE].wrong == silent[DECODE].wrong == 0
    assert silent[ESTIMATE].wrong == silent[BARE].wrong == 0  # readings that repeat
    assert [overload[k].ok for k in (NODE, FAULTS, DECODE, ESTIMATE)] == [150, 0, 0, 0]


def test_a_judgement_that_is_switched_off_is_noticed(
    finger: tuple[Path, Calibration], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judged, "explained", lambda _W, shown, V, *_: (0.0 * V[0], [(0.0, 0.0)] * len(shown)))
    found = counts(finger, "drift")
    # The node judges by itself, and decode reads its status.
    assert found[NODE].wrong == found[FAULTS].wrong == found[DECODE].wrong == 0
    assert min(found[k].wrong for k in (ESTIMATE, BARE)) > 20
    row = honesty._row("drift", 5, tuple(found))
    assert row.over == (False, False, False, True, True)
    assert not row.held  # five gauges can tell: no reason excuses it
    assert honesty._row("drift", 3, tuple(found)).held


def test_remarks_count_what_the_table_has() -> None:
    rows = [
        honesty._row(fault, 5, (Counted(100, 90, wrong), *[Counted(100, 99, 0)] * 4))
        for fault, wrong in (("none", 0), ("warm", 8))
    ]
    told = honesty._remarks(rows)
    assert "contact PDO alone 8 of 180" in told[0]
    assert told[1] == f"Fewest: {honesty.METHODS[1]}."
    assert "97.2 %" in told[2]
    assert [row.held for row in rows] == [True, True]  # the contact PDO does not carry the temperature


def once(works: Sequence[Callable[[], object]], *_arguments: object, **named: object) -> list[Timing]:
    """In place of ``timed_together``: no run beyond the one for the error, which must have warmed them up."""
    assert named["warm"]
    return [Timing(1e-6, 1e-6, 1e-6, 2, 1e-6) for _ in works]


@pytest.fixture(scope="module")
def integrator_studies() -> dict[str, Study]:
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


def test_each_task_compares_all_methods(integrator_studies: dict[str, Study]) -> None:
    assert set(integrator_studies) == {"smooth", "step", "tap", "impact"}
    others = ["RK4", "Newmark", "generalised-alpha 0.8", "Radau", "BDF", "LSODA", "DOP853"]
    for key, study in integrator_studies.items():
        first = "events (exact)" if key == "impact" else "held step (exact)"
        assert [series.method for series in study.series] == [first, *others]
        assert 0.0 < study.reference_error < 1e-12
        assert study.check_difference is not None
        assert study.check_difference < {"smooth": 1e-13, "step": 1e-10, "tap": 1e-12, "impact": 1e-11}[key]
        assert not study.left_out
        for series in study.series:
            assert all(point.timing.seconds > 0.0 and point.timing.runs == 2 for point in series.points)
            assert all(point.timing.cpu_seconds is not None for point in series.points)


def test_finer_settings_are_better(integrator_studies: dict[str, Study]) -> None:
    for key in ("smooth", "tap"):
        for series in integrator_studies[key].series:
            assert series.points[-1].error < series.points[0].error, (key, series.method)


def test_the_held_step_is_exact_for_a_step_and_rk4_is_shown_unstable(integrator_studies: dict[str, Study]) -> None:
    held, rk4 = integrator_studies["step"].series[:2]
    assert max(point.error for point in held.points) < 1e-12
    assert all(math.isinf(point.error) for point in rk4.points)
    assert any("RK4 is unstable" in remark for remark in integrator_studies["step"].remarks)
    assert any("stability limit" in remark for remark in integrator_studies["step"].remarks)
    assert integrator_studies["impact"].series[0].points[0].error <= integrator_studies["impact"].reference_error


def test_the_independent_check_finds_a_wrong_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    right = first_order_hold.hold

    def wrong(x: float, zeta: float) -> first_order_hold.Hold:
        return right(x, zeta)._replace(p12=right(x, zeta).p12 * (1.0 + 1e-8))

    monkeypatch.setattr(first_order_hold, "hold", wrong)
    task = integrators.TASKS["tap"]()
    assert integrators.relative(integrators.checked(task), task.wanted) > 1e-10


def test_the_independent_impact_finds_another_contact() -> None:
    task = integrators.struck()
    softer = Striker(0.01, 0.3, 1e7 * (1.0 + 1e-6))
    assert integrators.relative(integrators.checked(task, softer), task.wanted) > 1e-9
