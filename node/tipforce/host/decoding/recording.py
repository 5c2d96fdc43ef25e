"""The tables of a recording from logs in sequence, or from parts that are decoded apart, with the same result. The head
of a part is decoded again after the parts in front; if that ends in the same ``State``, the rows behind it are right
(except counters and faults), else the whole part is decoded again."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, TypeVar

import numpy as np

from tipforce.errors import InputError
from tipforce.host.decoding.counters import Counters, Tally, TallyRow
from tipforce.host.decoding.health import HealthRows, joins
from tipforce.host.decoding.log_part import Piece, Progress, Reading, Source, StrictError
from tipforce.host.decoding.sample_merger import OpenRows, SampleMerger, renumbered
from tipforce.host.decoding.sample_rule import GAP_FRAMES, GAP_NS
from tipforce.host.decoding.sample_table import Column, Table, in_order
from tipforce.host.decoding.service_frames import services
from tipforce.host.decoding.services import BusEvents
from tipforce.host.frames.frame_array import FRAME, MAX_CHANNELS, FrameArray
from tipforce.host.logs.notes import LogNotes

_STEP_FRAMES = 2048  # by which a head grows
_HEAD_NS, _HEAD_FRAMES = 5 * GAP_NS, 5 * GAP_FRAMES  # in either a row of a few PDOs ends, and the wait for the next
_IN_MEMORY_BYTES = 100_000_000
"""Of the rows of one part; more are kept in a temporary file."""
Tap = Callable[[FrameArray, Sequence[str]], None]
"""Takes FRAME (n,) and the interfaces by number."""
Headers = list[tuple[tuple[Column, ...], tuple[str, ...]]]
"""Headers and channels of tables, each time they change."""


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


@dataclass(slots=True)
class Passed:
    """What a part of a recording leaves: the ``state`` behind it, and what else is told of it."""

    state: State
    notes: LogNotes
    services: list[FrameArray]
    """All frames that ``BusEvents`` looks at; channels are numbered as in ``notes.channels``."""
    columns: Headers
    """Of a part that was decoded apart, one element: all of them, in order."""


class Recording:
    """Tables of a recording, from consecutive logs or from parts that were decoded separately, and what else it has."""

    def __init__(self, reading: Reading, state: State | None = None) -> None:
        """``state`` as ``state()`` returned it after the parts in front."""
        self.reading = reading
        self.channels: list[str] = []
        self.notes: list[LogNotes] = []
        self.bus = BusEvents(reading.layouts.nodes)
        self.unseen: list[tuple[str, int]] = []
        """Channel and node-id of the nodes of which nothing told bits 12 to 15 of 2124h; empty where none was asked."""
        self._counters, self._health = Counters(), HealthRows(reading.signals)
        self._merger = SampleMerger(reading.decoder, self.channels, reading.wanted, follows=bool(reading.layouts.eds))
        if state is not None:
            self._set(state)
            self.bus.states = {(channel, node): code for channel, node, code in state.nmt}
            self.bus.calibrations = {(channel, node): crc for channel, node, crc in state.calibrations}

    @property
    def tally(self) -> Tally:
        """Samples and lost ones, of all rows until now."""
        return self._merger.tally

    def append(self, other: Recording) -> None:
        """Add what is known of logs that follow, besides their tables."""
        self.tally.append(other.tally)
        self.notes += other.notes
        self.unseen = sorted({*self.unseen, *other.unseen})
        self.bus.found += other.bus.found

    def resume(self, passed: Passed) -> None:
        """Take over from a recording that began with this one's state and read the next part."""
        self._take_notes(passed.notes)
        self._set(passed.state)
        for frames in passed.services:
            self.bus.add(frames, passed.notes.channels, passed.notes.timed)
        self._see()

    def _set(self, state: State) -> None:
        self.channels[:] = state.channels
        merger = self._merger
        held: FrameArray = np.frombuffer(state.held, dtype=FRAME).copy()
        merger.timed = state.timed
        merger.resume(OpenRows(held, np.array(state.held_number, dtype=np.int64), state.syncs))
        self._counters = Counters(state.counters)
        self._health = HealthRows(self.reading.signals, state.health, state.sampled)
        merger.tally = Tally.of_rows(state.tally, state.short)

    def state(self) -> State:
        """Return what the next part of the recording depends on."""
        held, number, syncs = self._merger.open
        return State(
            list(self.channels), self._merger.timed, held.tobytes(), number.tolist(), syncs,
            dict(self._counters.last), self._health.told, list(self._health.sampled),
            [(*place, code) for place, code in self.bus.states.items()],
            [(*place, *count) for place, count in self.tally.messages.items()],
            [(*place, frames) for place, frames in self.tally.short.items()],
            [(*place, crc) for place, crc in self.bus.calibrations.items()],
        )  # fmt: skip

    def tables_of_piece(
        self, piece: Piece, progress: Progress | None = None, tap: Tap | None = None
    ) -> Iterator[Table]:
        """Read the next log, or part of one, in this process. Raises InputError, StrictError."""
        source = Source(piece, self.reading, progress)
        before = self._merger.timed or not source.goes_on
        try:
            for block in source:
                if tap is not None:
                    tap(block, source.channels)
                self.bus.add(block, source.channels, source.timed)
                self._merger.timed = before and source.timed
                yield from self._finished(self._merger.tables(renumbered(block, self.numbers_of(source.channels))))
        except StrictError as error:
            raise self.numbered(error) from None
        finally:
            self.reading = replace(self.reading, origin_ns=source.origin_ns)  # of a pipe it was not known before
            self._take_notes(source)

    def numbered(self, error: StrictError) -> StrictError:
        """Return the error of a part with the line's number in the whole log."""
        before = self.notes[-1] if error.goes_on and self.notes else None
        if before is None or error.bad is None:
            return error
        return StrictError(f"{before.source}: {error.bad.moved(before.lines)}")

    def finish(self) -> Iterator[Table]:
        """Yield the rows that are still open: the recording ends."""
        yield from self._finished(self._merger.finish())
        self._see()

    def tables_of_part(self, part: DecodedPart, last: bool) -> Iterator[Table] | None:
        """The tables of the next part, decoded apart; ``last``: and of ``finish``. None (this is then of no use): it is
        to be decoded after those in front."""
        if part.behind_head is None:
            return None
        before, numbers = self._merger.timed or not part.notes.goes_on, self.numbers_of(part.notes.channels)
        self._merger.timed = before and part.head_timed
        rows = [*self._merger.tables(renumbered(np.concatenate(part.head), numbers))]
        if not self._merger.open.equals(part.behind_head.renumbered(numbers)):
            return None
        end = self.finish() if last else ()
        return chain(self._finished(rows), self._behind_head(part, numbers, before), end)

    def _behind_head(self, part: DecodedPart, numbers: Sequence[int], before: bool) -> Iterator[Table]:
        channels, timed = tuple(self.channels), self._merger.timed
        yield from self._finished(table.renumbered(numbers, channels, timed) for table in part.kept)
        self._merger.timed = before and part.notes.timed
        self._merger.resume(part.tail.renumbered(numbers))
        self._merger.tally.append(part.tally)
        self._take_notes(part.notes)

    def _finished(self, tables: Iterable[Table]) -> Iterator[Table]:
        """Yield the tables with their counters unwrapped and the faults joined, none empty."""
        unwrapped = map(self._counters.unwrapped, tables) if self.reading.rows else tables
        return filter(len, map(self._health.joined, unwrapped))

    def _see(self) -> None:
        self.unseen = self._health.unseen(self.channels) if joins(self.reading.signals) else []

    def _take_notes(self, notes: LogNotes) -> None:
        if notes.goes_on and self.notes and self.notes[-1].source == notes.source:
            self.notes[-1].append(notes)
        else:
            self.notes.append(notes.copy())

    def numbers_of(self, names: Iterable[str]) -> list[int]:
        """Return the numbers of interfaces; new ones are added. Raises InputError for too many."""
        self.channels += [name for name in dict.fromkeys(names) if name not in self.channels]
        if len(self.channels) > MAX_CHANNELS:
            raise InputError(f"the logs have more than {MAX_CHANNELS} interfaces; decode one at a time, with --jobs 1")
        return [self.channels.index(name) for name in names]


