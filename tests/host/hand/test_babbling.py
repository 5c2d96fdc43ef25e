"""Who talks too much, by identifiers and a clock of the test's own."""

from __future__ import annotations

from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.babbling import WINDOW_S, BabbleWatch


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
    assert watch.add(frame_array(late), WINDOW_S) == []
