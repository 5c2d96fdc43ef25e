"""Join the parts of a recording in order: the same tables as from one log, with continuous counters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.host.decoding.counters import Counters, Tally, TallyRow
from tipforce.host.decoding.health_rows import HealthRows, joins
from tipforce.host.decoding.log_part import Notes, Piece, Progress, Reading, Source, StrictError, numbered_from
from tipforce.host.decoding.sample_merger import SampleMerger
from tipforce.host.decoding.sample_table import NODE_BITS, Table
from tipforce.host.decoding.services import BusEvent, BusEvents
from tipforce.host.decoding.sync_modulus import SAMPLES, SyncModulus, Syncs
from tipforce.host.frames.frame_array import FRAME, MAX_CHANNELS, FrameArray

if TYPE_CHECKING:
    from tipforce.host.decoding.decoded_part import Ends, Start

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
        self.told = Told(Tally(), [])
        self._counters, self._health = Counters(), HealthRows(reading.signals)
        self._merger = SampleMerger(reading.decoder, self.channels, reading.wanted, follows=bool(reading.layouts.eds))
        if state is not None:
            self._set(state)

    def resume(self, state: State, notes: Iterable[Notes]) -> None:
        """Take over from a recording that began with this one's state and read the next part."""
        for one in notes:
            self._take_notes(one)
        self._set(state)
        if joins(self.reading.signals):
            self.told.unseen = self._health.unseen

    def _set(self, state: State) -> None:
        self.channels[:] = state.channels
        merger = self._merger
        merger.timed, merger.sync = state.timed, SyncModulus(state.syncs)
        held: FrameArray = np.frombuffer(state.held, dtype=FRAME).copy()
        merger.hold(held, np.array(state.held_number, dtype=np.int64))
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
        frames, number = self._merger.held
        self._take_tally()
        tally, short = self.told.tally.rows()
        bus = self.told.bus
        return State(
            list(self.channels), self._merger.timed, frames.tobytes(), number.tolist(), self._merger.sync.state,
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
                self._merger.timed = before and source.log.timed
                for table in self._merger.tables(self._numbered(block, source.channels)):
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
        yield from self._flush()
        self._take_tally()
        if joins(self.reading.signals):
            self.told.unseen = self._health.unseen

    def follow(self, ends: Ends, *, last: bool = False) -> Start | None:
        """Take a part that was decoded separately as the next one, and return what completes its rows.

        None, without a change, for a part that must be decoded after the ones in front: by ``tables_of_piece`` of a
        recording with the present ``state``. ``last``: the recording ends with this part.
        """
        from tipforce.host.decoding.decoded_part import Start  # not where one process reads the logs

        if not ends.separable or ends.head is None or ends.tail is None or not self._fits(ends):
            return None
        numbers = self.numbers_of(ends.channels).tolist()
        merger, counted = self._merger, len(self.told.bus.found)
        merger.timed = timed = merger.timed or not ends.notes.goes_on
        seen, _ = ends.looked[0]
        self._look(seen, numbers)
        table = merger.add(self._numbered(ends.head.frames, ends.channels), number=ends.head.number)
        before = [*(self._finished(table) if table is not None else ()), *self._flush()]
        start = Start(
            tuple(self.channels), numbers, dict(self._counters.last), self._health.told, timed, before, [], []
        )
        for seen, _ in ends.looked[1:]:
            self._look(seen, numbers)
        self._counters.skip(*ends.counters, numbers)
        self._health.skip(ends.health, ends.sampled, numbers, self.channels)
        self._take_tally()
        self.told.tally.append(ends.tally)
        self._take_notes(ends.notes)
        merger.timed = timed and ends.notes.timed
        merger.hold(self._numbered(ends.tail.frames, ends.channels), ends.tail.number)
        start.after += list(self.finish()) if last else []
        start.events += self.told.bus.found[counted:]
        return start

    def _fits(self, ends: Ends) -> bool:
        """Return whether the part has found the same moduli of counters as it does after the parts in front."""
        numbers = self.numbers_of(ends.channels).tolist()
        here = SyncModulus(self._merger.sync.state)
        for seen in ends.looked[0][0]:
            if (here.of.get(numbers[seen.channel], SAMPLES) != SAMPLES) != seen.numbered:
                return False
        for seen_now, moduli in ends.looked:
            for seen in seen_now:
                here.take(seen._replace(channel=numbers[seen.channel]))
            found = {numbers[channel]: modulus for channel, modulus in moduli.items()}
            if any(found.get(k, SAMPLES) != here.of.get(k, SAMPLES) for k in {*found, *here.of}):
                return False
        return True

    def _look(self, seen: Iterable[Syncs], numbers: Sequence[int]) -> None:
        for one in seen:
            self._merger.sync.take(one._replace(channel=numbers[one.channel]))

    def _flush(self) -> Iterator[Table]:
        table = self._merger.finish()
        if table is not None:
            yield from self._finished(table)

    def _finished(self, table: Table) -> Iterator[Table]:
        joined = self._health.joined(self._counters.unwrapped(table))
        if len(joined):
            yield joined

    def _take_tally(self) -> None:
        self.told.tally.append(self._merger.tally)
        self._merger.tally = Tally()

    def _take_notes(self, notes: Notes) -> None:
        for event in notes.events.found:
            self.told.bus.append(event)
        if notes.goes_on and self.told.notes and self.told.notes[-1].source == notes.source:
            self.told.notes[-1].append(notes)
        else:
            self.told.notes.append(notes)

    def numbers_of(self, names: Iterable[str]) -> npt.NDArray[np.uint8]:
        """Return the numbers of interfaces; new ones are added. Raises InputError for too many."""
        for name in names:
            if name not in self.channels:
                self.channels.append(name)
        if len(self.channels) > MAX_CHANNELS:
            raise InputError(f"the logs have more than {MAX_CHANNELS} interfaces; decode one at a time, with --jobs 1")
        return np.array([self.channels.index(name) for name in names], dtype=np.uint8)

    def _numbered(self, frames: FrameArray, names: Iterable[str]) -> FrameArray:
        """Return the frames with the channel numbers of the whole recording."""
        numbers = self.numbers_of(list(names))
        if not len(frames) or (numbers == np.arange(len(numbers))).all():
            return frames
        frames = frames.copy()
        frames["channel"] = numbers[frames["channel"]]
        return frames