T = TypeVar("T")


def decode_after(
    before: State, piece: Piece, reading: Reading, last: bool, take: Callable[[Iterable[Table]], T]
) -> tuple[Passed, T]:  # fmt: skip
    """Read a part after those in front. ``take`` takes its rows; return what the part leaves, and what ``take`` did;
    ``last``: the recording ends with it. Raises as ``Recording.tables_of_piece``."""
    recording, few, columns = Recording(reading, before), list[FrameArray](), Headers()
    tables = recording.tables_of_piece(piece, tap=lambda block, _: few.append(services(block)))
    taken = take(_noting(chain(tables, recording.finish() if last else ()), columns))
    return Passed(recording.state(), recording.notes[0], few, columns), taken


def _noting(tables: Iterable[Table], columns: Headers) -> Iterator[Table]:
    """Yield tables; append their columns and channels each time they change."""
    for table in tables:
        if columns[-1:] != [(table.columns, table.channels)]:
            columns.append((table.columns, table.channels))
        yield table


class DecodedPart:
    """A part that is decoded before the ``State`` of the recording in front of it is known."""

    def __init__(self, piece: Piece, reading: Reading) -> None:
        """Read and decode it. Raises InputError for a log that can't be read, StrictError for a bad line."""
        self._piece, self._reading = piece, reading
        source = Source(piece, reading)
        merger = SampleMerger(reading.decoder, source.channels, reading.wanted)
        self.services, self.kept = list[FrameArray](), _Kept()
        self.head: list[FrameArray] = []
        self.behind_head: OpenRows | None = None
        """None for a part that is too short: it must be decoded after the others."""
        self.head_timed = True
        self._rows: _Kept | None = None  # all that begin in it, from ``follow`` on
        for block in source:
            self.services.append(services(block))
            merger.channels, merger.timed, rest = source.channels, source.timed, block
            while self.behind_head is None and len(rest):
                self.head.append(rest[:_STEP_FRAMES])
                rest = rest[_STEP_FRAMES:]
                for _ in merger.tables(self.head[-1]):
                    pass
                # No row behind the head depends on what is in front of it.
                span_ns = self.head[-1]["t_ns"][-1] - self.head[0]["t_ns"][0]
                is_long = span_ns > _HEAD_NS or sum(map(len, self.head)) > _HEAD_FRAMES
                if is_long and merger.sync.settled:
                    self.behind_head, self.head_timed, merger.tally = merger.open, merger.timed, Tally()
                    self.head = [np.concatenate(self.head)]
            self.kept.extend(merger.tables(rest) if len(rest) else ())
        self.notes = source.copy()
        self.tail, self.tally = merger.open, merger.tally
        if self.behind_head is None:
            self.head.clear()

    def follow(self, before: State, *, last: bool) -> Passed:
        """Return what the part leaves after ``before``; ``last``: the recording ends with it."""
        recording, columns, self._rows = Recording(self._reading, before), Headers(), _Kept()
        if (tables := recording.tables_of_part(self, last)) is None:  # a log that grows may have more now
            self.kept = _Kept()
            return decode_after(before, self._piece, self._reading, last, self._rows.extend)[0]
        self._rows.extend(_noting(tables, columns))
        known = {column.name: column for of_table, _ in columns for column in of_table}
        headers = [(in_order(known.values(), self._reading.signals), columns[-1][1])] if columns else []
        return Passed(recording.state(), recording.notes[0], self.services, headers)

    def rows(self, before: State, *, last: bool) -> Iterator[Table]:
        """Yield all rows that begin in this part, in order, with these arguments of ``follow``; they are not kept."""
        if self._rows is None:  # a cluster moved the part before another copy followed
            self.follow(before, last=last)
        rows, self._rows, self.kept, self.behind_head = self._rows, None, _Kept(), None
        return iter(()) if rows is None else rows.taken()


