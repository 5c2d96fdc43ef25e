"""Many logs at a time: one process for each core, or the workers of a Dask cluster. The order of the logs is kept."""

from __future__ import annotations

import multiprocessing
import queue
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce_tools.decode.part import End, Item, Progress, Reading, part_items

_WAITING_TABLES = 8  # of each log, so that memory stays bounded
_POLL_S = 0.5
CONNECT_S = 10
"""How long a scheduler may take to answer."""


def parts_of_processes(
    names: Sequence[str], reading: Reading, jobs: int, progress: Progress | None = None
) -> Iterator[Iterator[Item]]:
    """The parts of a recording, ``jobs`` of them decoded at a time, each in a process of its own.

    Raises what the decoding raised, at the log where it did.
    """
    context = multiprocessing.get_context()
    running: list[tuple[Any, Any]] = []
    todo = list(names)
    done = [0]
    try:
        for name in names:
            while todo and len(running) < jobs:
                running.append(_started(context, todo.pop(0), reading))
            process, items = running[0]
            yield _received(name, process, items, progress, done)
            process.join()
            running.pop(0)
    finally:
        for process, _ in running:
            process.kill()
            process.join()


def _started(context: Any, name: str, reading: Reading) -> tuple[Any, Any]:
    items = context.Queue(_WAITING_TABLES)
    process = context.Process(target=_work, args=(name, reading, items), daemon=True)
    process.start()
    return process, items


def _work(name: str, reading: Reading, items: Any) -> None:
    with suppress(KeyboardInterrupt):
        position = [0]

        def note(here: int) -> None:
            position[0] = here

        try:
            for item in part_items(name, reading, note):
                items.put((item, position[0]))
        except (TipforceError, OSError) as error:
            items.put((error, 0))


def _received(name: str, process: Any, items: Any, progress: Progress | None, done: list[int]) -> Iterator[Item]:
    position = 0
    while True:
        try:
            item, position = items.get(timeout=_POLL_S)
        except queue.Empty:
            if process.is_alive() or not items.empty():
                continue
            raise EnvironmentLackError(
                f"{name}: the process that decoded it ended with {process.exitcode}: too little memory? Try --jobs 1"
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
    """The parts of a recording, decoded as a Dask bag by the workers of ``scheduler``, which must see the same files.

    Raises EnvironmentLackError without Dask or where no scheduler answers, and what the decoding raised.
    """
    try:
        import dask.bag
        import distributed
    except ImportError:
        raise EnvironmentLackError("--scheduler needs Dask: `pip install 'tipforce[dask]'`") from None
    try:
        client: Any = distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise EnvironmentLackError(f"--scheduler {scheduler}: no scheduler answers there: {error}") from error
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
    """All of a part, or what was wrong with it."""
    try:
        return list(part_items(name, reading))
    except TipforceError as error:
        return error
