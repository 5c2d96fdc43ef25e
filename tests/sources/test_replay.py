"""Recordings as a gauge source: every row once, at its time; and none after the end."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.sources.replay import ReplaySource

CONVERTER, ENDS = (16, 10.0), (-32768, 32767)


def replay(times_us: list[int], **options: object) -> ReplaySource:
    rows = [(k, -k, 2 * k) for k in range(len(times_us))]
    return ReplaySource(times_us, rows, CONVERTER, ENDS, **options)  # type: ignore[arg-type]


@given(
    st.lists(st.integers(5, 5000), min_size=1, max_size=30), st.integers(0, 10**12), st.sampled_from([0.5, 1.0, 4.0])
)
def test_each_row_comes_once_and_in_time(steps: list[int], start_us: int, speed: float) -> None:
    times = [sum(steps[:k]) for k in range(len(steps) + 1)]
    source = replay([7_000_000 + time for time in times], speed=speed)
    for k, time in enumerate(times):
        reading = source.read(start_us + -int(-time // speed))
        assert reading is not None
        assert reading.counts == (k, -k, 2 * k)
        assert source.read(start_us + -int(-time // speed)) is None
    assert source.over
    assert source.read(start_us + 10**9) is None


def test_rows_that_were_missed_are_passed_over_and_gaps_are_no_reading() -> None:
    source = ReplaySource([0, 1000, 2000, 3000], [(1, 1, 1), None, (3, 3, 3), (4, 4, 4)], CONVERTER, ENDS)
    readings = [source.read(now_us) for now_us in (50, 1050, 1900, 3060)]
    assert [None if one is None else one.counts[0] for one in readings] == [1, None, None, 4]


def test_a_loop_begins_anew_after_the_median_step() -> None:
    source = replay([0, 1000, 2000], loop=True, temperatures=[2300, 2310, 2320])
    found = [source.read(now_us) for now_us in range(500, 10_000, 1000)]
    assert [one.counts[0] for one in found if one is not None] == [0, 1, 2] * 3 + [0]
    assert found[1] is not None
    assert found[1].temperature == 2310
    assert not source.over


@pytest.mark.parametrize(
    ("times", "options", "message"),
    [
        ([], {}, "0 rows"),
        ([0, 0], {}, "do not increase"),
        ([1, 0], {}, "do not increase"),
        ([0], {"speed": 0.0}, "speed 0.0"),
        ([0], {"speed": float("nan")}, "speed nan"),
        ([0], {"speed": float("inf")}, "speed inf"),
    ],
)
def test_what_cannot_be_replayed(times: list[int], options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replay(times, **options)
