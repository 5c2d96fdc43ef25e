"""Fingers that are late, by hand and at random, on buses that lose frames: which SYNC is each value of?"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.collector import Collector

WAIT_MS, WARM_UP, FINGERS = 20, 8, 2


@dataclass
class Finger:
    """Answers each SYNC that it gets with P = the SYNC's number (mN), at once or when it is no longer busy.

    A ``slow`` one has a single conversion for all that waited: the others repeat it, and say that it is stale.
    """

    node_id: int
    slow: bool = False
    counter: int = 250
    waiting: list[int] = field(default_factory=list)
    strange: list[bytes] = field(default_factory=list)

    def sync(self, number: int) -> None:
        self.waiting.append(number)

    def flush(self) -> list[bytes]:
        found, self.strange = self.strange, []
        for k, number in enumerate(self.waiting):
            stale = self.slow and k > 0
            self.counter += not stale
            P, status = (-0x8000, 11) if stale else (number, 3)
            found.append(struct.pack("<hhhBB", P, 4500, 3000, status, self.counter % 256))
        self.waiting = []
        return found


@dataclass(frozen=True)
class Step:
    """What goes wrong with one SYNC; of fingers, their numbers."""

    unheard: bool = False
    """The host does not receive the SYNC."""
    missed: frozenset[int] = frozenset()
    """The finger does not receive it."""
    busy: frozenset[int] = frozenset()
    """Its answers wait."""
    lost: frozenset[int] = frozenset()
    """What it sends now does not reach the host."""
    pause_ms: int = 0
    """Before it: the SYNC's sender was busy, too."""


WELL = Step()


class World:
    """A SYNC every millisecond, numbered; what the host showed, by the number of the row's SYNC."""

    def __init__(self, wait_ms: int = WAIT_MS, own_sync: bool = False, slow: bool = False) -> None:
        self.fingers = [Finger(n + 1, slow) for n in range(FINGERS)]
        self.collector = Collector(
            [finger.node_id for finger in self.fingers], wait_s=wait_ms * 1e-3, own_sync=own_sync
        )
        self.heard: list[int] = []
        self.shown: list[list[int | None]] = []
        self._number = 0
        self._now_ms = 0

    def run(self, steps: list[Step], cuts: list[int] | None = None) -> None:
        """``cuts``: how the frames of each SYNC fall into blocks."""
        for k, step in enumerate(steps):
            frames = self._step(step)
            cut = cuts[k % len(cuts)] if cuts else len(frames)
            self._host(frames[:cut])
            self._host(frames[cut:])

    def _step(self, step: Step) -> list[tuple[int, int, bytes]]:
        self._number += 1
        self._now_ms += 1 + step.pause_ms
        t_ns = self._now_ms * 1_000_000
        frames = [] if step.unheard else [(t_ns, 0x80, b"")]
        self.heard += [] if step.unheard else [self._number]
        for k, finger in enumerate(self.fingers):
            if k not in step.missed:
                finger.sync(self._number)
            if k not in step.busy:
                said = finger.flush()
                frames += [] if k in step.lost else [(t_ns + 1000 * k, 0x280 + finger.node_id, data) for data in said]
        return frames

    def _host(self, frames: list[tuple[int, int, bytes]]) -> None:
        rows = self.collector.add(frame_array(frames), self._now_ms * 1e-3)
        for row, P in enumerate(rows.columns["P"]):
            assert rows.first + row == len(self.shown)
            self.shown.append([None if np.isnan(value) else round(value * 1000) for value in P])

    def exact(self) -> bool:
        """Each row that was given out is whole, and each value is the one of its SYNC."""
        rows = zip(self.heard[WARM_UP:], self.shown[WARM_UP:], strict=False)
        return all(values == [number] * FINGERS for number, values in rows)

    def check(self) -> None:
        """No value is of another row's SYNC. (One of a SYNC that the host did not hear may stand beside its place.)"""
        before, after = [0, *self.heard], [*self.heard[1:], self._number + 1]
        for low, high, values in zip(before, after, self.shown, strict=False):
            assert all(value is None or low < value < high for value in values), (low, high, values)


