"""Convert blocks of frames to tables of samples: join the PDOs of one sample, complete rows across blocks, decode."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, occurring
from tipforce.dictionary.signals import Message, Signal
from tipforce.host.decoding.counters import Place, SyncModulus, Tally
from tipforce.host.decoding.decoder import Change, Decoder, Group, Plan, slots_of
from tipforce.host.decoding.pdo_layout import has_signal
from tipforce.host.decoding.sample_rule import COUNTER, SAMPLES, SLOT, Joined, SlotCount, counter_place, join
from tipforce.host.decoding.sample_table import (
    NODE_BITS,
    Column,
    Layout,
    Table,
    Values,
    column_of,
    in_order,
    missing_of,
)
from tipforce.host.frames.frame_array import FRAME, FrameArray


class OpenRows(NamedTuple):
    """Frames of incomplete rows, their numbers relative to the next decodable frame, and ``SyncModulus.state``."""

    frames: FrameArray
    number: npt.NDArray[np.int64]
    syncs: list[tuple[int, int, int, int]]

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


_PLAIN = f"V{FRAME.itemsize}"  # copied as a whole, not field by field


class SampleMerger:
    """Convert each block to a table. Frames of an incomplete row are kept for the next block. ``channels`` are the
    names of the frames' channels and may grow. ``signals`` None means all. ``tally`` counts the returned samples."""

    def __init__(
        self, decoder: Callable[[], Decoder], channels: list[str], signals: tuple[str, ...] | None,
        follows: bool = False,
    ) -> None:  # fmt: skip
        """``follows``: the layouts change with ``Decoder.changes``."""
        self._make, self._follows, self._signals = decoder, follows, signals
        self._decoders: dict[int, Decoder] = {}
        self._wanted = signals
        if signals is not None and COUNTER not in signals and has_signal(decoder(), COUNTER):
            self._wanted = (*signals, COUNTER)
        self._columns: dict[str, Column] = {}
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
        changes, start = self._changes(frames), 0
        for number, end in enumerate([*sorted({*self.sync.cuts(frames), *changes} - {len(frames)}), len(frames)]):
            if number:
                yield from self.finish()
            self.sync.look(frames[start:end])
            yield from self._joined(frames[start:end])
            if end in changes:
                yield from self.finish()
                for decoder, change in changes[end]:
                    decoder.apply(change)
                self._changed = True
            start = end

    def _changes(self, frames: FrameArray) -> dict[int, list[tuple[Decoder, Change]]]:
        changes: dict[int, list[tuple[Decoder, Change]]] = {}
        for number in occurring(frames["channel"]) if self._follows else ():
            rows = np.flatnonzero(frames["channel"] == number)
            decoder = self._decoder(number)
            for change in decoder.changes(frames.take(rows)):
                changes.setdefault(int(rows[change.row - 1]) + 1, []).append((decoder, change))
        return changes

    def _joined(self, frames: FrameArray, *, last: bool = False) -> Iterator[Table]:
        block = frames
        if len(self._held):
            block = np.concatenate((self._held.view(_PLAIN), frames.view(_PLAIN))).view(FRAME)
        slots = self._slots_of(block)
        self._slots.set_moduli(self.sync.of)
        joined = join(block, slots, self._slots.layouts, self._held_number, self._count, last=last)
        self._count = joined.number
        self._held, self._held_number = block[joined.held], joined.held_number
        for slot, count in joined.short:
            self.tally.short[self._place(slot)] += count
        if len(joined.first):
            yield self._table(block, slots, joined)

    def finish(self) -> Iterator[Table]:
        """Yield the remaining samples."""
        return self._joined(np.zeros(0, dtype=FRAME), last=True)

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
        channels = occurring(block["channel"])
        if self._changed or not {*channels} <= self._slots.plans.keys():
            self._changed, numbers = False, sorted({*self._decoders, *channels})
            plans = {number: self._decoder(number).plan(self._wanted) for number in numbers}
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

    def _in_turn(self, counts: Iterable[SlotCount]) -> list[tuple[int, list[SlotCount]]]:
        """Return the counts by group, in the order in which a node sends its messages."""
        of_group: dict[int, list[SlotCount]] = {}
        first: dict[str, int] = {}  # slot of a message, by its name
        for count in counts:
            of_group.setdefault(int(self._slots.layouts["group"][count.slot]), []).append(count)
            first.setdefault(self._slots.places[count.slot][2], count.slot)
        messages = {group: self._slots.groups[group].message for group in of_group}
        return sorted(of_group.items(), key=lambda of: (messages[of[0]].number, first[messages[of[0]].name]))

    def _table(self, block: FrameArray, slots: npt.NDArray[np.uint32], joined: Joined) -> Table:
        """Return the complete rows; columns of messages whose frames are all in open rows are empty."""
        layouts = self._slots.layouts
        values = _Values(len(joined.first))
        first, counter = slots[joined.first], joined.counter.copy()
        words = block["data"].view("<u8")[:, 0]
        spans = {group: slice(low, high) for group, low, high in joined.spans}
        for number, counts in self._in_turn(joined.counts):
            for count in counts:
                self.tally.add(self._place(count.slot), *count[1:], int(layouts["modulus"][count.slot]))
            group, span = self._slots.groups[number], spans.get(number, slice(0, 0))
            for signal in group.signals if not group.columns else ():
                column = column_of(signal)
                group.columns[signal.name] = self._columns.setdefault(column.name, column)
            row = joined.row[span]
            whole = len(row) == len(counter)
            columns = group.layout(values.whole).columns(words[joined.order[span]], *((row,) if whole else ()))
            for name, what in columns.items():
                if name == COUNTER:  # of another manufacturer: no plain number
                    counter[slice(None) if whole else row] = what.astype(np.int16)
                else:
                    values.add(group.columns[name], None if whole else row, what)
        shown = in_order((self._columns[name] for name in values.found), self._signals)
        return Table(
            block["t_ns"][joined.first], layouts["key"][first], counter, layouts["cyclic"][first] == 1,
            shown, {c.name: values.found[c.name] for c in shown}, values.absent, tuple(self.channels), self.timed,
            tuple((self.channels[channel], modulus) for channel, modulus in self.sync.of.items()),
        )  # fmt: skip


