"""Convert blocks of frames to tables of samples: join the PDOs of one sample, complete rows across blocks, decode."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import occurring
from tipforce.dictionary.signals import Message
from tipforce.host.decoding.columns import Layout
from tipforce.host.decoding.counters import Place, Tally
from tipforce.host.decoding.decoder import Change, Decoder
from tipforce.host.decoding.pdo_layout import has_signal
from tipforce.host.decoding.plan import Plan, slots_of
from tipforce.host.decoding.sample_rule import COUNTER, SLOT, Joined, follows_sync, join
from tipforce.host.decoding.sample_table import (
    NODE_BITS,
    BoolArray,
    Column,
    Table,
    Values,
    column_of,
    in_order,
    missing_of,
)
from tipforce.host.decoding.sync_modulus import SAMPLES, SyncModulus
from tipforce.host.frames.frame_array import FRAME, FrameArray


class OpenRows(NamedTuple):
    """Frames of incomplete rows, their numbers relative to the next decodable frame, and ``SyncModulus.state``."""

    frames: FrameArray
    number: npt.NDArray[np.int64]
    syncs: list[tuple[int, int, int, int]]

    @classmethod
    def none(cls) -> OpenRows:
        """Return those of a merger that has seen nothing."""
        return cls(np.zeros(0, dtype=FRAME), np.zeros(0, dtype=np.int64), [])

    def renumbered(self, numbers: Sequence[int]) -> OpenRows:
        """Return them with other ``numbers`` of the channels."""
        syncs = [(numbers[k], modulus, largest, last) for k, modulus, largest, last in self.syncs]
        return OpenRows(renumbered(self.frames, numbers), self.number, syncs)

    def equals(self, other: OpenRows) -> bool:
        """Return whether the same samples follow from both."""
        mine, others = ({one for one in rows.syncs if one[1] != SAMPLES} for rows in (self, other))
        return (
            mine == others and np.array_equal(self.number, other.number) and np.array_equal(self.frames, other.frames)
        )


def renumbered(frames: FrameArray, numbers: Sequence[int]) -> FrameArray:
    """Return the frames with other ``numbers`` of the channels."""
    if not len(frames) or list(numbers) == list(range(len(numbers))):
        return frames
    frames = frames.copy()
    frames["channel"] = np.array(numbers, dtype=np.uint8)[frames["channel"]]
    return frames


_Span = tuple[int, int, int]  # slot, start and end in the order of the slots
_PLAIN = f"V{FRAME.itemsize}"  # copied as a whole, not field by field


class SampleMerger:
    """Convert each block to a table. Frames of an incomplete row are kept for the next block.

    ``channels`` are the names of the frames' channels and may grow. ``signals`` None means all. ``tally`` counts the
    returned samples.
    """

    def __init__(
        self,
        decoder: Callable[[], Decoder],
        channels: list[str],
        signals: tuple[str, ...] | None,
        *,
        follows: bool = False,
    ) -> None:
        """``follows``: the layouts change with ``Decoder.changes``."""
        self._make = decoder
        self._follows = follows
        self._decoders: dict[int, Decoder] = {}
        self._signals = signals
        self._wanted: tuple[str, ...] | None = signals
        if signals is not None and COUNTER not in signals and has_signal(decoder(), COUNTER):
            self._wanted = (*signals, COUNTER)
        self._columns: dict[str, Column] = {}
        self._names: dict[tuple[int, str], Column] = {}  # by message and signal
        self._slots, self._changed = _Slots({}), False
        self._held: FrameArray = np.zeros(0, dtype=FRAME)
        self._held_number = np.zeros(0, dtype=np.int64)
        self._count = 0
        self.channels = channels
        self.timed = True
        self.sync = SyncModulus()
        self.tally = Tally()

    def tables(self, frames: FrameArray) -> Iterator[Table]:
        """Yield the samples that are complete now, apart where numbers of SYNCs begin or end, and layouts change."""
        changes = self._changes(frames)
        start = 0
        cuts = {*self.sync.cuts(frames), *(row for row, _, _ in changes)} - {len(frames)}
        for number, end in enumerate([*sorted(cuts), len(frames)]):
            yield from self._part(frames[start:end], begins=number > 0)
            here = [(decoder, change) for row, decoder, change in changes if row == end]
            rest = self.finish() if here else None
            if rest is not None:
                yield rest
            for decoder, change in here:
                decoder.apply(change)
                self._changed = True
            start = end

    def _part(self, frames: FrameArray, *, begins: bool) -> Iterator[Table]:
        rest = self.finish() if begins else None
        self.sync.look(frames)
        yield from (table for table in (rest, self.add(frames)) if table is not None)

    def _changes(self, frames: FrameArray) -> list[tuple[int, Decoder, Change]]:
        """Return the changes of all channels by their row."""
        found: list[tuple[int, Decoder, Change]] = []
        for number in occurring(frames["channel"]) if self._follows else ():
            rows = np.flatnonzero(frames["channel"] == number)
            decoder = self._decoder(number)
            found += [(int(rows[one.row - 1]) + 1, decoder, one) for one in decoder.changes(frames[rows])]
        return found

    def add(self, frames: FrameArray, *, last: bool = False) -> Table | None:
        """Return the samples that are complete now; with ``last`` all of them. None if there are none."""
        block = (
            np.concatenate((self._held.view(_PLAIN), frames.view(_PLAIN))).view(FRAME) if len(self._held) else frames
        )
        slots = self._slots_of(block)
        joined = join(block, slots, self._slots.layouts, self._held_number, self._count, last=last)
        self._count = joined.number
        self._held, self._held_number = block[joined.held], joined.held_number
        for slot, count in joined.short:
            place = self._place(slot)
            self.tally.short[place] = self.tally.short.get(place, 0) + count
        return self._table(block, slots, joined) if len(joined.first) else None

    def finish(self) -> Table | None:
        """Return the remaining samples."""
        return self.add(np.zeros(0, dtype=FRAME), last=True)

    @property
    def open(self) -> OpenRows:
        """What the next samples depend on."""
        return OpenRows(self._held, self._held_number - self._count, self.sync.state)

    def resume(self, rows: OpenRows) -> None:
        """Go on from what ``open`` returned."""
        self._held, self._held_number, self._count = rows.frames, rows.number, 0
        self.sync = SyncModulus(rows.syncs)

    def _decoder(self, number: int) -> Decoder:
        if number not in self._decoders:
            self._decoders[number] = self._make()
        return self._decoders[number]

    def _slots_of(self, block: FrameArray) -> npt.NDArray[np.uint32]:
        """Return the slot of each frame, after those of new channels and changed layouts were made."""
        channels = occurring(block["channel"])
        if self._changed or not self._slots.has(channels):
            self._changed = False
            plans = {
                number: self._decoder(number).plan(self._wanted) for number in sorted({*self._decoders, *channels})
            }
            self._slots = _Slots(plans, with_counter_alone=self._wanted is self._signals)
        if len(channels) == 1:
            return self._slots.of(channels[0], block["can_id"])
        slots = np.zeros(len(block), dtype=np.uint32)
        for number in channels:
            rows = np.flatnonzero(block["channel"] == number)
            slots[rows] = self._slots.of(number, block["can_id"][rows])
        return slots

    def _place(self, slot: int) -> Place:
        channel, node_id, name = self._slots.places[slot]
        return self.channels[channel], node_id, name

    def _table(self, block: FrameArray, slots: npt.NDArray[np.uint32], joined: Joined) -> Table:
        """Return the complete rows; columns of messages whose frames are all in open rows are empty."""
        pieces = self._slots.pieces
        by_message: dict[str, dict[int, list[_Span]]] = {}
        for span in sorted(joined.spans, key=lambda span: pieces[span[0]].message.number):
            message = pieces[span[0]].message
            by_message.setdefault(message.name, {}).setdefault(id(message), []).append(span)
        values = _Values(len(joined.first))
        firsts, counter = self._slots.layouts[slots[joined.first]], joined.counter.copy()
        words = block["data"].view("<u8")[:, 0]
        for spans in (spans for layouts in by_message.values() for spans in layouts.values()):
            slot = spans[0][0]
            order, row = _of_spans(joined.order, spans), _of_spans(joined.row, spans)
            columns = pieces[slot].layout.columns(words[order])
            self._count_frames(spans, columns)
            for signal, column in columns.items():
                if signal != COUNTER:
                    values.add(self._column_of(pieces[slot].message, signal), row, column)
                elif self._slots.layouts["shift"][slot] < 0:  # of another manufacturer: no plain number
                    counter[row] = column.astype(np.int16)
        found, absent = values.found, values.absent
        shown = in_order((self._columns[name] for name in found), self._signals)
        return Table(
            block["t_ns"][joined.first], firsts["key"], counter, firsts["cyclic"] == 1,
            shown, {c.name: found[c.name] for c in shown}, absent, tuple(self.channels), self.timed,
            tuple((self.channels[channel], modulus) for channel, modulus in self.sync.of.items()),
        )  # fmt: skip

    def _count_frames(self, spans: list[_Span], columns: Mapping[str, Values]) -> None:
        """Count the frames of messages of one layout, whose columns these are, in the tally."""
        at = 0
        for slot, low, high in spans:
            piece, rows = self._slots.pieces[slot], slice(at, at + high - low)
            at = rows.stop
            counter = columns[COUNTER][rows] if COUNTER in columns and follows_sync(piece.message) else None
            self.tally.add(self._place(slot), high - low, counter, self.sync.of.get(piece.channel, SAMPLES))

    def _column_of(self, message: Message, name: str) -> Column:
        place = id(message), name
        if place not in self._names:
            column = next(column_of(signal) for signal in message.signals if signal.name == name)
            self._names[place] = self._columns.setdefault(column.name, column)
        return self._names[place]


class _Values:
    """Columns of rows, filled message by message: of a sample the first PDO that has a value counts."""

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self._present: dict[str, BoolArray] = {}
        self._covered: dict[str, int] = {}
        self.found: dict[str, Values] = {}

    def add(self, column: Column, where: npt.NDArray[np.int64], what: Values) -> None:
        """Add the values of a signal in the rows ``where``, each of which occurs once."""
        name, rows = column.name, self._rows
        if self._covered.get(name) == rows:
            return  # another PDO of each sample had it: they are from one latched sample
        if name not in self.found and len(where) == rows:
            self.found[name], self._covered[name] = np.empty(rows, dtype=missing_of(column, 0).dtype), rows
            self.found[name][where] = what
            return
        values = self.found.setdefault(name, missing_of(column, rows))
        there = self._present.setdefault(name, np.zeros(rows, dtype=np.bool_))
        new = ~there[where]
        values[where[new]] = what[new]
        there[where] = True
        self._covered[name] = int(np.count_nonzero(there))

    @property
    def absent(self) -> dict[str, BoolArray]:
        """By name, where no message had the column."""
        return {name: ~there for name, there in self._present.items() if self._covered[name] < self._rows}


class _Piece(NamedTuple):
    """What the slots of a channel's nodes with one layout share."""

    channel: int
    message: Message
    layout: Layout


