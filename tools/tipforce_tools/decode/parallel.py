"""Decode many logs, or pieces of a large one, in parallel: one process per core, or workers of a Dask cluster.

The output keeps the order of the logs.
"""

from __future__ import annotations

import multiprocessing
import queue
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce.host.decoding.log_part import End, Item, Piece, Progress, Reading, part_items

_WAITING_TABLES = 16  # of each log, so that memory stays bounded
_POLL_S = 0.5
CONNECT_S = 10
"""Timeout of the scheduler's response."""


def parts_of_processes(
    pieces: Sequence[Piece], reading: Reading, jobs: int, progress: Progress | None = None
) -> Iterator[Iterator[Item]]:
    """Decode the parts of a recording in ``jobs`` processes in turn. They start now, not at the first part.

    With fork, all processes are forked at once, before a library of an output starts threads.
    Raises the errors of the decoding, at the log concerned.
    """
    context: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
    workers = [
        _started(context, pieces[number::jobs], reading, number == 0) for number in range(min(jobs, len(pieces)))
    ]
    return _parts_in_turn(pieces, workers, progress)


def _parts_in_turn(
    pieces: Sequence[Piece], workers: list[tuple[Any, Any]], progress: Progress | None
) -> Iterator[Iterator[Item]]:
    done = [0]
    try:
        for number, piece in enumerate(pieces):
            process, items = workers[number % len(workers)]
            yield _received(piece, process, items, progress, done)
    finally:
        for process, _ in workers:
            process.kill()
            process.join()


def _started(context: Any, pieces: Sequence[Piece], reading: Reading, first: bool) -> tuple[Any, Any]:
    items = context.Queue(_WAITING_TABLES)
    process = context.Process(target=_work, args=(pieces, reading, items, first), daemon=True)
    process.start()
    return process, items


def _work(pieces: Sequence[Piece], reading: Reading, items: Any, first: bool) -> None:
    with suppress(KeyboardInterrupt):
        position = [0]

        def note(here: int) -> None:
            position[0] = here

        try:
            for number, piece in enumerate(pieces):
                for item in part_items(piece, reading, note, first=first and number == 0):
                    items.put((item, position[0] - piece.start))
        except (TipforceError, OSError) as error:
            items.put((error, 0))


def _received(piece: Piece, process: Any, items: Any, progress: Progress | None, done: list[int]) -> Iterator[Item]:
    position = 0
    while True:
        try:
            item, position = items.get(timeout=_POLL_S)
        except queue.Empty:
            if process.is_alive() or not items.empty():
                continue
            raise EnvironmentLackError(
                f"{piece.name}: the decoding process ended with {process.exitcode}: too little memory? Try --jobs 1"
            ) from None
        if isinstance(item, Exception):
            raise item
        if progress is not None:
            progress(done[0] + position)
        yield item
        if isinstance(item, End):
            done[0] += position
            return


def parts_of_dask(names: Sequence[str], reading: Reading, scheduler: str) -> Iterator[list[Item]]:
    """Decode the parts of a recording as a Dask bag on the workers of ``scheduler``, which must see the same files.

    Raises EnvironmentLackError without Dask or without a response of the scheduler, and the errors of the decoding.
    """
    try:
        import dask.bag
        import distributed
    except ImportError:
        raise EnvironmentLackError("--scheduler needs Dask: `pip install 'tipforce[dask]'`") from None
    try:
        client: Any = distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise EnvironmentLackError(f"--scheduler {scheduler}: no response: {error}") from error
    with client:
        bag: Any = dask.bag.from_sequence(list(names), npartitions=len(names))
        bag = bag.map(_whole_part, reading)
        futures = client.compute(bag.to_delayed())
        for future in futures:
            (found,) = future.result()
            if isinstance(found, TipforceError):
                raise found
            yield found
            future.release()


def _whole_part(name: str, reading: Reading) -> list[Item] | TipforceError:
    """Return all of a part, or its error."""
    try:
        return list(part_items(Piece(name), reading))
    except TipforceError as error:
        return error