def busy(finger: int, rows: int) -> list[Step]:
    return [Step(busy=frozenset({finger}))] * rows


def settle() -> list[Step]:
    """More than a second, after which every doubt has ended."""
    return [*[WELL] * 4, *[Step(pause_ms=400)] * 6, *[WELL] * 30]


def warm() -> list[Step]:
    return [WELL] * WARM_UP


@pytest.mark.parametrize("rows", [1, 2, 5, 19])
def test_a_finger_that_is_late_loses_nothing(rows: int) -> None:
    world = World()
    world.run([*warm(), *busy(1, rows)])
    assert len(world.shown) == WARM_UP  # the others wait
    world.run([WELL])
    assert len(world.shown) == WARM_UP + rows + 1
    assert world.exact()
    tally = world.collector.tally
    assert (tally.delayed.tolist(), tally.missing[0]) == ([0, rows], 0)
    assert (tally.late + tally.doubtful).tolist() == [0, 0]


@given(
    st.lists(st.lists(st.frozensets(st.integers(0, FINGERS - 1)), min_size=1, max_size=12), max_size=6),
    st.lists(st.integers(0, 12), min_size=1, max_size=9),
)
def test_however_long_and_however_cut(stalls: list[list[frozenset[int]]], cuts: list[int]) -> None:
    """Several fingers at a time, each for less than the waiting time, and blocks that end in the middle of a burst."""
    steps = warm()
    for stall in stalls:
        steps += [Step(busy=fingers) for fingers in stall] + [WELL]
    world = World()
    world.run(steps, cuts)
    assert len(world.shown) == len(steps)
    assert world.exact()
    assert world.collector.tally.late.tolist() == [0, 0]


def test_an_answer_that_was_lost_is_not_waited_for() -> None:
    world = World()
    world.run([*warm(), Step(lost=frozenset({1}))])
    assert len(world.shown) == WARM_UP
    world.run([WELL])
    assert world.shown[WARM_UP:] == [[WARM_UP + 1, None], [WARM_UP + 2, WARM_UP + 2]]


def test_beside_gaps_only_the_sender_of_the_sync_knows() -> None:
    steps = [*warm(), *busy(1, 3), Step(pause_ms=5, busy=frozenset({1})), WELL]
    own, listener = World(own_sync=True), World()
    own.run(steps)
    assert len(own.shown) == len(steps)
    assert own.exact()
    listener.run([*steps, *[WELL] * 2 * WAIT_MS])
    assert listener.collector.tally.delayed.tolist() == [0, 0]
    listener.check()
    dropped = World(own_sync=True)
    dropped.run(steps[:-1])
    dropped.collector.drop()  # by the kernel: perhaps a SYNC
    dropped.run([WELL, *[WELL] * 2 * WAIT_MS])
    assert dropped.collector.tally.delayed.tolist() == [0, 0]
    dropped.check()


@pytest.mark.parametrize("cuts", [[1], [9]], ids=["SYNC alone", "all at once"])
def test_after_a_drop_the_sender_knows_again(cuts: list[int]) -> None:
    world = World(own_sync=True)
    world.run(warm(), cuts)
    world.collector.drop()
    world.run([WELL, WELL, *busy(1, 3), WELL], cuts)
    assert world.exact()
    assert world.collector.tally.delayed.tolist() == [0, 3]


def test_one_that_is_busy_for_too_long_is_not_waited_for_again() -> None:
    world = World()
    world.run([*warm(), *busy(1, WAIT_MS + 1)])
    # The first row timed out; with it goes all up to the one that still has no SYNC after it.
    assert len(world.shown) == WARM_UP + WAIT_MS
    world.run(busy(1, 5))
    assert len(world.shown) == WARM_UP + WAIT_MS + 5
    assert [values[1] for values in world.shown[WARM_UP:]] == [None] * (WAIT_MS + 5)
    world.run([WELL, WELL])
    assert world.shown[-2:] == [[n, n] for n in world.heard[-2:]]  # the burst's last one is in time
    tally = world.collector.tally
    assert (tally.late.tolist(), tally.doubtful.tolist()) == ([0, WAIT_MS + 5], [0, 0])
    world.check()


