"""The one rule by which PDOs of a latch become a sample. A PDO that follows SYNC continues the sample if the counter is
the same, the PDO a later one and the gap small; an event-driven PDO joins the last sample if that has its counter and
no PDO of its kind. Every other PDO is a sample alone."""

from collections import Counter
from collections.abc import Iterable
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.core import core
from tipforce.dictionary import table
from tipforce.dictionary.signals import Message, Signal
from tipforce.host.decoding.sample_table import NO_COUNTER, is_plain
from tipforce.host.frames.frame_array import FIELDS, FrameArray

COUNTER = "counter"
SAMPLES = table.SAMPLES
LAST_CYCLIC_TYPE = 240
"""CiA 301, table 72: up to this type a PDO follows SYNC."""
GAP_NS = 200_000_000
"""PDOs of a node further apart belong to different samples: 15 nodes with 4 PDOs at 50 kbit/s fit in this time."""
GAP_FRAMES = 8192
"""The same in decoded frames, which also works for logs without times."""

SLOT = np.dtype([
    ("sender", "<u4"), ("group", "<u4"), ("shift", "<i2"), ("mask", "<i2"), ("message", "u1"), ("length", "u1"),
    ("cyclic", "u1"), ("used", "u1"), ("key", "<u2"), ("modulus", "<u2"),
])  # fmt: skip
"""A message of a node. ``sender``: the node's number; ``group``: of messages that are decoded together; ``shift``,
``mask``, ``modulus``: of the counter, shift -1 for none; ``message``: ascending as a node sends its PDOs; ``length``:
at least, bytes; ``cyclic``: it follows SYNC; ``used``: 0 if it is left out; ``key``: channel and node."""

_MOST_COUNTER_BITS = 15
Ints = npt.NDArray[np.int64]


def counter_place(signals: Iterable[Signal]) -> tuple[int, int]:
    """Return (start bit, mask) of the counter; (-1, 0) where there is none, or it is no plain number."""
    for signal in signals:
        if signal.name == COUNTER and is_plain(signal) and not (signal.signed or signal.real):
            return (signal.start_bit, (1 << signal.bits) - 1) if signal.bits <= _MOST_COUNTER_BITS else (-1, 0)
    return -1, 0


def follows_sync(message: Message) -> bool:
    """Return whether a PDO follows SYNC."""
    return 1 <= message.transmission_type <= LAST_CYCLIC_TYPE


class _Last:
    """The last row of a node, and its last frame that follows SYNC."""

    __slots__ = ("counter", "events", "message", "number", "row", "t_ns")

    def __init__(self, row: int, counter: int) -> None:
        self.row, self.counter = row, counter
        self.t_ns = self.number = self.message = 0
        self.events: set[int] = set()


class SampleRule:
    """Give each PDO its row. ``last``: by sender its last row that follows SYNC."""

    def __init__(self) -> None:
        self.last: dict[int, _Last] = {}

    def row(self, sender: int, message: int, counter: int, cyclic: bool, t_ns: int, number: int, row: int) -> int:
        """Return the row of a frame, which may begin ``row``; ``number`` counts the decoded frames."""
        if counter == NO_COUNTER:
            return row
        last = self.last.get(sender)
        if last is not None:
            is_near = abs(t_ns - last.t_ns) <= GAP_NS and number - last.number <= GAP_FRAMES
            last = last if is_near and counter == last.counter else None
        if not cyclic:
            if last is None or message in last.events:
                return row
            last.events.add(message)
            return last.row
        if last is None or message <= last.message:
            last = self.last[sender] = _Last(row, counter)
        last.message, last.t_ns, last.number = message, t_ns, number
        return last.row

    def is_open(self, sender: int, t_ns: int, number: int) -> bool:
        """Return whether a later frame may join the last row of a sender; time and number are the present ones."""
        last = self.last[sender]
        return t_ns - last.t_ns <= GAP_NS and number - last.number < GAP_FRAMES


class SlotCount(NamedTuple):
    """Of a slot that occurs: its frames, first and last counter (-1: cannot show losses), samples lost between them."""

    slot: int
    frames: int
    first: int
    last: int
    lost: int


class Joined(NamedTuple):
    """The rows that no later frame can join, in the order of their first frames, and the frames of the others.

    ``order`` (k,): indices of the frames, group by group; ``row`` (k,): of each. ``first``, ``counter`` (r,): of a
    row's first frame. ``held``, ``held_number`` (h,): frames for the next call, ``number`` the next one. ``spans``:
    (group, start and end in ``order``), ``counts``: of slots, both ascending. ``short``: (slot, frames too short)."""

    order: Ints
    row: Ints
    first: Ints
    counter: Ints
    held: Ints
    held_number: Ints
    number: int
    spans: list[tuple[int, int, int]]
    counts: list[SlotCount]
    short: list[tuple[int, int]]


