"""Convert blocks of frames to tables of samples: decode, join the PDOs of one sample, complete rows across blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import occurring
from tipforce.host.decoding.counters import COUNTER, Tally, is_cyclic
from tipforce.host.decoding.decoder import Change, Decoder, Samples
from tipforce.host.decoding.pdo_layout import has_signal
from tipforce.host.decoding.plan import Key
from tipforce.host.decoding.sample_table import (
    NO_COUNTER,
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

IntArray = npt.NDArray[np.intp]

GAP_NS = 200_000_000
"""PDOs of a node further apart belong to different samples: 15 nodes with 4 PDOs at 50 kbit/s fit in this time."""
GAP_FRAMES = 8192
"""The same in decoded frames, which also works for logs without times."""


class Frames(NamedTuple):
    """Decoded frames in order of arrival, (k,) each."""

    number: npt.NDArray[np.int64]  # of the decoded frame, over the whole recording
    t_ns: npt.NDArray[np.int64]
    key: npt.NDArray[np.uint16]  # channel and node
    message: npt.NDArray[np.uint8]  # ascending in the order in which a node sends its PDOs
    counter: npt.NDArray[np.int16]  # NO_COUNTER if the message has none
    cyclic: npt.NDArray[np.bool_]  # the PDO follows SYNC


class Runs(NamedTuple):
    """``start`` (k,): index of the first frame of each frame's row. ``order``: frames by key, stable."""

    start: IntArray
    order: IntArray
    cyclic: IntArray  # indices of frames that follow SYNC and have a counter, by key


def runs(frames: Frames) -> Runs:
    """Group frames into rows.

    A node sends the PDOs of one SYNC in their order and with the counter of one latched sample. So a cyclic frame
    continues the row of the node's previous frame if the counter is the same, the PDO a later one and the gap
    small. An event-driven PDO carries the counter of the last latch: it joins the node's last row if that has the
    same counter, and no PDO of its kind yet. Every other frame starts its own row. The rule uses only pairs of frames,
    so the result does not depend on how a log is split into blocks.
    """
    order: IntArray = np.argsort(frames.key, kind="stable")
    start = np.arange(len(order))
    steady = bool((frames.cyclic & (frames.counter != NO_COUNTER)).all())
    chosen = order if steady else order[(frames.cyclic & (frames.counter != NO_COUNTER))[order]]
    if len(chosen):
        goes_on = _goes_on(frames, chosen)
        first = np.arange(len(chosen))
        first[1:][goes_on] = 0
        start[chosen] = chosen[np.maximum.accumulate(first)]
    if not steady and len(chosen):
        _join_events(frames, order, chosen, start)
    return Runs(start, order, chosen)


def _goes_on(frames: Frames, chosen: IntArray) -> npt.NDArray[np.bool_]:
    """Return whether each chosen frame but the first belongs to the sample of the previous one."""
    word = frames.key.astype(np.uint32) << 16
    word |= frames.counter.view(np.uint16).astype(np.uint32) << 8 & 0xFF00
    word |= frames.message
    word, t_ns, number = word[chosen], frames.t_ns[chosen], frames.number[chosen]
    goes_on = word[1:] ^ word[:-1] < 256
    goes_on &= word[1:] > word[:-1]
    goes_on &= np.abs(np.diff(t_ns)) <= GAP_NS
    goes_on &= np.diff(number) <= GAP_FRAMES
    return np.asarray(goes_on)


def _same_sample(frames: Frames, before: IntArray, after: IntArray) -> npt.NDArray[np.bool_]:
    same = frames.key[before] == frames.key[after]
    same &= frames.counter[before] == frames.counter[after]
    same &= np.abs(frames.t_ns[after] - frames.t_ns[before]) <= GAP_NS
    same &= frames.number[after] - frames.number[before] <= GAP_FRAMES
    return np.asarray(same)


def _join_events(frames: Frames, order: IntArray, cyclic: IntArray, start: IntArray) -> None:
    place = np.empty(len(order), dtype=np.intp)
    place[order] = np.arange(len(order))
    event = order[(~frames.cyclic & (frames.counter != NO_COUNTER))[order]]
    before = np.searchsorted(place[cyclic], place[event]) - 1
    event, before = event[before >= 0], before[before >= 0]
    joins = _same_sample(frames, cyclic[before], event)
    event, row = event[joins], start[cyclic[before[joins]]]
    _, first = np.unique(row * 256 + frames.message[event], return_index=True)
    start[event[first]] = row[first]


