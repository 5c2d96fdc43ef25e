"""Events of a hand: heartbeats, EMCY, babbling identifiers; frames and time in, events out."""

import pytest

from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.events import MOST_WAITED_S, WINDOW_S, BabbleWatch, Supervisor, waited_s
from tipforce.host.hand.rows import Collector
from tipforce.samples.reasons import NO_RESPONSE, PRESENT


def seen(supervisor: Supervisor, now_s: float, *frames: tuple[int, str]) -> list[tuple[int, str, int]]:
    array = frame_array([(0, can_id, bytes.fromhex(data)) for can_id, data in frames])
    return [(event.node_id, event.kind, event.code) for event in supervisor.add(array, now_s)]


def test_a_life() -> None:
    supervisor = Supervisor([5, 6], 0.25)
    assert seen(supervisor, 0.0) == []
    assert seen(supervisor, 10.0) == []  # what was never heard is not lost
    assert seen(supervisor, 10.0, (0x705, "00")) == [(5, "boot_up", 0)]
    assert seen(supervisor, 10.1, (0x705, "7f"), (0x705, "7f")) == [(5, "state", 127)]
    assert seen(supervisor, 10.2, (0x705, "05")) == [(5, "state", 5)]
    assert seen(supervisor, 10.44) == []
    assert seen(supervisor, 10.46) == [(5, "heartbeat_lost", 0)]
    assert supervisor.state_name(5) == "silent"
    assert seen(supervisor, 11.0) == []
    assert seen(supervisor, 11.0, (0x706, "7f")) == [(6, "heartbeat_back", 127)]
    assert seen(supervisor, 13.4) == []  # not operational: its heartbeat may be a slow one
    assert seen(supervisor, 13.6) == [(6, "heartbeat_lost", 0)]
    supervisor = Supervisor([5, 6], 0.25)
    assert seen(supervisor, 11.0, (0x705, "05")) == [(5, "heartbeat_back", 5)]
    assert seen(supervisor, 11.1, (0x705, "00"), (0x705, "7f")) == [(5, "boot_up", 0), (5, "state", 127)]
    assert supervisor.state_name(5) == "pre-operational"
    assert seen(supervisor, 11.2, (0x705, "05"), (0x705, "85")) == [(5, "state", 5)]  # the toggle bit of guarding


def test_emcy() -> None:
    supervisor = Supervisor([5])
    assert seen(supervisor, 0.0, (0x085, "3050010000000000"), (0x085, "0000000000000000")) == [
        (5, "emcy", 0x5030),
        (5, "emcy_reset", 0),
    ]
    array = frame_array([(0, 0x085, bytes.fromhex("3412810000000000"))])
    assert supervisor.add(array, 0.0)[0].text == "0x1234 generic error, error register 0x81"


def test_what_is_not_for_it() -> None:
    supervisor = Supervisor([5])
    frames = [(0x080, ""), (0x080, "01"), (0x707, "05"), (0x086, "30" * 8), (0x705, ""), (0x705, "0500"), (0x085, "30")]
    assert seen(supervisor, 0.0, *frames) == []
    assert seen(supervisor, 0.0, (0x085, "30" * 7)) == []
    # A remote frame of guarding, and a 29-bit identifier that ends the same.
    assert seen(supervisor, 0.0, (0x40000705, ""), (0x80000705, "05")) == []


def test_a_lost_bus_is_forgotten() -> None:
    supervisor = Supervisor([5])
    seen(supervisor, 0.0, (0x705, "05"))
    supervisor.forget()
    assert seen(supervisor, 9.0) == []
    assert seen(supervisor, 9.0, (0x705, "05")) == [(5, "heartbeat_back", 5)]


