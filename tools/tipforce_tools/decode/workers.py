"""Decode the parts of a recording with any number of workers, each of which writes the rows of its parts itself.

A worker decodes a part and keeps its rows; the parts' ends come here, where a pass in order (``Recording.follow``)
finds what each part cannot know; then the worker completes and writes its rows. What comes back is a record of what
was written, never a row. A part is repeated if its worker dies.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from itertools import chain
from multiprocessing import connection
from operator import itemgetter
from typing import Any, Protocol

import numpy as np

from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce.host.decoding.decoded_part import DecodedPart, Ends
from tipforce.host.decoding.duplicates import services
from tipforce.host.decoding.log_part import Notes, Piece, Reading, StrictError
from tipforce.host.decoding.recording import Recording, State
from tipforce.host.decoding.sample_table import Table
from tipforce.host.decoding.services import BusEvent
from tipforce.host.frames.frame_array import FrameArray
from tipforce_tools.decode.summary import Summary
from tipforce_tools.writing.writers import Shape


class Sink(Protocol):
    """Writes the rows of a part; it can be sent to another process."""

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> Any:
        """Write the rows of part ``number`` with the columns of ``shape``; return a record. Raises OSError."""


@dataclass(slots=True)
class Written:
    """What was written of a part. ``shape``: its columns, and those of the parts in front."""

    number: int
    piece: Piece
    record: Any
    shape: Shape
    summary: Summary
    state: State | None = None
    """Of the recording after it."""
    notes: Notes | None = None
    """Of a part that was decoded after the ones in front, as ``services``: the frames that ``BusEvents`` looks at."""
    services: list[FrameArray] = field(default_factory=list)
    frames: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    """Bad lines by reason."""
    events: list[BusEvent] = field(default_factory=list)


Event = tuple[int, Ends | Written | Exception]
"""What a worker says of a part by its number: its Ends, what was written, or an error."""


class Workers(Protocol):
    """Workers for a sequence of parts."""

    @property
    def free(self) -> int:
        """How many parts can be begun now."""

    def decode(self, number: int, piece: Piece) -> None:
        """Begin to decode a part."""

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        """Complete and write a part after ``before``: as it was decoded apart, or decode it now."""

    def next(self) -> Event:
        """Wait for the next event. Raises EnvironmentLackError if a part cannot be finished."""

    def close(self) -> None:
        """End all work."""


class Work:
    """What a worker does with one part, in whatever process. An error that a user can cause is returned."""

    def __init__(self, number: int, piece: Piece, reading: Reading) -> None:
        self._number, self._piece, self._reading = number, piece, reading
        self._part: DecodedPart | None = None

    def decode(self) -> Ends | Exception:
        """Decode the part and keep its rows."""
        try:
            self._part = DecodedPart(self._piece, self._reading)
            return self._part.ends
        except (TipforceError, OSError) as error:
            return error

    def write(self, sink: Sink, before: State, apart: bool, shape: Shape, last: bool) -> Written | Exception:
        """Complete and write the rows, see ``Workers``."""
        summary, recording, few = Summary(self._reading.reasons), None, list[FrameArray]()
        try:
            tables: Iterable[Table]
            if apart:
                assert self._part is not None
                tables = self._part.rows(before, last=last)
            else:
                recording = Recording(self._reading, before)
                tables = recording.tables_of_piece(self._piece, tap=lambda block, _: few.append(services(block)))
                tables = chain(tables, recording.finish() if last else ())
            record = sink.write(self._number, summary.passing(tables), shape)
        except (TipforceError, OSError) as error:
            return error
        written = Written(self._number, self._piece, record, shape, summary, services=few)
        if recording is not None:
            written.state, written.notes = recording.state(), recording.told.notes[0]
        return written


class Here(Workers):
    """This process as the only worker: each part is decoded after the ones in front."""

    def __init__(self, reading: Reading, sink: Sink) -> None:
        self._reading, self._sink = reading, sink
        self._pieces: dict[int, Piece] = {}
        self._events: list[Event] = []

    @property
    def free(self) -> int:
        return int(not self._pieces)

    def decode(self, number: int, piece: Piece) -> None:
        self._pieces[number] = piece
        self._events.append((number, Ends((), Notes(piece.name))))

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        work = Work(number, self._pieces.pop(number), self._reading)
        self._events.append((number, work.write(self._sink, before, apart, shape, last)))

    def next(self) -> Event:
        return self._events.pop(0)

    def close(self) -> None:
        pass


class InOrder:
    """The pass over the parts of a recording in order, while workers decode and write them."""

    def __init__(
        self, pieces: Sequence[Piece], recording: Recording, shape: Shape, workers: Workers, *, ends: bool = True
    ) -> None:
        """``ends``: the recording ends with the last part."""
        self._pieces, self._recording, self._shape = pieces, recording, shape
        self._workers, self._ends = workers, ends
        self._known: dict[int, Ends | Exception] = {}
        self._written: dict[int, Written] = {}
        self._told: dict[int, tuple[State, int, dict[str, int], list[BusEvent]]] = {}
        self._begun = self._followed = self._given = 0
        self._alone = False

    def __iter__(self) -> Iterator[Written]:
        """Yield what was written, in order. Raises the errors of the decoding and the writing in order, too."""
        try:
            while self._given < len(self._pieces):
                while self._begun < len(self._pieces) and self._workers.free:
                    self._workers.decode(self._begun, self._pieces[self._begun])
                    self._begun += 1
                self._take(*self._workers.next())
                self._follow()
                while self._given in self._written:
                    written = self._written.pop(self._given)
                    written.state, written.frames, written.bad, written.events = self._told.pop(written.number)
                    self._given += 1
                    yield written
        finally:
            self._workers.close()

    def _take(self, number: int, told: Ends | Written | Exception) -> None:
        if not isinstance(told, Written):
            if isinstance(told, Exception) and number < self._followed + self._alone:
                raise self._numbered(told) if number == self._followed else told
            self._known[number] = told
            return
        self._written[number] = told
        if told.state is not None and told.notes is not None and number == self._followed:
            events = len(self._recording.told.bus.found)
            self._recording.resume(told.state, told.notes, told.services)
            self._shape = copy(told.shape)
            self._passed(number, told.notes, events)
            self._alone = False

    def _follow(self) -> None:
        """Tell the parts whose turn it is what the parts in front leave."""
        while not self._alone and self._followed in self._known:
            number, ends = self._followed, self._known.pop(self._followed)
            if isinstance(ends, Exception):
                raise self._numbered(ends)
            last = self._ends and number == len(self._pieces) - 1
            before, events = self._recording.state(), len(self._recording.told.bus.found)
            columns = self._recording.follow(ends, last=last)
            if columns is None:
                self._alone = True
            else:
                self._shape.take(columns, self._recording.channels)
                self._passed(number, ends.notes, events)
            self._workers.write(number, before, not self._alone, copy(self._shape), last)

    def _passed(self, number: int, notes: Notes, events: int) -> None:
        """Note what the recording knows after a part, which had so many ``events`` before it."""
        bus = self._recording.told.bus.found[events:]
        self._told[number] = self._recording.state(), notes.frames, notes.bad, bus
        self._followed = number + 1

    def _numbered(self, error: Exception) -> Exception:
        return self._recording.numbered(error) if isinstance(error, StrictError) else error


_KEPT_BYTES = 31 << 20  # glibc keeps twice as much
_TRIES = 3
"""Of a part whose worker dies."""


class Processes(Workers):
    """Processes, each with one part at a time. The work of a process that dies is repeated in another."""

    def __init__(self, jobs: int, reading: Reading, sink: Sink) -> None:
        """Start the processes. With fork that is before a library of an output starts threads."""
        self._work = reading, sink
        self._context: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
        self._idle: list[tuple[Any, Any]] = []
        self._busy: dict[int, tuple[Any, Any]] = {}
        for _ in range(jobs):
            self._idle.append(self._started())
        self._orders: dict[int, list[tuple[Any, ...]]] = {}  # of each part, to be repeated
        self._known: set[int] = set()  # parts whose ends were returned
        self._tries: dict[int, int] = {}

    def _started(self) -> tuple[Any, Any]:
        here, there = self._context.Pipe()
        # A forked process has the ends of the others too: open there, they would hide that this process has ended.
        forked = self._context.get_start_method() == "fork"
        inherited = [here, *(pipe for _, pipe in (*self._idle, *self._busy.values()))] if forked else []
        process = self._context.Process(target=_serve, args=(there, inherited, *self._work), daemon=True)
        process.start()
        there.close()
        return process, here

    @property
    def free(self) -> int:
        return len(self._idle)

    def decode(self, number: int, piece: Piece) -> None:
        self._busy[number] = self._idle.pop()
        self._order(number, ("decode", number, piece))

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        self._order(number, ("write", before, apart, shape, last))

    def _order(self, number: int, order: tuple[Any, ...]) -> None:
        self._orders.setdefault(number, []).append(order)
        with suppress(BrokenPipeError, ConnectionResetError):  # next() sees that the process has died
            self._busy[number][1].send(order)

    def next(self) -> Event:
        while True:
            pipes = {pipe: number for number, (_, pipe) in self._busy.items()}
            pipe: Any = connection.wait(list(pipes))[0]
            number = pipes[pipe]
            try:
                told = pipe.recv()
            except (EOFError, ConnectionResetError):
                self._repeat(number)
                continue
            if isinstance(told, Written | Exception):
                self._idle.append(self._busy.pop(number))
                self._orders.pop(number)
            elif number in self._known:
                continue  # repeated: its ends are the same
            self._known.add(number)
            return number, told

    def _repeat(self, number: int) -> None:
        process, pipe = self._busy.pop(number)
        process.join()
        pipe.close()
        self._tries[number] = self._tries.get(number, 1) + 1
        piece: Piece = self._orders[number][0][2]
        if self._tries[number] > _TRIES:
            raise EnvironmentLackError(
                f"{piece.name}: the decoding process ended with {process.exitcode} {_TRIES} times at bytes "
                f"{piece.start} to {piece.end or 'the end'}: too little memory? Try --jobs 1"
            )
        self._busy[number] = self._started()
        for order in self._orders[number]:
            self._busy[number][1].send(order)

    def close(self) -> None:
        for process, pipe in [*self._idle, *self._busy.values()]:
            process.kill()
            process.join()
            pipe.close()


def _serve(pipe: Any, inherited: list[Any], reading: Reading, sink: Sink) -> None:
    """Work on one part after another, until the other end of the pipe is closed."""
    for other in inherited:
        other.close()
    np.empty(_KEPT_BYTES, dtype=np.uint8)  # as in host.logs.lines: the memory of a part is kept for the next one
    work: Work | None = None
    with suppress(KeyboardInterrupt, EOFError, BrokenPipeError):
        while True:
            match pipe.recv():
                case "decode", number, piece:
                    work = Work(number, piece, reading)
                    pipe.send(work.decode())
                case "write", *order if work is not None:
                    done = work.write(sink, *order)
                    work = None  # its rows are not kept while the process waits
                    pipe.send(done)


CONNECT_S = 10
"""Timeout of the scheduler's response."""
_PER_THREAD = 2
"""Parts in work for each thread of the cluster: one is decoded while another one waits for the parts in front."""