def open_from(frames: Frames, found: Runs) -> int:
    """Return the index of the first row that a later frame may join; the number of frames if there is none."""
    count = len(frames.key)
    if not len(found.cyclic):
        return count
    of_key = frames.key[found.cyclic]
    last = found.cyclic[np.flatnonzero(np.append(of_key[1:] != of_key[:-1], True))]
    near = frames.t_ns[-1] - frames.t_ns[last] <= GAP_NS
    near &= frames.number[-1] - frames.number[last] < GAP_FRAMES
    return int(found.start[last[near]].min(initial=count))


def row_numbers(start: IntArray, end: int) -> tuple[IntArray, IntArray]:
    """Return (first, row): index of the first frame of each row that starts before ``end``; each frame's row number."""
    is_first = start == np.arange(len(start))
    row: IntArray = (np.cumsum(is_first) - 1)[start]
    return np.flatnonzero(is_first[:end]), row


def joined(*parts: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the concatenated arrays, without a copy if there is only one."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


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


_PLAIN = f"V{FRAME.itemsize}"  # copied as a whole, not field by field
_Found = list[tuple[int, Samples]]  # (channel, samples), their rows indexed in the whole block
_Piece = tuple[IntArray, Samples, BoolArray | slice]  # rows of the table, and the samples for them


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
        self._names: dict[tuple[int, str], str] = {}  # of columns, by message and signal
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
        before = len(self._held)
        block = np.concatenate((self._held.view(_PLAIN), frames.view(_PLAIN))).view(FRAME) if before else frames
        found = self._decoded(block)
        decoded, index = _places(len(block), found)
        arrived = _arrived(found, index, self._number(before, decoded))
        sorted_out = runs(arrived)
        end = len(decoded) if last or not len(decoded) else open_from(arrived, sorted_out)
        table = self._table(arrived, sorted_out, found, index, end)
        kept = end + np.flatnonzero(sorted_out.start[end:] >= end)
        self._held, self._held_number = block[decoded[kept]], arrived.number[kept]
        return table

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

    def _number(self, before: int, decoded: IntArray) -> npt.NDArray[np.int64]:
        new = len(decoded) - before
        number = np.concatenate((self._held_number, np.arange(self._count, self._count + new)))
        self._count += new
        return number

    def _decoded(self, block: FrameArray) -> _Found:
        channel = block["channel"]
        if not len(block):
            return []
        low, high = int(channel.min()), int(channel.max())
        if low == high:
            return [(low, samples) for samples in self._of_channel(low, block).values()]
        found: _Found = []
        for number in occurring(channel):
            rows = np.flatnonzero(channel == number)
            for samples in self._of_channel(number, block[rows]).values():
                whole = Samples(samples.node_id, samples.message, samples.t_ns, rows[samples.row], samples.columns)
                found.append((number, whole))
        return found

    def _decoder(self, number: int) -> Decoder:
        if number not in self._decoders:
            self._decoders[number] = self._make()
        return self._decoders[number]

    def _of_channel(self, number: int, frames: FrameArray) -> Mapping[Key, Samples]:
        decoder = self._decoder(number)
        samples = decoder.decode(frames, self._wanted)
        if decoder.malformed:
            for (node, name), short in decoder.malformed.items():
                place = self.channels[number], node, name
                self.tally.short[place] = self.tally.short.get(place, 0) + short
            decoder.malformed.clear()
        if self._wanted is self._signals:
            return samples
        return {key: one for key, one in samples.items() if len(one.columns) > 1 or COUNTER not in one.columns}

    def _table(
        self, arrived: Frames, sorted_out: Runs, found: _Found, places: list[IntArray], end: int
    ) -> Table | None:
        first, row_of_frame = row_numbers(sorted_out.start, end)
        if not len(first):
            return None
        by_message: dict[str, list[_Piece]] = {}
        for (channel, samples), place in sorted(zip(found, places, strict=True), key=_message_number):
            index = place
            kept: BoolArray | slice = slice(None)
            if index[-1] >= end:
                kept = _inside(sorted_out.start[index] < end)
                index = index[kept]
            self.tally.add(self.channels[channel], samples, self.sync.of.get(channel, SAMPLES), kept)
            by_message.setdefault(samples.message.name, []).append((row_of_frame[index], samples, kept))
        values, absent = self._values(by_message, len(first))
        shown = in_order((self._columns[name] for name in values), self._signals)
        return Table(
            arrived.t_ns[first], arrived.key[first], arrived.counter[first].astype(np.int64), arrived.cyclic[first],
            shown, {c.name: values[c.name] for c in shown}, absent, tuple(self.channels), self.timed,
            tuple((self.channels[channel], modulus) for channel, modulus in self.sync.of.items()),
        )  # fmt: skip

    def _values(
        self, by_message: Mapping[str, list[_Piece]], rows: int
    ) -> tuple[dict[str, Values], dict[str, BoolArray]]:
        values: dict[str, Values] = {}
        covered: dict[str, int] = {}
        present: dict[str, BoolArray] = {}
        for pieces in by_message.values():
            for alike in _alike(pieces):
                where = np.concatenate([row for row, _, _ in alike])
                for signal in alike[0][1].columns:
                    name = self._column_of(alike[0][1], signal)
                    if signal == COUNTER or covered.get(name) == rows:
                        continue  # another PDO of each sample had it: they are from one latched sample
                    what = np.concatenate([samples.columns[signal][kept] for _, samples, kept in alike])
                    column = self._columns[name]
                    if len(where) == rows and name not in values:
                        values[name], covered[name] = np.empty(rows, dtype=missing_of(column, 0).dtype), rows
                    elif name not in values:
                        values[name], covered[name] = missing_of(column, rows), 0
                    if covered[name] == rows:
                        values[name][where] = what
                        continue
                    there = present.setdefault(name, np.zeros(rows, dtype=np.bool_))
                    new = ~there[where]  # the first PDO of a sample counts, independent of the rest of the block
                    values[name][where[new]] = what[new]
                    there[where] = True
                    covered[name] = int(np.count_nonzero(there))
        return values, {name: ~there for name, there in present.items() if covered[name] < rows}

    def _column_of(self, samples: Samples, name: str) -> str:
        place = id(samples.message), name
        if place not in self._names:
            column = next(column_of(signal) for signal in samples.message.signals if signal.name == name)
            self._columns.setdefault(column.name, column)
            self._names[place] = column.name
        return self._names[place]


def _message_number(one: tuple[tuple[int, Samples], IntArray]) -> int:
    return one[0][1].message.number


def _alike(pieces: list[_Piece]) -> list[list[_Piece]]:
    """Join the pieces of nodes with the same mapping."""
    by_layout: dict[int, list[_Piece]] = {}
    for piece in pieces:
        by_layout.setdefault(id(piece[1].message), []).append(piece)
    return list(by_layout.values())


def _inside(inside: BoolArray) -> BoolArray | slice:
    """Return the same selection, as a slice if it is a leading range: that needs no copies."""
    count = int(np.count_nonzero(inside))
    return slice(count) if inside[:count].all() else inside


def _places(count: int, found: _Found) -> tuple[IntArray, list[IntArray]]:
    """Return (decoded rows, ascending; for each of the found samples their indices among these)."""
    is_decoded = np.zeros(count, dtype=np.bool_)
    for _, samples in found:
        is_decoded[samples.row] = True
    place = np.cumsum(is_decoded, dtype=np.intp) - 1
    return np.flatnonzero(is_decoded), [place[samples.row] for _, samples in found]


def _arrived(found: _Found, places: list[IntArray], number: npt.NDArray[np.int64]) -> Frames:
    count = len(number)
    t_ns = np.empty(count, dtype=np.int64)
    key = np.empty(count, dtype=np.uint16)
    message = np.empty(count, dtype=np.uint8)
    counter = np.full(count, NO_COUNTER, dtype=np.int16)
    cyclic = np.zeros(count, dtype=np.bool_)
    for (channel, samples), index in zip(found, places, strict=True):
        t_ns[index] = samples.t_ns
        key[index] = channel << NODE_BITS | samples.node_id
        message[index] = samples.message.number
        if COUNTER in samples.columns:
            counter[index] = samples.columns[COUNTER]
            cyclic[index] = is_cyclic(samples)
    return Frames(number, t_ns, key, message, counter, cyclic)
