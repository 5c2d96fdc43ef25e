"""Which SYNC each answer belongs to, by the node's 8-bit sample counter (2121h).

A PDO carries no SYNC number, so by its place in the stream an answer belongs to the last SYNC before it. A finger that
is late answers after the next SYNC. It then still answers every SYNC, in order: its counters count on by one (or by
none, for a sample that is sent again and marked stale), and the last is the one that a finger in time would have now.
Only then the counters decide, and each answer goes to the row of its own SYNC. What fits less well stays where it is,
to be doubted (counters.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.columns import Column

MOST_ANSWERS = 4
"""To one SYNC, that lateness and duplicates explain."""

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(slots=True, eq=False)
class Answers:
    """What fingers said in one message since the first open SYNC, n times: each finger's answers stand together, in
    the order in which they came. All arrays (n,)."""

    message: int
    """Its number among those that the rows are made of."""
    finger: IntArray
    row: IntArray
    """Counted from the first open SYNC; the one before the answer, until ``seat`` knows better."""
    frame: IntArray
    """Which of the frames it was."""
    counter: IntArray
    columns: dict[str, Column]
    waiting: BoolArray
    """Late, or so it seems: what comes next will tell to which row it belongs."""
    moved: BoolArray
    """Came after the next SYNC, and was put into its own row."""
    proved: BoolArray
    """Its row is certain: it is one of a finger that was late, and has answered every SYNC since."""


def seat(answers: Answers, expected: IntArray, in_time: BoolArray, regular: BoolArray) -> None:
    """Move late answers to their rows, and mark those of which that can't be said yet.

    ``expected`` (k,): the counter with which each finger would answer the first open SYNC, -1 where that is unknown.
    ``in_time`` (n,): the answer came within a period after the SYNC before it. ``regular`` (m,): SYNC r came one period
    after the one before, or what was before is known. Both say that there was no SYNC in between that did not reach the
    host: with one, a finger that had missed another would seem to be in time again.
    """
    of_finger = expected[answers.finger]
    lag = (of_finger + answers.row - answers.counter - _repeats(answers) + 128) % 256 - 128
    lag[of_finger < 0] = 0
    if not (lag > 0).any():
        return
    for finger in np.unique(answers.finger[lag > 0]).tolist():
        which = np.flatnonzero(answers.finger == finger)
        if _in_order(answers, which, lag[which]):
            last = which[-1]
            late = lag[which] > 0
            if lag[last] == 0 and in_time[last] and regular[: answers.row[last] + 1].all():
                answers.row[which] -= lag[which]  # below 0: its row was given out long ago
                answers.moved[which], answers.proved[which] = late, True
            else:
                answers.waiting[which] = late


def _repeats(answers: Answers) -> IntArray:
    """(n,) how many samples each finger had sent twice so far: those answers are marked stale, and count on by none."""
    stale = answers.columns["stale"]
    if not stale.any():
        return np.zeros(len(stale), dtype=np.int64)
    count: IntArray = np.cumsum(stale)
    begins = np.flatnonzero(np.diff(answers.finger, prepend=-1))
    before: IntArray = np.repeat((count - stale)[begins], np.diff(begins, append=len(count)))
    return count - before


def _in_order(answers: Answers, which: IntArray, lag: IntArray) -> bool:
    """Whether answers of one finger look like those of one that is late: each the next sample, none from the future."""
    steps = np.diff(answers.counter[which]) % 256 + answers.columns["stale"][which][1:]
    return bool((steps == 1).all() and (lag >= 0).all())


def babbled(answers: Answers, first: int, shape: tuple[int, int]) -> BoolArray:
    """Where in the rows from ``first`` on, ``shape`` (m, k), answers came to one SYNC that lateness does not explain.

    A late answer and the one in time count on by one, a duplicate by none. Anything else, or MOST_ANSWERS of them, is a
    babbler or a second node with the same COB-ID, and no answer in the row can be told from the others.
    """
    rows, fingers = shape
    found = np.zeros(shape, dtype=np.bool_)
    same = (np.diff(answers.row) == 0) & (np.diff(answers.finger) == 0)
    if same.any():
        row = answers.row - first
        inside = (row >= 0) & (row < rows)
        odd = np.flatnonzero(same & (np.diff(answers.counter) % 256 > 1) & inside[1:]) + 1
        found[row[odd], answers.finger[odd]] = True
        place = row[inside] * fingers + answers.finger[inside]
        found |= (np.bincount(place, minlength=rows * fingers) >= MOST_ANSWERS).reshape(shape)
    return found