def test_frames_that_waited_are_judged_by_their_own_time() -> None:
    now_ns, second_ns = 1_800_000_000 * 10**9, 10**9
    frames = frame_array([(now_ns - second_ns, 0x705, b"\x05"), (now_ns - second_ns // 2, 0x705, b"\x05")])
    assert waited_s(frames, now_ns) == pytest.approx(0.5)
    assert waited_s(frames[:0], now_ns) == 0.0
    assert waited_s(frames, now_ns - second_ns) == 0.0  # stamps of the future
    assert waited_s(frames, now_ns + int(MOST_WAITED_S * second_ns)) == 0.0  # another clock


def windows(watch: BabbleWatch, *counts: dict[int, int], begin_s: float = 10.0) -> list[tuple[str, int, int]]:
    """Windows in which identifiers come so often: what happened."""
    found = watch.add(frame_array([]), begin_s)
    for number, window in enumerate(counts, start=1):
        frames = [(0, can_id, b"") for can_id, count in window.items() for _ in range(count)]
        found += watch.add(frame_array(frames), begin_s + number * (WINDOW_S + 1e-6))
    return [(event.kind, event.node_id, event.code) for event in found]


def test_four_times_the_sync_is_the_limit() -> None:
    # 100 Hz: 20 SYNCs in a window.
    assert windows(BabbleWatch(100.0), {0x80: 20, 0x283: 79}, {0x283: 80}) == []
    assert windows(BabbleWatch(100.0), {0x80: 20, 0x283: 82}) == [("babbling", 3, 0x283)]
    slow = {0x80: 1, 0x283: 1, 0x703: 20}  # heartbeats are more frequent than the SYNC
    assert windows(BabbleWatch(1.0, 100.0), slow, {0x283: 81}) == [("babbling", 3, 0x283)]
    assert windows(BabbleWatch(1.0), {0x80: 1, 0x283: 1}) == []


def test_at_the_limit_it_is_not_told_again_and_again() -> None:
    some = [{0x283: count, 0x001: 200} for count in (90, 70, 90, 50, 90, 30)]
    assert windows(BabbleWatch(100.0), *some, {0x001: 20}) == [
        ("babbling", 0, 0x001), ("babbling", 3, 0x283), ("babbling_end", 3, 0x283), ("babbling_end", 0, 0x001),
    ]  # fmt: skip


def test_sdo_lss_and_flagged_frames_are_none_of_it() -> None:
    ids = (0x583, 0x603, 0x67F, 0x7E4, 0x7E5, 0x80000283, 0x40000283)
    assert windows(BabbleWatch(100.0), dict.fromkeys(ids, 500)) == []


def test_without_a_rate_of_our_own_that_of_the_sync_on_the_bus_counts() -> None:
    assert windows(BabbleWatch(0.0), {0x80: 20, 0x283: 79}, {0x283: 1000}) == []
    assert windows(BabbleWatch(0.0), {0x80: 20, 0x283: 90}) == [("babbling", 3, 0x283)]


def test_what_waited_and_comes_at_once_is_judged_by_its_time_stamps() -> None:
    watch = BabbleWatch(100.0)
    watch.add(frame_array([]), 0.0)
    second_ns = 1_000_000_000
    late = [(second_ns + k * second_ns // 100, 0x283, b"") for k in range(100)]
    assert watch.add(frame_array(late[:90]), WINDOW_S / 2) == []
    assert watch.add(frame_array(late[90:]), WINDOW_S) == []


def test_a_finger_that_answers_no_sync_is_told_once_each_time() -> None:
    trust = Collector((1, 2), own_sync=True).trust
    trust.count_rows([(PRESENT, PRESENT)], 0.0)
    trust.count_rows([(PRESENT, NO_RESPONSE)] * 19, 2.0)
    assert trust.take_unanswered(2.0, 1.0) == []
    trust.count_rows([(PRESENT, NO_RESPONSE)], 2.0)
    assert trust.take_unanswered(2.0, 1.0) == [2]
    assert trust.take_unanswered(9.0, 1.0) == []
    trust.count_rows([(PRESENT, PRESENT)], 9.0)
    assert trust.take_unanswered(9.0, 1.0) == []
    trust.count_rows([(PRESENT, NO_RESPONSE)] * 20, 9.5)
    assert trust.take_unanswered(9.5, 1.0) == []
    assert trust.take_unanswered(10.1, 1.0) == [2]
