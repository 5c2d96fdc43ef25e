"""Decode the parts of a recording with any number of workers. A worker decodes a part and keeps its rows. With the
``State`` behind the part in front it returns the one behind its own, completes its rows and writes them."""

import multiprocessing
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from tipforce.errors import EnvironmentLackError, TipforceError, needing
from tipforce.host.decoding.log_part import Piece, Reading, StrictError
from tipforce.host.decoding.recording import DecodedPart, Passed, Recording, State, decode_after
from tipforce.host.decoding.sample_table import Table
from tipforce.host.decoding.services import BusEvent
from tipforce.host.logs.notes import LogNotes
from tipforce_tools.decode.summary import Summary
from tipforce_tools.writing.writers import Shape

T = TypeVar("T")


class Sink(Protocol):
    """Writes the rows of a part; it can be sent to another process."""

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> Any:
        """Write the rows of part ``number`` with the columns of ``shape``; return a record. Raises OSError."""


@dataclass(slots=True)
class Written:
    """What was written of a part: the sink's record. ``shape``: its columns, and those of the parts in front."""

    record: Any
    shape: Shape
    summary: Summary


class Done(NamedTuple):
    """A part in its order: what was written of it, and what the recording is and tells after it."""

    piece: Piece
    written: Written
    state: State
    notes: LogNotes
    events: list[BusEvent]


Event = tuple[int, Passed | Written | Exception]
"""What a worker says of a part by its number: what it leaves, what was written, or an error."""


class Workers(Protocol):
    """Workers for a sequence of parts."""

    @property
    def free(self) -> int:
        """How many parts can be begun now."""

    def decode(self, number: int, piece: Piece) -> None:
        """Begin to decode a part."""

    def write(self, number: int, before: State, shape: Shape, last: bool) -> None:
        """Complete and write a part after ``before``: two events. ``shape``: the columns of the parts in front."""

    def next(self) -> Event:
        """Wait for the next event. Raises EnvironmentLackError if a part cannot be finished."""

    def close(self) -> None:
        """End all work."""


class Work:
    """What a worker does with one part, in whatever process. An error that a user can cause is returned."""

    def __init__(self, number: int, piece: Piece, reading: Reading) -> None:
        self._number, self._reading = number, reading
        self._part = _attempt(lambda: DecodedPart(piece, reading))

    def follow(self, before: State, last: bool) -> Passed | Exception:
        """Return what the part leaves."""
        part = self._part
        return part if isinstance(part, Exception) else _attempt(lambda: part.follow(before, last=last))

    def write(
        self, sink: Sink, passed: Passed | Exception, before: State, shape: Shape, last: bool
    ) -> Written | Exception:  # fmt: skip
        """Complete and write the rows, see ``Workers``."""
        part = self._part
        if isinstance(passed, Exception):
            return passed
        assert isinstance(part, DecodedPart)
        for columns in passed.columns:
            shape.take(*columns)
        write = partial(_written, self._number, self._reading, sink, shape)
        return _attempt(lambda: write(part.rows(before, last=last)))


def _attempt(act: Callable[[], T]) -> T | Exception:
    try:
        return act()
    except (TipforceError, OSError) as error:
        return error


def _written(number: int, reading: Reading, sink: Sink, shape: Shape, tables: Iterable[Table]) -> Written:
    summary = Summary(reading.reasons)
    return Written(sink.write(number, summary.passing(tables), shape), shape, summary)


class Here(Workers):
    """This process as the only worker: a part is decoded after the ones in front, while it is written."""

    def __init__(self, reading: Reading, sink: Sink) -> None:
        self._reading, self._sink = reading, sink
        self._piece: Piece | None = None
        self._events: list[Event] = []

    @property
    def free(self) -> int:
        return int(self._piece is None and not self._events)

    def decode(self, number: int, piece: Piece) -> None:
        del number
        self._piece = piece

    def write(self, number: int, before: State, shape: Shape, last: bool) -> None:
        assert self._piece is not None
        take = partial(_written, number, self._reading, self._sink, shape)
        passed, written = decode_after(before, self._piece, self._reading, last, take)
        self._events += [(number, passed), (number, written)]
        self._piece = None

    def next(self) -> Event:
        return self._events.pop(0)

    def close(self) -> None:
        pass


