"""Counters from row to row: what is fresh, what repeats, what may be old."""

from __future__ import annotations

import numpy as np
import pytest

from tipforce.host.hand.counters import CounterCheck


@pytest.mark.parametrize(
    ("counters", "stale", "gaps", "verdicts"),
    [
        ([7, 8, 9], "", "", "..."),
        ([254, 255, 0, 1], "", "", "...."),
        ([7, 7, 8, 8, 9], "13", "", ".r.r."),  # a SYNC faster than the converter, and the node says so
        ([7, 7, 9], "", "", ".d."),  # the same answer once more: a duplicate that came late
        ([7, -1, 9], "", "", "..."),  # an answer lost on its way
        ([7, -1, 8, 10], "", "", "..d."),  # late, and then in time
        ([7, -1, 8, 9, 11], "", "", "..dd."),  # twice late
        ([7, -1, 8, 9, 10, 11, 12], "", "", "..ddd.."),  # the node missed a SYNC
        ([7, -1, 8, 8, 9, 10, 11], "3", "", "..dddd."),
        ([7, -1, -1, 10], "", "", "...."),
        ([7, -1, -1, 9, 11], "", "", "...d."),
        ([7, 9, 10], "", "01", "..."),  # the host missed a SYNC, and its times show a gap
        ([7, 9, 10, 11, 12], "", "", ".ddd."),  # ahead without a gap
        ([7, 8, 9], "", "01", "..."),  # the SYNC that lacks was never sent
        ([7, -1, 10, 11], "", "01", "...."),
        ([7, 8, 10], "", "01", "..d"),  # the gap is behind it
        ([7, 6, 9], "", "", ".d."),  # an old one
        ([200, 1, 2, 3, 4, 5], "", "", ".ddd.."),  # a reboot
        ([7, 11, 12], "", "03", "..."),  # the host missed three SYNCs
        ([7, 42, 9, 10], "", "", ".d.."),  # a babbler's frame, and its counter happens to be ahead
        ([90, -1, -1, 1, 2, 3, 4, 5], "", "", "...ddd.."),
        ([-1, -1, 5, 6], "", "", "...."),
        ([7, 8] + [9] * 400, "", "", "..." + 399 * "d"),  # babbling: the same answer again and again
        ([7] + [-1] * 300 + [9, 10, 11, 12, 13], "", "", "." + 300 * "." + "ddd.."),
    ],
)
def test_verdicts(counters: list[int], stale: str, gaps: str, verdicts: str) -> None:
    column = np.array(counters)[:, None]
    marks = np.array([k < 10 and str(k) in stale for k in range(len(counters))])[:, None]
    lacking = np.array([int(k) for k in gaps.ljust(len(counters), "0")])
    t_ns = np.arange(len(counters)) * 340_000_000  # four of them are more than a second
    for cut in range(len(counters)):
        check = CounterCheck(1)
        parts = [
            check.check(column[a], marks[a], marks[a] & False, lacking[a], t_ns[a])
            for a in (slice(None, cut), slice(cut, None))
        ]
        repeated = np.concatenate([part[0] for part in parts])[:, 0]
        doubtful = np.concatenate([part[1] for part in parts])[:, 0]
        assert "".join("r" if r else "d" if d else "." for r, d in zip(repeated, doubtful, strict=True)) == verdicts


def test_doubt_takes_a_second_however_fast_the_rows_are() -> None:
    check = CounterCheck(1)
    counter = np.array([7, -1, *range(8, 200)])[:, None]
    nothing = np.zeros(len(counter), dtype=np.int64)
    _, doubtful = check.check(counter, counter < -1, counter < -1, nothing, np.arange(len(counter)) * 10_000_000)
    assert np.flatnonzero(doubtful[:, 0]).tolist() == list(range(2, 102))


def test_a_finger_that_booted_is_not_doubted() -> None:
    check = CounterCheck(2)
    nothing, t_ns = np.zeros(2, dtype=np.int64), np.arange(2) * 10_000_000
    no = np.zeros((2, 2), dtype=np.bool_)
    check.check(np.array([[7, 7], [8, 8]]), no, no, nothing, t_ns)
    check.forget(1)
    _, doubtful = check.check(np.array([[1, 1], [2, 2]]), no, no, nothing, t_ns)
    assert doubtful.tolist() == [[True, False], [True, False]]
    assert check.expected().tolist() == [11, 3]


def test_what_is_proved_is_believed_and_counted_from() -> None:
    check = CounterCheck(1)
    no, nothing, t_ns = np.zeros((4, 1), dtype=np.bool_), np.zeros(4, dtype=np.int64), np.arange(4) * 10_000_000
    _, doubtful = check.check(np.array([[7], [13], [13], [14]]), no, no, nothing, t_ns)
    assert doubtful[:, 0].tolist() == [False, True, True, True]
    check = CounterCheck(1)
    _, doubtful = check.check(np.array([[7], [13], [14], [15]]), no, np.array([[0], [1], [0], [0]]) > 0, nothing, t_ns)
    assert not doubtful.any()
