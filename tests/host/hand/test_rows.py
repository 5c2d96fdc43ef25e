"""Rows: every way in which answers can come, by hand and at random, against what was sent."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.collector import Collector
from tipforce.host.hand.rows import Rows

SYNC = (0x80, b"")


def answer(
    node_id: int, counter: int, P_mN: int = 1000, message: str = "Contact", stale: bool = False
) -> tuple[int, bytes]:
    """A contact or gauge PDO of a calibrated finger in contact."""
    base = {"Contact": 0x280, "Gauges": 0x180}[message]
    return base + node_id, struct.pack("<hhhBB", P_mN, 4500, 3000, 11 if stale else 3, counter % 256)


class Stream:
    """Hands frames to a collector, with a SYNC every millisecond, and keeps the rows that come out."""

    def __init__(self, *node_ids: int, messages: tuple[str, ...] = ("Contact",), wait_s: float = 0.02) -> None:
        self.collector = Collector(node_ids, messages, wait_s=wait_s)
        self.rows: list[tuple[int, list[float]]] = []
        self.now_s = 0.0
        self._syncs = 0

    def add(self, *frames: tuple[int, bytes]) -> list[list[float]]:
        """P of each finger in the rows that came out."""
        timed = []
        for can_id, data in frames:
            self._syncs += can_id == 0x80
            timed.append((1_000_000 * self._syncs, can_id, data))
        array = frame_array(timed)
        rows: Rows = self.collector.add(array, self.now_s)
        column = rows.columns.get("P", rows.columns.get("SG1"))
        assert column is not None
        assert column.shape == rows.missing.shape == (len(rows), len(self.collector.node_ids))
        assert (np.isnan(column) >= rows.missing).all()
        self.rows += [(rows.first + k, column[k].tolist()) for k in range(len(rows))]
        return [[round(value, 3) for value in row] for row in column.tolist()]


def test_a_row_is_out_as_soon_as_it_is_whole() -> None:
    stream = Stream(1, 2)
    assert stream.add(answer(1, 7)) == []  # before any SYNC
    assert stream.add(SYNC, answer(2, 1, 200)) == []
    assert stream.add(answer(1, 1, 100)) == [[0.1, 0.2]]
    assert stream.add() == []
    assert stream.add(SYNC, answer(1, 2, 110), answer(2, 2, 210), SYNC, answer(1, 3, 120)) == [[0.11, 0.21]]
    assert stream.add(answer(2, 3, 220)) == [[0.12, 0.22]]
    assert [number for number, _ in stream.rows] == [0, 1, 2]
    tally = stream.collector.tally
    assert (tally.rows, tally.missing.tolist(), tally.late.tolist()) == (3, [0, 0], [0, 0])


def test_a_finger_that_does_not_answer_is_missing_in_time() -> None:
    stream = Stream(1, 2, wait_s=0.01)
    assert stream.add(SYNC, answer(1, 1, 100)) == []
    stream.now_s = 0.009
    assert stream.add() == []
    stream.now_s = 0.010
    (row,) = stream.add()
    assert row[0] == 0.1
    assert np.isnan(row[1])
    assert stream.add() == []
    assert stream.collector.tally.missing.tolist() == [0, 1]
    # It comes after all: too late for its row, and not to be taken for the next.
    assert stream.add(answer(2, 1, 200)) == []
    assert stream.add(SYNC, answer(1, 2, 110), answer(2, 2, 210)) == [[0.11, 0.21]]
    assert stream.collector.tally.late.tolist() == [0, 1]


def test_a_late_answer_is_not_shown_as_the_next() -> None:
    stream = Stream(1, 2)
    found = stream.add(SYNC, answer(1, 1, 100), SYNC, answer(2, 1, 200), answer(1, 2, 110), answer(2, 2, 210))
    assert found[1] == [0.11, 0.21]
    assert np.isnan(found[0][1])
    assert stream.collector.tally.late.tolist() == [0, 1]
    assert stream.collector.tally.missing.tolist() == [0, 1]


def test_late_answers_are_counted_once() -> None:
    stream = Stream(1, 2)
    stream.add(SYNC, answer(1, 1), answer(1, 1))
    stream.add(answer(1, 1))
    stream.add()
    stream.add(answer(2, 1))
    assert stream.collector.tally.late.tolist() == [2, 0]


def test_pdos_of_two_samples_are_mixed_and_not_shown() -> None:
    stream = Stream(1, messages=("Contact", "Gauges"))
    assert stream.add(SYNC, answer(1, 1), answer(1, 1, message="Gauges")) == [[1.0]]
    (row,) = stream.add(SYNC, answer(1, 2), answer(1, 3, message="Gauges"))
    assert np.isnan(row[0])
    tally = stream.collector.tally
    assert (tally.mixed.tolist(), tally.missing.tolist()) == ([1], [1])
    stream.add(SYNC, answer(1, 4), SYNC)
    stream.now_s = 0.02
    stream.add()
    assert (tally.mixed.tolist(), tally.missing.tolist()) == ([1], [3])


def test_a_babbler_hides_the_finger_and_not_the_others() -> None:
    stream = Stream(1, 2)
    stream.add(SYNC, answer(1, 1), answer(2, 1))
    (row,) = stream.add(SYNC, answer(1, 2), answer(1, 77, 9), answer(1, 77, 9), answer(2, 2), SYNC)
    assert np.isnan(row[0])
    assert row[1] == 1.0
    stream = Stream(1, 2)
    (row,) = stream.add(SYNC, *[answer(1, 77, 9)] * 5, answer(2, 2), SYNC)
    assert np.isnan(row[0])
    assert stream.collector.tally.doubtful.tolist() == [1, 0]


def test_a_babbler_whose_counter_fits_is_not_believed() -> None:
    """It comes first in each row, and its counter, which stands still, is at some time the one that is expected."""
    stream = Stream(1)
    for k in range(20):
        stream.add(SYNC)
        stream.add(answer(1, k))
    shown = []
    for k in range(20, 60):
        stream.add(SYNC)
        shown += stream.add(answer(1, 42, 9000))
        shown += stream.add(answer(1, k))
    assert not [row for row in shown if row[0] > 2.0]
    for k in range(60, 80):
        stream.add(SYNC)
        shown += stream.add(answer(1, k))
    assert shown[-10:] == [[1.0]] * 10


def test_two_nodes_with_one_cob_id_are_never_shown_as_one() -> None:
    stream = Stream(1)
    for k in range(1, 40, 2):
        stream.add(SYNC, answer(1, k), answer(1, k + 60, 2000), SYNC)
        stream.now_s += 0.1
        stream.add()
    assert len(stream.rows) == 40
    assert np.isnan([row for _, row in stream.rows]).all()


def test_a_repeated_sample_is_counted() -> None:
    stream = Stream(1)
    stream.add(SYNC, answer(1, 5), SYNC, answer(1, 5, stale=True))
    stream.add(SYNC, answer(1, 5, stale=True))
    stream.add(SYNC, answer(1, 6))
    assert stream.collector.tally.repeated.tolist() == [2]
    assert stream.add(SYNC, answer(1, 6)) == []  # the same again, and not marked stale: a duplicate, or late
    stream.now_s = 0.02
    (row,) = stream.add()
    assert np.isnan(row[0])
    assert stream.collector.tally.doubtful.tolist() == [1]


def test_columns_are_there_although_nobody_answers() -> None:
    stream = Stream(1, 2)
    (row, _) = stream.add(SYNC, SYNC, SYNC)
    assert np.isnan(row).all()
    rows = stream.collector.add(frame_array([]), 1.0)
    assert set(rows.columns) >= {"P", "phi", "theta", "contact", "stale", "fault"}
    assert rows.columns["stale"].dtype == np.bool_


@given(
    st.lists(st.tuples(st.booleans(), st.booleans(), st.permutations([0, 1])), max_size=30),
    st.lists(st.integers(1, 9), min_size=1, max_size=30),
)
def test_however_the_stream_is_cut(plan: list[tuple[bool, bool, list[int]]], cuts: list[int]) -> None:
    """Rows do not depend on how the frames were cut into blocks."""
    frames, expected = [], []
    for k, (first, second, order) in enumerate(plan):
        answers = [answer(1, k, 1 + k) if first else None, answer(2, k, 500 + k) if second else None]
        frames += [SYNC, *(a for a in (answers[i] for i in order) if a is not None)]
        expected.append([(1 + k) / 1000 if first else None, (500 + k) / 1000 if second else None])
    stream = Stream(1, 2, wait_s=1e9)
    place = 0
    for cut in [*cuts, len(frames)]:
        stream.add(*frames[place : place + cut])
        place += cut
    for _ in range(2):
        stream.now_s += 1e9
        stream.add(SYNC)
    found = [[None if np.isnan(v) else round(v, 3) for v in row] for _, row in stream.rows]
    assert found[: len(expected)] == expected
    assert [number for number, _ in stream.rows] == list(range(len(stream.rows)))
    missing = [sum(row[k] is None for row in expected) for k in (0, 1)]
    assert (stream.collector.tally.missing - missing).tolist() in ([0, 0], [1, 1])
    assert stream.collector.tally.late.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("node_ids", "messages"), [((), ("Contact",)), ((1, 1), ("Contact",)), ((1,), ()), ((1,), ("Health",))]
)
def test_what_is_no_hand(node_ids: tuple[int, ...], messages: tuple[str, ...]) -> None:
    with pytest.raises(InputError):
        Collector(node_ids, messages)
