"""Join the parts of a recording in order: the same tables as from one log, with continuous counters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.host.decoding.decoder import unwrap_counter
from tipforce.host.decoding.health_rows import HealthRows, joins
from tipforce.host.decoding.log_part import (
    Edge,
    End,
    Item,
    Notes,
    Piece,
    Progress,
    Reading,
    Source,
    StrictError,
    numbered_from,
)
from tipforce.host.decoding.sample_merger import SampleMerger
from tipforce.host.decoding.sample_rows import IntArray
from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Table
from tipforce.host.decoding.services import BusEvent, BusEvents
from tipforce.host.decoding.sync_modulus import SAMPLES
from tipforce.host.decoding.tally import Tally
from tipforce.host.frames.frame_array import MAX_CHANNELS, FrameArray

Tap = Callable[[FrameArray, Sequence[str]], None]
"""Takes FRAME (n,) and the interfaces by number."""


class Counters:
    """Unwrap the counters of consecutive tables."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, int]] = {}  # by key: unwrapped, and as sent

    def unwrapped(self, table: Table) -> Table:
        """Return the table with each node's counter continued from its first value.

        An event-driven PDO in its own row belongs to the last latch: it gets the nearest count. Before
        the first PDO that follows SYNC its counter is unchanged.
        """
        raw = table.counter
        counter = raw.copy()
        moduli = dict(table.moduli)
        order = np.argsort(table.key, kind="stable")
        key = table.key[order]
        for rows in np.split(order, np.flatnonzero(key[1:] != key[:-1]) + 1) if len(key) else []:
            of = int(table.key[rows[0]])
            modulus = moduli.get(table.channels[of >> NODE_BITS], SAMPLES) if moduli else SAMPLES
            counter[rows] = self._of_node(of, raw[rows], table.cyclic[rows], modulus)
        return replace(table, counter=counter)

    def _of_node(
        self, key: int, raw: npt.NDArray[np.int64], cyclic: npt.NDArray[np.bool_], modulus: int
    ) -> npt.NDArray[np.int64]:
        last = self._last.get(key)
        steady = raw[cyclic]
        found = raw.copy()
        counts = np.zeros(0, dtype=np.int64)
        if len(steady):
            seed = steady[:0] if last is None else np.array([last[1]])
            counts = unwrap_counter(np.concatenate((seed, steady)), modulus)
            counts += 0 if last is None else last[0] - last[1]
            counts = counts[len(seed) :]
            found[cyclic] = counts
            self._last[key] = int(counts[-1]), int(steady[-1])
        if len(steady) < len(raw):
            event: IntArray = np.flatnonzero(~cyclic & (raw != NO_COUNTER))
            before = np.cumsum(cyclic)[event]
            known = np.concatenate(([-1 if last is None else last[0]], counts))[before]
            sent = np.concatenate(([0 if last is None else last[1]], steady))[before]
            half = modulus // 2
            nearest = known + (raw[event] - sent + half) % modulus - half
            found[event] = np.where(known < 0, raw[event], nearest)
        return found


@dataclass(slots=True)
class Told:
    """Results of a decode besides its tables."""

    tally: Tally
    notes: list[Notes]
    unseen: list[tuple[str, int]] = field(default_factory=list)
    """Channel and node-id of the nodes of which nothing told bits 12 to 15 of 2124h; empty where none was asked for."""

    def events(self) -> list[BusEvent]:
        """Return the EMCYs and the changes of NMT states of the whole recording, in order."""
        joined = BusEvents()
        for notes in self.notes:
            for event in notes.events.found:
                joined.append(event)
        return joined.found


