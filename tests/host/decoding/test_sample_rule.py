"""The compiled core joins frames to rows as the Python body does, on sequences with all that a bus may do."""

import random
import struct
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tipforce.core import core
from tipforce.host.decoding import sample_rule
from tipforce.host.decoding.sample_rule import GAP_FRAMES, GAP_NS, SLOT, Joined, join
from tipforce.host.frames.frame_array import FRAME, PACK_FRAME, FrameArray

SENDERS = 3
KINDS = [  # message number, length, follows SYNC, place of the counter
    (1, 8, 1, 56), (2, 8, 1, 56), (3, 7, 1, 48), (4, 8, 0, 48), (200, 3, 0, 16), (5, 4, 0, -1), (6, 8, 1, -1),
]  # fmt: skip


def slot(sender: int, group: int) -> tuple[int, ...]:
    """A message of a node, as SLOT has it."""
    number, length, cyclic, shift = KINDS[group]
    used = (number + sender) % 7 != 0
    return sender, group, shift, 255, number, length, cyclic and shift >= 0, used, sender + 5, (256, 240, 3)[sender]


LAYOUTS = np.array(
    [(0, 0, -1, 0, 0, 0, 0, 0, 0, 0)]
    + [slot(sender, group) for group in range(len(KINDS)) for sender in range(SENDERS)],
    dtype=SLOT,
)
Sequence = tuple[FrameArray, npt.NDArray[np.uint32]]


def sequence(seed: int) -> Sequence:
    """PDOs of some nodes, with frames lost, repeated, swapped, short, foreign and late, and times that go back."""
    pick = random.Random(seed)
    lost, again, swapped, event, odd = (pick.choice((0.0, 0.05, 0.3)) for _ in range(5))
    step = pick.choice((0, 1_000, GAP_NS // 3, GAP_NS // 2))
    rows: list[tuple[int, int, int]] = []  # slot, counter, length beyond the least
    for latch in range(pick.randrange(1, 60)):
        here = []
        counter = pick.choice((latch % 256, latch // 2 % 256, 1 + latch % 3))
        for kind in range(len(KINDS)):
            for sender in range(SENDERS):
                if pick.random() >= (lost if KINDS[kind][2] else 1 - event):
                    here += [(1 + kind * SENDERS + sender, counter, 0)] * (1 + (pick.random() < again))
        if pick.random() < swapped:
            pick.shuffle(here)
        rows += here
        if pick.random() < odd:
            rows.append(pick.choice([(0, 0, 0), (pick.randrange(1, len(LAYOUTS)), counter, -1)]))
    t_ns, packed, gaps = 10 * GAP_NS, bytearray(), (0, 0, 0, step, step, GAP_NS, GAP_NS + 1, -GAP_NS, -GAP_NS - 1)
    for slot, counter, more in rows:
        t_ns = max(t_ns + (pick.choice(gaps) if pick.random() < 0.2 else step // 7), 0)
        shift, length = int(LAYOUTS["shift"][slot]), int(LAYOUTS["length"][slot]) + more
        word = pick.getrandbits(64)
        if shift >= 0:
            word = word & ~(0xFF << shift) | counter << shift
        packed += PACK_FRAME(t_ns, slot, max(length, 0), 0, 0, struct.pack("<Q", word))
    return np.frombuffer(packed, dtype=FRAME), np.array([row[0] for row in rows], dtype=np.uint32)


def joined(given: Sequence, cuts: list[int], number: int) -> list[Any]:
    """All that a body says of a sequence in blocks, the held frames before each."""
    frames, slots = given
    held, of_held, numbers = frames[:0], slots[:0], np.zeros(0, dtype=np.int64)
    said: list[Any] = []
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames), len(frames)]
    for at, (start, end) in enumerate(pairwise(edges)):
        block, kinds = np.concatenate((held, frames[start:end])), np.concatenate((of_held, slots[start:end]))
        found: Joined = join(block, kinds, LAYOUTS, numbers, number, last=at == len(edges) - 2)
        said.append([value.tolist() if isinstance(value, np.ndarray) else value for value in found])
        held, of_held, numbers, number = block[found.held], kinds[found.held], found.held_number, found.number
    assert not len(held)
    return said


def rows_of(said: list[Any]) -> list[int]:
    """The number of frames of each row, over all blocks."""
    return [count for _, row, first, *_ in said for count in np.bincount(row, minlength=len(first)).tolist()]


@pytest.mark.skipif(core is None, reason="needs the compiled core")
@pytest.mark.parametrize("seed", range(40))
def test_both_bodies_say_the_same_in_any_blocks(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for part in range(10):
        given, pick = sequence(100 * seed + part), random.Random(seed)
        cuts = [pick.randrange(len(given[0]) + 1) for _ in range(pick.randrange(6))]
        number = pick.choice((0, 1 << 40))
        of_core = joined(given, cuts, number)
        with monkeypatch.context() as without:
            without.setattr(sample_rule, "core", None)
            assert joined(given, cuts, number) == of_core
        if (np.diff(given[0]["t_ns"]) >= 0).all():
            assert rows_of(joined(given, [], number)) == rows_of(of_core)


@pytest.mark.parametrize("body", ["core", "python"])
def test_a_row_ends_after_the_longest_gap_in_frames(body: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without times, a node that is silent for so many frames of others begins a row."""
    if body == "python":
        monkeypatch.setattr(sample_rule, "core", None)
    for others, frames_of_row in ((GAP_FRAMES - 1, 2), (GAP_FRAMES, 1)):
        slots = np.array([1, *[0] * 5, *[3] * others, 1 + SENDERS], dtype=np.uint32)
        data = struct.pack("<Q", 7 << 56)
        frames = np.frombuffer(b"".join(PACK_FRAME(0, 0, 8, 0, 0, data) for _ in slots), dtype=FRAME)
        found = join(frames, slots, LAYOUTS, np.zeros(0, dtype=np.int64), 0, last=True)
        assert np.bincount(found.row)[0] == frames_of_row
        held = join(frames[:-1], slots[:-1], LAYOUTS, np.zeros(0, dtype=np.int64), 0, last=False)
        assert (held.held[:1].tolist() == [0]) == (frames_of_row == 2)


@pytest.mark.skipif(core is None, reason="needs the compiled core")
def test_the_core_refuses_what_does_not_fit() -> None:
    """Lengths that do not fit each other, and slots that no layout has."""
    frames, slots, none = np.zeros(2, dtype=FRAME), np.zeros(2, dtype=np.uint32), np.zeros(0, dtype=np.int64)
    good: list[Any] = [frames, slots, LAYOUTS, none, 0, 1, 1, True, np.zeros((6, 2), dtype=np.int64)]
    assert core.join(*good) == (0, 0, 0, [], [], [])
    far = LAYOUTS.copy()
    far["group"] = len(LAYOUTS)
    bad = (1, slots[:1]), (1, slots + len(LAYOUTS)), (2, LAYOUTS[:0]), (2, far), (4, 1 << 62), (5, -1), (8, good[8][:5])
    for place, value in (*bad, (3, np.full(1, 1 << 62))):
        with pytest.raises(ValueError, match="join"):
            core.join(*[value if k == place else given for k, given in enumerate(good)])