@pytest.mark.parametrize("rows", [3, WAIT_MS + 20])
def test_one_conversion_for_all_that_waited_is_no_lateness(rows: int) -> None:
    """Its counter stands still meanwhile, and is never again what the number of rows would have it be."""
    world = World(own_sync=True, slow=True)
    world.run([*warm(), *busy(1, rows), *[WELL] * 20])
    assert len(world.shown) == len(world.heard)
    assert world.shown[-19:] == [[n, n] for n in world.heard[-19:]]
    assert world.collector.tally.doubtful.tolist() == [0, 0]
    world.check()


def test_a_finger_that_missed_a_sync_is_doubted_and_not_moved() -> None:
    world = World()
    world.run([*warm(), Step(missed=frozenset({1})), *settle()])
    world.check()
    tally = world.collector.tally
    assert (tally.delayed.tolist(), tally.late.tolist()) == ([0, 0], [0, 0])
    assert tally.doubtful[0] == 0
    assert tally.doubtful[1] >= 6
    assert world.shown[-1] == [world.heard[-1]] * FINGERS


def test_a_sync_that_the_host_did_not_hear_hides_no_lateness() -> None:
    """The finger missed one, the host another: the counter is right again, and says nothing about the rows between."""
    world = World()
    steps = [Step(missed=frozenset({1})), WELL, WELL, Step(unheard=True), WELL, WELL]
    world.run([*warm(), *steps, *[WELL] * 20])
    world.check()
    assert world.collector.tally.delayed.tolist() == [0, 0]


def test_a_burst_that_begins_too_early_is_not_moved() -> None:
    """Somebody else speaks with the finger's COB-ID while it is busy."""
    world = World()
    world.run([*warm(), *busy(1, 3)])
    stranger = struct.pack("<hhhBB", 9000, 4500, 3000, 3, (world.fingers[1].counter - 4) % 256)
    world.fingers[1].strange.append(stranger)
    world.run([WELL, *[WELL] * 2 * WAIT_MS])
    world.check()
    assert world.collector.tally.delayed.tolist() == [0, 0]


def some(one_in: int) -> st.SearchStrategy[frozenset[int]]:
    """One finger in so many SYNCs, or none."""
    return st.integers(0, one_in * FINGERS - 1).map(lambda k: frozenset({k}) if k < FINGERS else frozenset())


LATE = st.builds(Step, missed=some(10), busy=some(3), lost=some(10), pause_ms=st.sampled_from([0, 0, 0, 2]))
UNHEARD = st.builds(Step, unheard=st.integers(0, 9).map(lambda k: k == 0), missed=some(10), lost=some(10))


@pytest.mark.parametrize(
    ("kinds", "own_sync", "slow"),
    [(LATE, False, False), (LATE, True, False), (LATE, True, True), (UNHEARD, False, False)],
    ids=["late", "late, own SYNC", "late, slow", "unheard"],
)
@given(st.data(), st.lists(st.integers(0, 8), min_size=1, max_size=5), st.sampled_from([2, 5, 20]))
def test_no_value_is_of_another_row(
    kinds: st.SearchStrategy[Step], own_sync: bool, slow: bool, data: st.DataObject, cuts: list[int], wait_ms: int
) -> None:
    """SYNCs and answers that are lost on either side, and fingers that are busy: what is shown is of its own time.

    Not both at once: a SYNC that the host did not hear beside a late finger can't be told from one that was not sent.
    """
    world = World(wait_ms, own_sync, slow)
    world.run([*warm(), *data.draw(st.lists(kinds, max_size=60)), *settle()], cuts)
    world.check()
    assert world.shown[-1] == [world.heard[len(world.shown) - 1]] * FINGERS  # and all is well again
