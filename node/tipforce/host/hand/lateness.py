"""Find the SYNC of each answer by the node's 8-bit sample counter (2121h).

A PDO has no SYNC number, so by its position in the stream an answer belongs to the last SYNC before it. A late finger
answers after the next SYNC. It still answers every SYNC, in order: its counters increment by one (or by zero, for a
sample that is sent again and marked stale), and the last equals that of a finger in time. Only then do the counters
decide, and each answer is assigned to the row of its own SYNC. Any other answer stays in its row, as doubtful
(counters.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.columns import Column

MOST_ANSWERS = 4
"""Answers to one SYNC that lateness and duplicates explain."""

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(slots=True, eq=False)
class Answers:
    """Answers of the fingers in one message since the first open SYNC, n in all: each finger's answers are consecutive,
    in the order of reception. All arrays (n,)."""

    message: int
    """Its index among the messages of a row."""
    finger: IntArray
    row: IntArray
    """Counted from the first open SYNC; that before the answer, unless ``seat`` corrects it."""
    frame: IntArray
    """Index of its frame."""
    counter: IntArray
    columns: dict[str, Column]
    waiting: BoolArray
    """Probably late: the following answers decide its row."""
    moved: BoolArray
    """Received after the next SYNC, and assigned to its own row."""
    proved: BoolArray
    """Its row is certain: its finger was late, and has answered every SYNC since."""


def seat(answers: Answers, expected: IntArray, in_time: BoolArray, regular: BoolArray) -> None:
    """Move late answers to their rows, and mark those whose row is still unknown.

    ``expected`` (k,): the counter with which each finger would answer the first open SYNC, -1 if it is unknown.
    ``in_time`` (n,): the answer arrived within a period after the SYNC before it. ``regular`` (m,): SYNC r arrived one
    period after the previous one, or the gap before it is known. Both exclude a SYNC in between that did not reach the
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
                answers.row[which] -= lag[which]  # below 0: its row was already emitted
                answers.moved[which], answers.proved[which] = late, True
            else:
                answers.waiting[which] = late


def _repeats(answers: Answers) -> IntArray:
    """Return (n,) how many samples each finger had repeated so far: those are marked stale, without an increment."""
    stale = answers.columns["stale"]
    if not stale.any():
        return np.zeros(len(stale), dtype=np.int64)
    count: IntArray = np.cumsum(stale)
    begins = np.flatnonzero(np.diff(answers.finger, prepend=-1))
    before: IntArray = np.repeat((count - stale)[begins], np.diff(begins, append=len(count)))
    return count - before


def _in_order(answers: Answers, which: IntArray, lag: IntArray) -> bool:
    """Return whether answers of one finger look late: each the next sample, none ahead of time."""
    steps = np.diff(answers.counter[which]) % 256 + answers.columns["stale"][which][1:]
    return bool((steps == 1).all() and (lag >= 0).all())


def babbled(answers: Answers, first: int, shape: tuple[int, int]) -> BoolArray:
    """Return where in the rows from ``first`` on, ``shape`` (m, k), answers to one SYNC are not explained by lateness.

    A late answer and the one in time differ by one, a duplicate by zero. Anything else, or MOST_ANSWERS of them, is a
    babbler or a second node with the same COB-ID, and the node's own answer cannot be identified.
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
