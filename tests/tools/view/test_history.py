"""The ring keeps the newest rows in order; envelopes lose neither an extreme nor a gap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.samples.reasons import NO_ANSWER
from tipforce_tools.view.history import MAX_BYTES, History, row_bytes
from tools.view.support import MS, START_NS, block, with_status


@given(st.lists(st.integers(0, 25), max_size=30), st.integers(1, 20))
def test_the_newest_rows_stay(sizes: list[int], capacity: int) -> None:
    history, total = History(1, 3, capacity), 0
    for size in sizes:
        number = np.arange(total, total + size)
        history.append(block(number, number[:, np.newaxis])) if size else None
        total += size
    kept = np.arange(max(0, total - capacity), total)
    assert history.rows.contact[:, 0, 0].tolist() == kept.tolist()
    assert history.t_ns.tolist() == (START_NS + kept * MS).tolist()
    assert history.dropped == total - len(kept)


@given(st.lists(st.floats(-5, 5, width=32) | st.none(), min_size=1, max_size=80), st.integers(1, 30))
def test_an_envelope_keeps_extremes_and_gaps(values: list[float | None], width_ms: int) -> None:
    P = np.array([[np.nan if value is None else value] for value in values])
    history = History(1, 3, 100)
    history.append(block(np.arange(len(P)), P))
    width_ns = width_ms * MS
    first, last = START_NS // width_ns, (START_NS + len(P) * MS) // width_ns
    found = history.envelope(first, last, width_ns)
    numbers = (START_NS + np.arange(len(P)) * MS) // width_ns
    assert found.index.tolist() == np.unique(numbers).tolist()
    for k, number in enumerate(found.index):
        inside = P[numbers == number, 0]
        known = inside[~np.isnan(inside)]
        assert found.unknown[k, 0] == np.isnan(inside).sum()
        if len(known):
            assert (found.low[k, 0, 0], found.high[k, 0, 0]) == (
                pytest.approx(known.min()), pytest.approx(known.max()),
            )  # fmt: skip
        else:
            assert np.isnan(found.low[k, 0, 0])
            assert np.isnan(found.high[k, 0, 0])


def test_a_missing_finger_is_a_gap_of_the_envelope() -> None:
    history = History(2, 3, 100)
    history.append(with_status(block([0, 1, 2], np.ones((3, 2))), 1, 1, NO_ANSWER))
    found = history.envelope(START_NS // (10 * MS), START_NS // (10 * MS), 10 * MS)
    assert found.unknown.tolist() == [[0, 1]]


def test_nothing_gives_an_empty_envelope() -> None:
    history = History(2, 3, 10)
    assert len(history.envelope(0, 10, MS).index) == 0
    history.append(block([0], [[1.0, 2.0]]))
    assert len(history.envelope(0, 10, MS).index) == 0


def test_a_clock_that_is_set_back_does_not_disorder_rows() -> None:
    history = History(1, 3, 100)
    history.append(block([0, 10, 20], np.ones((3, 1))))
    history.append(block([-5000, -4990], np.ones((2, 1))))
    history.append(block([-4980], np.ones((1, 1))))
    assert ((history.t_ns - START_NS) // MS).tolist() == [0, 10, 20, 20, 30, 40]


def test_more_fingers_find_their_places() -> None:
    history = History(2, 3, 10)
    history.append(block([0, 1], [[1.0, 3.0], [1.5, 3.5]]))
    wider = history.widened(np.array([0, 2]), 3)
    assert wider.rows.contact[:, [0, 2], 0].tolist() == [[1.0, 3.0], [1.5, 3.5]]
    assert (wider.rows.status[:, 1] == NO_ANSWER).all()
    assert np.isnan(wider.rows.contact[:, 1]).all()


@pytest.mark.parametrize("count", [1, 5, 15, 32])
def test_memory_is_bounded(count: int) -> None:
    assert 2 * History(count, 3).capacity * row_bytes(count, 3) <= MAX_BYTES


def test_envelopes_of_gauges_and_forces() -> None:
    history = History(2, 4, 10)
    rows = block([0, 1], [[1.0, 2.0], [3.0, np.nan]], gauges=4)
    rows.gauges[1, 0] = [-250.0, 1.0, 2.0, np.nan]
    history.append(rows)
    first = START_NS // (10 * MS)
    gauges = history.envelope(first, first, 10 * MS, "gauges")
    assert gauges.low[0, 0].tolist() == [-250.0, 1.0, 2.0, 100.0]
    assert gauges.high[0, 0].tolist() == [100.0, 100.0, 100.0, 100.0]
    assert np.isnan(gauges.u).all()
    forces = history.envelope(first, first, 10 * MS, "forces")  # phi -90, theta 90 degrees: F1 = -P, F2 = 0, F3 = 0
    assert forces.low[0, :, 0].tolist() == pytest.approx([-3.0, -2.0])
    assert forces.high[0, :, 0].tolist() == pytest.approx([-1.0, -2.0])
    assert forces.high[0, 0, 1:].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    assert forces.unknown.tolist() == [[0, 1]]
    assert history.largest() == (3.0, 250.0)
    assert History(1, 3, 10).largest() == (0.0, 0.0)
