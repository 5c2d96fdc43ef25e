"""How a method is timed, with a clock that the test moves; the studies of decoders and of calibration fits."""

from __future__ import annotations

import struct

import pytest

from tipforce.dictionary.signals import tpdo_messages
from tipforce_lab.report.studies import decoders
from tipforce_lab.report.study import Effort, Timing, timed, timed_together
from tools.report.made import Tiny, at_once


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