class InOrder:
    """The pass over the parts of a recording in order, while workers decode and write them."""

    def __init__(
        self, pieces: Sequence[Piece], recording: Recording, shape: Shape, workers: Workers, ends: bool = True
    ) -> None:
        """``ends``: the recording ends with the last part."""
        self._pieces, self._recording, self._shape = pieces, recording, shape
        self._workers, self._ends = workers, ends
        self._written: dict[int, Written] = {}
        self._left: dict[int, tuple[State, LogNotes, list[BusEvent]]] = {}
        self._begun = self._ordered = self._passed = self._given = 0

    def __iter__(self) -> Iterator[Done]:
        """Yield what was written, in order. Raises the errors of the decoding and the writing in order, too."""
        try:
            while self._given < len(self._pieces):
                while self._begun < len(self._pieces) and self._workers.free:
                    self._workers.decode(self._begun, self._pieces[self._begun])
                    self._begun += 1
                if self._ordered == self._passed < self._begun:
                    last = self._ends and self._passed == len(self._pieces) - 1
                    self._workers.write(self._passed, self._recording.state(), copy(self._shape), last)
                    self._ordered += 1
                self._take(self._workers.next())
                while self._given in self._written and self._given < self._passed:
                    number = self._given
                    self._given += 1
                    yield Done(self._pieces[number], self._written.pop(number), *self._left.pop(number))
        finally:
            self._workers.close()

    def _take(self, event: Event) -> None:
        number, result = event
        if isinstance(result, StrictError) and number == self._passed:
            raise self._recording.numbered(result)
        if isinstance(result, Exception):
            raise result
        if isinstance(result, Written):
            self._written[number] = result
            return
        before = len(self._recording.bus.found)
        self._recording.resume(result)
        for columns in result.columns:
            self._shape.take(*columns)
        self._left[number] = self._recording.state(), result.notes, self._recording.bus.found[before:]
        self._passed = number + 1


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
        self._orders = defaultdict[int, list[tuple[Any, ...]]](list)  # of each part, to be repeated
        self._passed: set[int] = set()  # parts of which it was returned what they leave
        self._tries = Counter[int]()

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

    def write(self, number: int, before: State, shape: Shape, last: bool) -> None:
        self._order(number, ("write", before, shape, last))

    def _order(self, number: int, order: tuple[Any, ...]) -> None:
        self._orders[number].append(order)
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
            elif number in self._passed:
                continue  # repeated: it leaves the same
            self._passed.add(number)
            return number, told

    def _repeat(self, number: int) -> None:
        process, pipe = self._busy.pop(number)
        process.join()
        pipe.close()
        self._tries[number] += 1
        piece: Piece = self._orders[number][0][2]
        if self._tries[number] == _TRIES:
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
    for other in inherited:
        other.close()
    np.empty(_KEPT_BYTES, dtype=np.uint8)  # as in host.logs.lines: the memory of a part is kept for the next one
    work: Work | None = None
    with suppress(KeyboardInterrupt, EOFError, BrokenPipeError):
        while True:
            match pipe.recv():
                case "decode", number, piece:
                    work = Work(number, piece, reading)
                case "write", before, shape, last if work is not None:
                    passed = work.follow(before, last)
                    if isinstance(passed, Passed):
                        pipe.send(passed)
                    done = work.write(sink, passed, before, shape, last)
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
        with needing("--scheduler needs Dask: `pip install 'tipforce[dask]'`"):
            import distributed
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
        self._works[number] = self._client.submit(Work, number, piece, self._reading, pure=False)

    def write(self, number: int, before: State, shape: Shape, last: bool) -> None:
        work = self._works[number]
        passed = self._client.submit(Work.follow, work, before, last, pure=False, priority=1)
        self._wait(number, passed)
        order = work, self._sink, passed, before, shape, last
        self._wait(number, self._client.submit(Work.write, *order, pure=False, priority=2))

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
        if isinstance(told, Written):
            self._works.pop(number).release()
        return number, told

    def close(self) -> None:
        self._works.clear()
        self._client.close()
