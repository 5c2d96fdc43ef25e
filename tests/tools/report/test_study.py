"""How a method is timed, with a clock that the test moves."""

from __future__ import annotations

import pytest

from tipforce_lab.report.study import Effort, Timing, timed, timed_together


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
    clock = Clock(monkeypatch)
    timing = timed(clock.work, Effort(quick=True), units=10, at_least_s=0.02)
    assert timing.seconds == pytest.approx(1e-4)
    assert timing.first_quartile_s == pytest.approx(0.5e-4)  # of the processor time
    assert timing.runs == 3
    assert timing.cpu_seconds == timing.work_seconds == pytest.approx(0.5e-4)


def test_each_run_is_long_enough_for_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    timing = timed(clock.work, Effort(), at_least_s=0.02)
    assert timing.runs == 7
    assert clock.calls >= 7 * 20


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