def join(
    frames: FrameArray, slots: npt.NDArray[np.uint32], layouts: npt.NDArray[np.void], held_number: Ints, number: int,
    *, last: bool,
) -> Joined:  # fmt: skip
    """Join frames, FRAME (n,), whose messages are ``slots`` (n,) of ``layouts``, SLOT (m,), 0 for none. ``held_number``
    (h,) are the numbers of the first decoded frames, ``number`` the next; ``last``: all rows are complete."""
    frames = np.ascontiguousarray(frames)
    work = np.empty((6, len(frames)), dtype=np.int64)
    body = join_here if core is None else core.join
    rows, held, number, ends, counts, short = body(
        frames, slots, layouts, held_number, number, GAP_NS, GAP_FRAMES, last, work
    )
    spans = [(group, low, end) for (_, low), (group, end) in pairwise([(0, 0), *ends])]
    count = spans[-1][2] if spans else 0
    order, row, first, counter, kept, numbers = work
    return Joined(
        order[:count], row[:count], first[:rows], counter[:rows], kept[:held], numbers[:held], number, spans,
        [SlotCount(*of_slot) for of_slot in counts], short,
    )  # fmt: skip


class _Decoded(NamedTuple):
    """A decoded frame: its index and slot, its number among all, its counter, and the place of its row's first."""

    frame: int
    slot: int
    number: int
    counter: int
    start: int


def join_here(
    frames: FrameArray, slots: npt.NDArray[np.uint32], layouts: npt.NDArray[np.void], held_number: Ints, number: int,
    gap_ns: int, gap_frames: int, last: bool, work: Ints,
) -> tuple[int, int, int, list[tuple[int, int]], list[SlotCount], list[tuple[int, int]]]:  # fmt: skip
    """Do as ``join`` of the compiled core: fill ``work`` as ``Joined`` has it; return what is not there."""
    del gap_ns, gap_frames
    rule, of_slot, numbers = SampleRule(), layouts.tolist(), held_number.tolist()
    decoded: list[_Decoded] = []
    short: Counter[int] = Counter()
    now_ns = 0
    for index, (slot, (t_ns, _, length, word)) in enumerate(
        zip(slots.tolist(), FIELDS.iter_unpack(frames.tobytes()), strict=True)
    ):
        sender, _, shift, mask, message, least, cyclic, used, _, _ = of_slot[slot]
        if slot and length < least:
            short[slot] += 1
        elif slot and used:
            place = len(decoded)
            if place < len(numbers):
                of_frame = numbers[place]
            else:
                of_frame, number = number, number + 1
            counter = word >> shift & mask if shift >= 0 else NO_COUNTER
            start = rule.row(sender, message, counter, bool(cyclic), t_ns, of_frame, place)
            decoded.append(_Decoded(index, slot, of_frame, counter, start))
            now_ns = t_ns
    end = len(decoded)
    if decoded and not last:
        newest = decoded[-1].number
        rows = (of_sender.row for sender, of_sender in rule.last.items() if rule.is_open(sender, now_ns, newest))
        end = min(rows, default=end)
    firsts = [frame for place, frame in enumerate(decoded[:end]) if frame.start == place]
    row_of = {frame.start: row for row, frame in enumerate(firsts)}
    group_of = layouts["group"].tolist()
    kept = sorted((frame for frame in decoded if frame.start < end), key=lambda frame: group_of[frame.slot])
    held = [frame for frame in decoded if frame.start >= end]
    in_group = Counter(group_of[frame.slot] for frame in kept)
    ends = [*zip(in_group, accumulate(in_group.values()), strict=True)]
    counters: dict[int, list[int]] = {frame.slot: [] for frame in decoded}
    for frame in kept:
        counters[frame.slot].append(frame.counter)
    counts = []
    for slot in sorted(counters):
        of_slot, layout = counters[slot], layouts[slot]
        shown = losses(of_slot if layout["cyclic"] else (), int(layout["modulus"]))
        counts.append(SlotCount(slot, len(of_slot), *shown))
    columns: list[list[int]] = [
        [frame.frame for frame in kept], [row_of[frame.start] for frame in kept], [frame.frame for frame in firsts],
        [frame.counter for frame in firsts], [frame.frame for frame in held], [frame.number for frame in held],
    ]  # fmt: skip
    for target, column in zip(work, columns, strict=True):
        target[: len(column)] = column
    return len(firsts), len(held), number, ends, counts, sorted(short.items())


def losses(counter: npt.ArrayLike, modulus: int) -> tuple[int, int, int]:
    """Return the first and the last of the counters (k,) of a PDO that follows SYNC, -1 for none, and how many samples
    are missing between them: see ``lost_samples``. Where they are the SYNCs' numbers, 0 is no SYNC's latch."""
    values = np.asarray(counter, dtype=np.int64)
    values = values if modulus == SAMPLES else values[values > 0]
    if not len(values) or not modulus:
        return -1, -1, 0
    return int(values[0]), int(values[-1]), int(np.maximum(np.diff(values) % modulus - 1, 0).sum())