class Recording:
    """Tables of a recording, from consecutive logs or from parts that were decoded separately."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self.channels: list[str] = []
        self.told = Told(Tally(), [])
        self._counters, self._health = Counters(), HealthRows(reading.signals)
        self._merger = SampleMerger(reading.decoder, self.channels, reading.wanted, follows=bool(reading.layouts.eds))

    def tables_of_logs(
        self, names: Iterable[str], progress: Progress | None = None, tap: Tap | None = None
    ) -> Iterator[Table]:
        """Read logs in this process as if they were one. ``tap`` gets the selected frames before their samples."""
        for name in names:
            source = Source(Piece(name), self._reading, progress)
            try:
                for block in source:
                    if tap is not None:
                        tap(block, source.channels)
                    yield from self._add(self._numbered(block, source.channels), source.log.timed)
            finally:
                self.told.notes.append(source.notes)
        yield from self._finish()

    def tables_of_parts(self, parts: Iterable[Iterable[Item]]) -> Iterator[Table]:
        """Join the parts from ``part_items``."""
        for part in parts:
            for item in self._strictly(part):
                if isinstance(item, Table):
                    yield from self._finished(self._renamed(item))
                elif isinstance(item, End):
                    self._take_counts(item)
                    self._take_moduli(item.tail)
                    yield from self._add(self._numbered(item.tail.frames, item.tail.channels), item.notes.timed)
                else:
                    yield from self._join(item)
        yield from self._finish()

    def _strictly(self, part: Iterable[Item]) -> Iterator[Item]:
        """Yield the items; for a part with a bad line, raise it with its number in the whole log."""
        try:
            yield from part
        except StrictError as error:
            before = self.told.notes[-1] if error.goes_on and self.told.notes else None
            if before is None or error.bad is None:
                raise
            raise StrictError(f"{before.source}: {numbered_from(before.lines, error.bad)}") from None

    def _join(self, edge: Edge) -> Iterator[Table]:
        self._take_moduli(edge)
        frames = self._numbered(edge.frames, edge.channels)
        yield from self._add(frames, self._merger.timed)
        if not edge.whole:
            yield from self._flush()

    def _take_moduli(self, edge: Edge) -> None:
        numbers = self._numbers(list(edge.channels))
        self._merger.sync.of |= {int(numbers[channel]): modulus for channel, modulus in edge.moduli}

    def _flush(self) -> Iterator[Table]:
        table = self._merger.finish()
        if table is not None:
            yield from self._finished(table)

    def _finished(self, table: Table) -> Iterator[Table]:
        joined = self._health.joined(self._counters.unwrapped(table))
        if len(joined):
            yield joined

    def _finish(self) -> Iterator[Table]:
        yield from self._flush()
        self.told.tally.append(self._merger.tally)
        self._merger.tally = Tally()
        if joins(self._reading.signals):
            self.told.unseen = self._health.unseen

    def _take_counts(self, end: End) -> None:
        self.told.tally.append(self._merger.tally)  # of the frames before this part
        self._merger.tally = Tally()
        self.told.tally.append(end.tally)
        if end.notes.goes_on and self.told.notes:
            self.told.notes[-1].append(end.notes)
        else:
            self.told.notes.append(end.notes)

    def _add(self, frames: FrameArray, timed: bool) -> Iterator[Table]:
        self._merger.timed = timed
        for table in self._merger.tables(frames):
            yield from self._finished(table)

    def _numbers(self, names: Iterable[str]) -> npt.NDArray[np.uint8]:
        for name in names:
            if name not in self.channels:
                self.channels.append(name)
        if len(self.channels) > MAX_CHANNELS:
            raise InputError(f"the logs have more than {MAX_CHANNELS} interfaces; decode one at a time, with --jobs 1")
        return np.array([self.channels.index(name) for name in names], dtype=np.uint8)

    def _numbered(self, frames: FrameArray, names: Iterable[str]) -> FrameArray:
        """Return the frames with the channel numbers of the whole recording."""
        numbers = self._numbers(list(names))
        if not len(frames) or (numbers == np.arange(len(numbers))).all():
            return frames
        frames = frames.copy()
        frames["channel"] = numbers[frames["channel"]]
        return frames

    def _renamed(self, table: Table) -> Table:
        numbers = self._numbers(table.channels)
        if (numbers == np.arange(len(numbers))).all():
            return replace(table, channels=tuple(self.channels))
        node = table.key & ((1 << NODE_BITS) - 1)
        key = (numbers[table.channel].astype(np.uint16) << NODE_BITS | node).astype(np.uint16)
        return replace(table, key=key, channels=tuple(self.channels))