class _Kept:
    """Tables in order: the first in memory, the others in a temporary file."""

    def __init__(self) -> None:
        self._first: list[Table] = []
        self._bytes = 0
        self._file: Any = None

    def extend(self, tables: Iterable[Table]) -> None:
        for table in tables:
            self._bytes += table.t_ns.nbytes + sum(column.nbytes for column in table.values.values())
            if self._bytes < _IN_MEMORY_BYTES:
                self._first.append(table)
                continue
            if self._file is None:
                import tempfile

                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed after the last row
            pickle.dump(table, self._file, protocol=5)

    def taken(self) -> Iterator[Table]:
        """Yield the tables; each can be freed when the next one is asked for."""
        self._first.reverse()
        while self._first:
            yield self._first.pop()
        yield from self

    def __iter__(self) -> Iterator[Table]:
        yield from self._first
        if self._file is not None:
            self._file.seek(0)
            with suppress(EOFError):
                while True:
                    yield pickle.load(self._file)

    def __del__(self) -> None:
        if self._file is not None:
            self._file.close()

    def __getstate__(self) -> list[Table]:
        """Return all tables: a cluster moved the part to another worker."""
        return [*self]

    def __setstate__(self, state: list[Table]) -> None:
        self.__init__()  # type: ignore[misc]
        self.extend(state)