class _Slots:
    """The slots of all channels, one after another; 0 is none. ``places``: channel, node-id and message of each.

    ``pieces``: by slot, too; that of slot 0 has no meaning.
    """

    def __init__(self, plans: Mapping[int, Plan], *, with_counter_alone: bool = True) -> None:
        """``with_counter_alone``: use messages too that have no other signal."""
        self._plans, self._bases = plans, dict[int, int]()
        self.places: list[tuple[int, int, str]] = [(0, 0, "")]
        self.pieces: list[_Piece] = []
        self.layouts = np.zeros(1, dtype=SLOT)
        for channel, plan in plans.items():
            self._bases[channel] = len(self.places) - 1
            self.places += [(channel, *key) for key in plan.keys]
            of_group = [_Piece(channel, group.message, group.layout) for group in plan.groups]
            slots, group_of = plan.slots[1:].copy(), plan.group_of[1:]
            self.pieces += [of_group[number] for number in (*group_of[: not self.pieces], *group_of)]
            slots["sender"] += self.layouts["sender"].max() + np.uint32(1)
            slots["key"] |= np.uint16(channel << NODE_BITS)
            if not with_counter_alone:
                slots["used"] = [{*of_group[number].layout.names} != {COUNTER} for number in group_of]
            self.layouts = np.concatenate((self.layouts, slots))

    def has(self, channels: Iterable[int]) -> bool:
        """Return whether the channels are among these."""
        return all(channel in self._plans for channel in channels)

    def of(self, channel: int, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
        """Return the slot of each identifier (k,) of a channel."""
        slots = slots_of(self._plans[channel], can_id)
        if self._bases[channel]:
            slots[slots > 0] += np.uint32(self._bases[channel])
        return slots


def _of_spans(values: npt.NDArray[np.int64], spans: list[_Span]) -> npt.NDArray[np.int64]:
    """Return the values of spans, a view where they follow each other."""
    if all(before[2] == after[1] for before, after in pairwise(spans)):
        return values[spans[0][1] : spans[-1][2]]
    return np.concatenate([values[low:high] for _, low, high in spans])
