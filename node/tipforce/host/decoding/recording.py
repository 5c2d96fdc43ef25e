"""Join the parts of a recording in order: the same tables as from one log, with continuous counters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from tipforce.errors import InputError
from tipforce.host.decoding.counters import Counters, Tally, TallyRow
from tipforce.host.decoding.health import NAMES
from tipforce.host.decoding.health_rows import EMCY, STATE, HealthRows, joins, with_channel
from tipforce.host.decoding.log_part import Notes, Piece, Progress, Reading, Source, StrictError, numbered_from
from tipforce.host.decoding.sample_merger import OpenRows, SampleMerger, renumbered
from tipforce.host.decoding.sample_table import NODE_BITS, Column, Table, flag, in_order
from tipforce.host.decoding.services import BusEvent, BusEvents
from tipforce.host.frames.frame_array import FRAME, MAX_CHANNELS, FrameArray

if TYPE_CHECKING:
    from tipforce.host.decoding.decoded_part import Ends

Tap = Callable[[FrameArray, Sequence[str]], None]
"""Takes FRAME (n,) and the interfaces by number."""


@dataclass(slots=True)
class Told:
    """Results of a decode besides its tables."""

    tally: Tally
    notes: list[Notes]
    unseen: list[tuple[str, int]] = field(default_factory=list)
    """Channel and node-id of the nodes of which nothing told bits 12 to 15 of 2124h; empty where none was asked for."""
    bus: BusEvents = field(default_factory=BusEvents)

    def events(self) -> list[BusEvent]:
        """Return the EMCYs and the changes of NMT states of the whole recording, in order."""
        return self.bus.found


@dataclass(slots=True)
class State:
    """What a recording knows between two parts: numbers and texts only, so that it can be sent and stored."""

    channels: list[str]
    timed: bool
    held: bytes
    """FRAME records of open rows."""
    held_number: list[int]
    syncs: list[tuple[int, int, int, int]]
    counters: dict[int, tuple[int, int]]
    health: dict[int, tuple[int, int]]
    sampled: list[int]
    nmt: list[tuple[str, int, int]]
    """NMT state by channel and node-id."""
    tally: list[TallyRow]
    short: list[tuple[str, int, str, int]]
    calibrations: list[tuple[str, int, int]] = field(default_factory=list)
    """CRC-32 by channel and node-id."""


class Recording:
    """Tables of a recording, from consecutive logs or from parts that were decoded separately."""

    def __init__(self, reading: Reading, state: State | None = None) -> None:
        """``state`` as ``state()`` returned it after the parts in front."""
        self.reading = reading
        self.channels: list[str] = []
        self.told = Told(Tally(), [], bus=BusEvents(reading.layouts.nodes))
        self._counters, self._health = Counters(), HealthRows(reading.signals)
        self._merger = SampleMerger(reading.decoder, self.channels, reading.wanted, follows=bool(reading.layouts.eds))
        if state is not None:
            self._set(state)

    def resume(self, state: State, notes: Notes, services: Iterable[FrameArray]) -> None:
        """Take over from a recording that began with this one's state and read the next part with these services."""
        self._take_notes(notes)
        for frames in services:
            self.told.bus.add(frames, notes.channels)
        self._set(state)
        if joins(self.reading.signals):
            self.told.unseen = self._health.unseen

    def _set(self, state: State) -> None:
        self.channels[:] = state.channels
        merger = self._merger
        held: FrameArray = np.frombuffer(state.held, dtype=FRAME).copy()
        merger.timed = state.timed
        merger.resume(OpenRows(held, np.array(state.held_number, dtype=np.int64), state.syncs))
        self._counters, self._health = Counters(state.counters), HealthRows(self.reading.signals, state.health)
        for key in state.sampled:
            self._health.sampled[key] = self.channels[key >> NODE_BITS], key & ((1 << NODE_BITS) - 1)
        bus = self.told.bus
        bus.states = {(channel, node): code for channel, node, code in state.nmt}
        bus.calibrations = {(channel, node): crc for channel, node, crc in state.calibrations}
        self.told.tally, merger.tally = Tally(), Tally()
        self.told.tally.set_rows(state.tally, state.short)

    def state(self) -> State:
        """Return what the next part of the recording depends on."""
        frames, number, syncs = self._merger.open
        self._take_tally()
        tally, short = self.told.tally.rows()
        bus = self.told.bus
        return State(
            list(self.channels), self._merger.timed, frames.tobytes(), number.tolist(), syncs,
            dict(self._counters.last), self._health.told, list(self._health.sampled),
            [(*place, code) for place, code in bus.states.items()], tally, short,
            [(*place, crc) for place, crc in bus.calibrations.items()],
        )  # fmt: skip

    def tables_of_piece(
        self, piece: Piece, progress: Progress | None = None, tap: Tap | None = None
    ) -> Iterator[Table]:
        """Read the next log, or part of one, in this process. Raises InputError, StrictError."""
        source = Source(piece, self.reading, progress)
        before = self._merger.timed or not source.notes.goes_on
        try:
            for block in source:
                if tap is not None:
                    tap(block, source.channels)
                self.told.bus.add(block, source.channels)
                self._merger.timed = before and source.log.timed
                for table in self._merger.tables(renumbered(block, self.numbers_of(source.channels))):
                    yield from self._finished(table)
        except StrictError as error:
            raise self.numbered(error) from None
        finally:
            self._take_notes(source.notes)

    def numbered(self, error: StrictError) -> StrictError:
        """Return the error of a part with the line's number in the whole log."""
        before = self.told.notes[-1] if error.goes_on and self.told.notes else None
        if before is None or error.bad is None:
            return error
        return StrictError(f"{before.source}: {numbered_from(before.lines, error.bad)}")

    def finish(self) -> Iterator[Table]:
        """Yield the rows that are still open: the recording ends."""
        table = self._merger.finish()
        if table is not None:
            yield from self._finished(table)
        self._take_tally()
        if joins(self.reading.signals):
            self.told.unseen = self._health.unseen

    def follow(self, ends: Ends, *, last: bool = False) -> tuple[Column, ...] | None:
        """Take a part that was decoded apart as the next one; return the columns of all its rows, in order.

        None, without a change, for a part that must be decoded after the ones in front: by ``tables_of_piece`` of a
        recording with the present ``state``. ``last``: the recording ends with this part.
        """
        rows = self._head(ends)
        if rows is None:
            return None
        numbers, told = self.numbers_of(ends.channels), self._health.told
        self._counters.skip(*ends.counters, numbers)
        self._health.skip(ends.health, ends.sampled, numbers, self.channels)
        self._take_tally()
        self.told.tally.append(ends.tally)
        self._take_notes(ends.notes)
        for frames in ends.services:
            self.told.bus.add(frames, ends.channels)
        self._merger.timed = self._merger.timed and ends.notes.timed
        self._merger.resume(ends.tail.renumbered(numbers))
        rows += self.finish() if last else ()
        columns = {column.name: column for column in ends.columns if column.name not in (EMCY, STATE)}
        for table in rows:
            columns = {column.name: column for column in table.columns} | columns
        seen = [change.seen_ever for change in ends.health.values()]
        seen += [told.get(with_channel(key, numbers), (0, 0))[1] for key in ends.keys]
        for name, bit in NAMES.items():
            if any(bits >> bit & 1 for bits in seen) and (self.reading.signals is None or name in self.reading.signals):
                columns.setdefault(name, flag(name))
        return in_order(columns.values(), self.reading.signals)

    def rows_of_part(self, ends: Ends, kept: Iterable[Table], *, last: bool = False) -> Iterator[Table]:
        """Yield all rows of the next part, which ``follow`` took elsewhere; ``kept``: those behind its head."""
        yield from self._head(ends) or ()
        numbers, timed = self.numbers_of(ends.channels), self._merger.timed
        for table in kept:
            yield from self._finished(table.renumbered(numbers, tuple(self.channels), timed))
        self._merger.resume(ends.tail.renumbered(numbers))
        if last:
            yield from self.finish()

    def _head(self, ends: Ends) -> list[Table] | None:
        """Decode the head of a part; None, without a change, if what follows is not what the part has decoded."""
        if ends.head is None:
            return None
        before, numbers = self.state(), self.numbers_of(ends.channels)
        self._merger.timed = ends.timed and (self._merger.timed or not ends.notes.goes_on)
        tables = self._merger.tables(renumbered(ends.head, numbers))
        rows = [row for table in tables for row in self._finished(table)]
        if self._merger.open.equals(ends.behind_head.renumbered(numbers)):
            return rows
        self._set(before)
        return None

    def _finished(self, table: Table) -> Iterator[Table]:
        joined = self._health.joined(self._counters.unwrapped(table))
        if len(joined):
            yield joined

    def _take_tally(self) -> None:
        self.told.tally.append(self._merger.tally)
        self._merger.tally = Tally()

    def _take_notes(self, notes: Notes) -> None:
        if notes.goes_on and self.told.notes and self.told.notes[-1].source == notes.source:
            self.told.notes[-1].append(notes)
        else:
            self.told.notes.append(replace(notes, bad={**notes.bad}, skipped={**notes.skipped}))

    def numbers_of(self, names: Iterable[str]) -> list[int]:
        """Return the numbers of interfaces; new ones are added. Raises InputError for too many."""
        self.channels += [name for name in dict.fromkeys(names) if name not in self.channels]
        if len(self.channels) > MAX_CHANNELS:
            raise InputError(f"the logs have more than {MAX_CHANNELS} interfaces; decode one at a time, with --jobs 1")
        return [self.channels.index(name) for name in names]
