"""Workers for the parts of a recording as processes of this machine."""

from __future__ import annotations

import multiprocessing
import sys
from contextlib import suppress
from multiprocessing import connection
from typing import Any

import numpy as np

from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce.host.decoding.decoded_part import Ends
from tipforce.host.decoding.log_part import Piece, Reading
from tipforce.host.decoding.recording import State
from tipforce_tools.decode.parts import Event, Sink, Work, Written
from tipforce_tools.decode.writers import Shape

_KEPT_BYTES = 31 << 20  # glibc keeps twice as much
_TRIES = 3
"""Of a part whose worker dies."""


class Processes:
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
        """How many parts can be begun now."""
        return len(self._idle)

    def decode(self, number: int, piece: Piece) -> None:
        """Begin to decode a part."""
        self._busy[number] = self._idle.pop()
        self._order(number, ("decode", number, piece))

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        """See ``Workers``."""
        self._order(number, ("write", before, apart, shape, last))

    def _order(self, number: int, order: tuple[Any, ...]) -> None:
        self._orders.setdefault(number, []).append(order)
        with suppress(BrokenPipeError, ConnectionResetError):  # next() sees that the process has died
            self._busy[number][1].send(order)

    def next(self) -> Event:
        """Wait for the next event. Raises EnvironmentLackError for a part whose workers die again and again."""
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
            return Event(number, told)

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
        """End the processes."""
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
            order: tuple[Any, ...] = pipe.recv()
            try:
                if order[0] == "decode":
                    work = Work(order[1], order[2], reading)
                    pipe.send(work.decode())
                elif work is not None:
                    done = work.write(sink, *order[1:])
                    work = None
                    pipe.send(done)
            except (TipforceError, OSError) as error:
                pipe.send(error)


CONNECT_S = 10
"""Timeout of the scheduler's response."""
_PER_THREAD = 2
"""Parts in work for each thread of the cluster: one is decoded while another one waits for the parts in front."""


class Cluster:
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
        """How many parts can be begun now."""
        threads: int = sum(self._client.nthreads().values())
        return max(_PER_THREAD * max(threads, 1) - len(self._works), 0)

    def decode(self, number: int, piece: Piece) -> None:
        """Begin to decode a part."""
        work = self._works[number] = self._client.submit(_decoded, number, piece, self._reading, pure=False)
        self._wait(number, self._client.submit(_ends, work, pure=False, priority=1))

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        """See ``Workers``."""
        order = self._works[number], before, apart, shape, last, self._sink
        self._wait(number, self._client.submit(_write, *order, pure=False, priority=2))

    def _wait(self, number: int, future: Any) -> None:
        self._numbers[future.key] = number
        self._waiting.add(future)

    def next(self) -> Event:
        """Wait for the next event. Raises EnvironmentLackError for a part whose workers end again and again."""
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
        return Event(number, told)

    def close(self) -> None:
        """End all work."""
        self._works.clear()
        self._client.close()


def _decoded(number: int, piece: Piece, reading: Reading) -> tuple[Work, Ends | Exception]:
    work = Work(number, piece, reading)
    try:
        return work, work.decode()
    except (TipforceError, OSError) as error:
        return work, error


def _ends(decoded: tuple[Work, Ends | Exception]) -> Ends | Exception:
    return decoded[1]


def _write(
    decoded: tuple[Work, Ends], before: State, apart: bool, shape: Shape, last: bool, sink: Sink
) -> Written | Exception:
    try:
        return decoded[0].write(sink, before, apart, shape, last)
    except (TipforceError, OSError) as error:
        return error