class Cluster(Workers):
    """The workers of a scheduler. They must see the logs and the output by the same names."""

    def __init__(self, scheduler: str, reading: Reading, sink: Sink) -> None:
        """Raises EnvironmentLackError without Dask or without a response of the scheduler."""
        try:
            import distributed
        except ImportError:
            raise EnvironmentLackError("--scheduler needs Dask: `pip install 'tipforce[dask]'`") from None
        try:
            self._client: Any = distributed.Client(scheduler, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise EnvironmentLackError(f"--scheduler {scheduler}: no response: {error}") from error
        self._waiting: Any = distributed.as_completed([])
        self._reading, self._sink = reading, sink
        self._works: dict[int, Any] = {}
        self._numbers: dict[str, int] = {}

    @property
    def free(self) -> int:
        threads: int = sum(self._client.nthreads().values())
        return max(_PER_THREAD * max(threads, 1) - len(self._works), 0)

    def decode(self, number: int, piece: Piece) -> None:
        work = self._works[number] = self._client.submit(_decoded, number, piece, self._reading, pure=False)
        self._wait(number, self._client.submit(itemgetter(1), work, pure=False, priority=1))

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        order = self._works[number], self._sink, before, apart, shape, last
        self._wait(number, self._client.submit(_written, *order, pure=False, priority=2))

    def _wait(self, number: int, future: Any) -> None:
        self._numbers[future.key] = number
        self._waiting.add(future)

    def next(self) -> Event:
        import distributed

        future = next(self._waiting)
        number = self._numbers.pop(future.key)
        try:
            told = future.result()
        except distributed.KilledWorker as error:
            raise EnvironmentLackError(f"--scheduler: the workers of part {number} ended: {error}") from error
        future.release()
        if not isinstance(told, Ends):
            self._works.pop(number).release()
        return number, told

    def close(self) -> None:
        self._works.clear()
        self._client.close()


def _decoded(number: int, piece: Piece, reading: Reading) -> tuple[Work, Ends | Exception]:
    work = Work(number, piece, reading)
    return work, work.decode()


def _written(decoded: tuple[Work, Ends], *order: Any) -> Written | Exception:
    return decoded[0].write(*order)