class _Values:
    """Columns of rows, filled message by message: of a sample the first PDO that has a value counts."""

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self.found: dict[str, Values] = {}
        self.absent: dict[str, BoolArray] = {}  # by name, where no message had the column yet

    @property
    def whole(self) -> frozenset[str]:
        """Names of the columns that have a value in each row."""
        return frozenset(self.found.keys() - self.absent.keys())

    def add(self, column: Column, where: npt.NDArray[np.int64] | None, what: Values) -> None:
        """Add the values of a signal, whose column is not whole, in different rows ``where``; None: in all."""
        name = column.name
        if where is None and name not in self.found:
            kind = missing_of(column, 0).dtype
            self.found[name] = what.view(kind) if what.dtype == np.bool_ else what.astype(kind, copy=False)
            return
        values = self.found.setdefault(name, missing_of(column, self._rows))
        absent = self.absent.setdefault(name, np.ones(self._rows, dtype=np.bool_))
        where = np.arange(self._rows) if where is None else where
        new = absent[where]
        values[where[new]] = what[new]
        absent[where] = False
        if not absent.any():
            del self.absent[name]


class _Group:
    def __init__(self, message: Message, signals: tuple[Signal, ...]) -> None:
        self.message = message
        plain = counter_place(signals)[0] >= 0  # then `join` reads it
        self.signals = tuple(signal for signal in signals if not plain or signal.name != COUNTER)
        self.columns: dict[str, Column] = {}
        """By signal, from the first table on."""
        self._layouts: dict[frozenset[str], Layout] = {}

    def layout(self, without: frozenset[str]) -> Layout:
        """Return the layout of its signals that have none of these columns."""
        if without not in self._layouts:
            wanted = [signal for signal in self.signals if self.columns[signal.name].name not in without]
            self._layouts[without] = Layout(wanted, wide=True)
        return self._layouts[without]


class _Slots:
    """The slots of all channels, one after another; 0 is none. ``places``: channel, node-id and message of each."""

    def __init__(self, plans: Mapping[int, Plan], *, with_counter_alone: bool = True) -> None:
        """``with_counter_alone``: use messages too that have no other signal."""
        self.plans, self._bases = plans, dict[int, int]()
        self._moduli: dict[int, int] = {}
        self.places: list[tuple[int, int, str]] = [(0, 0, "")]
        self.layouts = np.zeros(1, dtype=SLOT)
        of_slots: list[Group] = []
        for channel, plan in plans.items():
            self._bases[channel] = len(self.places) - 1
            self.places += [(channel, *key) for key in plan.keys]
            slots = plan.slots[1:].copy()
            groups = [plan.groups[number] for number in slots["group"].tolist()]
            of_slots += groups
            slots["sender"] += self.layouts["sender"].max() + np.uint32(1)
            slots["key"] |= np.uint16(channel << NODE_BITS)
            if not with_counter_alone:
                slots["used"] = [{*group.layout.names} != {COUNTER} for group in groups]
            self.layouts = np.concatenate((self.layouts, slots))
        alike = {id(group.message): group for group in of_slots}
        number_of = {key: number for number, key in enumerate(alike)}
        self.groups = [_Group(group.message, group.layout.signals) for group in alike.values()]
        self.layouts["group"][1:] = [number_of[id(group.message)] for group in of_slots]

    def set_moduli(self, moduli: Mapping[int, int]) -> None:
        if moduli != self._moduli:
            self._moduli = dict(moduli)
            self.layouts["modulus"] = [self._moduli.get(channel, SAMPLES) for channel, _, _ in self.places]

    def of(self, channel: int, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
        slots = slots_of(self.plans[channel], can_id)
        if self._bases[channel]:
            slots[slots > 0] += np.uint32(self._bases[channel])
        return slots
