"""Output of `tipforce decode` whose parts workers write: a file that is joined from them, or a dataset."""

from __future__ import annotations

import os
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

from tipforce.errors import WriteError
from tipforce.host.dataset.store import is_dataset
from tipforce.host.decoding.log_part import Piece, Reading
from tipforce.host.decoding.recording import Recording, Told
from tipforce.host.logs.lines import is_plain, line_borders
from tipforce.host.logs.reader import log_kind
from tipforce_tools.cli import common
from tipforce_tools.cli.listening import counted
from tipforce_tools.decode import choice
from tipforce_tools.decode import summary as summaries
from tipforce_tools.decode.events import write_events
from tipforce_tools.decode.progress import ProgressBar
from tipforce_tools.decode.text_rows import COUNTER, NODE, TIME
from tipforce_tools.decode.writers import Shape

if TYPE_CHECKING:
    from tipforce_tools.decode.part_files import PartFile, Pieces
    from tipforce_tools.decode.parts import Sink, Workers, Written

_SMALL_BYTES = 1_000_000_000  # of all logs: to it one process needs less processor time and memory, and seconds
_LEAST_PIECE_BYTES = 8_000_000  # minimum size of a piece
_PIECE_BYTES = 16_000_000  # of a large log: several results fit in memory
_FOLLOW_S = 2.0  # between looks at a growing log
_FOLLOWED_BYTES = 16_000_000  # of a part that is written again while its log grows
_DATASET_PIECE_BYTES = 64_000_000  # a file per node of some megabytes
FilePart: TypeAlias = "tuple[int, Pieces, Shape]"
"""Number of a part, the record of its writing, and its columns after those of the parts in front."""
JOINED = ("csv", "jsonl", "parquet")
"""Formats whose parts can be written apart."""


def in_parts(args: Namespace, kind: str, names: Sequence[str]) -> list[Piece]:
    """Return the parts that workers decode and write themselves; none for rows that pass through this process."""
    live = args.output in {None, "-"} or args.follow or "-" in names
    if live or kind not in JOINED or args.resample is not None or args.calibration:
        return []
    if args.eds or any(map(is_dataset, names)):  # SDO traffic is followed in sequence; a dataset's rows are only read
        return []
    jobs = args.jobs or _cores()
    if args.scheduler is None and (jobs < 2 or (args.jobs is None and sum(map(os.path.getsize, names)) < _SMALL_BYTES)):
        return []
    if args.scheduler is not None:
        names = [os.path.abspath(name) for name in names]
    pieces = pieces_of(args, names, jobs)
    return pieces if len(pieces) > 1 or args.scheduler is not None else []


def write_parts(
    args: Namespace, kind: str, pieces: list[Piece], reading: Reading, recording: Recording,
    summary: summaries.Summary, bar: ProgressBar,
) -> None:  # fmt: skip
    """Write all parts by workers. Raises as ``write_file`` does."""
    from tipforce_tools.decode.parts import InOrder

    def parts(sink: PartFile, shape: Shape) -> Iterator[FilePart]:
        workers = _workers(args, reading, sink, len(pieces))
        for written in InOrder(pieces, recording, shape, workers):
            summary.append(written.summary)
            yield written.number, written.record, written.shape
            bar.add(written.piece)

    write_file(args, kind, (TIME, NODE, COUNTER), [piece.name for piece in pieces], recording.told, parts)


def write_file(
    args: Namespace, kind: str, base: tuple[str, ...], inputs: Sequence[str], told: Told,
    parts: Callable[[PartFile, Shape], Iterable[FilePart]],
) -> None:  # fmt: skip
    """Write one file from ``parts`` that are written to its sink; ``base``: the columns that every table has.

    Raises InputError for a path that cannot be written, WriteError.
    """
    from tipforce_tools.decode.part_files import JoinedFile

    shape = Shape(base)
    output = JoinedFile(Path(args.output), kind, shape, inputs)
    with aborted(args, output):
        for part in parts(output.sink, shape):
            output.add(*part)
        check_readable(args, told)
        output.close()
        write_events(args.output, told.events())


class _Output(Protocol):
    def abort(self) -> None: ...


@contextmanager
def aborted(args: Namespace, output: _Output) -> Iterator[None]:
    """Abort an output where the block fails. Raises WriteError for an OSError of a file."""
    try:
        yield
    except OSError as error:
        output.abort()
        if args.output in {None, "-"}:
            raise
        raise WriteError(f"{args.output}: {error.strerror or error}; an old file is unchanged") from error
    except BaseException:
        output.abort()
        raise


def _workers(args: Namespace, reading: Reading, sink: Sink, parts: int) -> Workers:
    if args.scheduler is not None:
        from tipforce_tools.decode.processes import Cluster

        return Cluster(args.scheduler, reading, sink)
    from tipforce_tools.decode.processes import Processes

    return Processes(min(args.jobs or _cores(), parts), reading, sink)


def write_dataset(
    args: Namespace, names: list[str], reading: Reading, told: Told, summary: summaries.Summary, bar: ProgressBar
) -> None:
    """Add the logs to a dataset; ``told`` gets what they tell besides rows. Raises InputError, WriteError."""
    from tipforce_tools.decode.dataset_run import DatasetRun
    from tipforce_tools.decode.parts import Here

    def cut(name: str, start: int) -> list[Piece]:
        return pieces_from(args, name, start)

    def workers(sink: Sink, parts: int) -> Workers:
        here = args.scheduler is None and (min(args.jobs or _cores(), parts) < 2 or args.follow or args.eds)
        return Here(reading, sink) if here else _workers(args, reading, sink, parts)

    def each(written: Written) -> None:
        summary.append(written.summary)
        bar.add(written.piece)

    if args.scheduler is not None:
        names = [os.path.abspath(name) for name in names]
    reading = replace(reading, follow=False)  # a growing log is read again and again

    check = partial(check_readable, args)
    run = DatasetRun(args.output, reading, told, args.hand)
    try:
        while True:
            run.add(names, cut, workers, each, check)
            if not args.follow:
                break
            time.sleep(_FOLLOW_S)
    except OSError as error:
        raise WriteError(f"{args.output}: {error.strerror or error}; what was committed before stays") from error
    if not run.added:
        common.note(args, f"{args.output}: nothing new in {counted(len(names), 'log')}")


def pieces_from(args: Namespace, name: str, start: int) -> list[Piece]:
    """Return a log from a byte on in pieces that are parts of a dataset; whole if it cannot be cut."""
    size = os.path.getsize(name)
    path = Path(name)
    if args.deltas or args.eds or log_kind(path) != "text" or not is_plain(path):
        return [Piece(name)]
    count = max(-(-(size - start) // (_FOLLOWED_BYTES if args.follow else _DATASET_PIECE_BYTES)), 1)
    jobs = args.jobs or _cores()
    count = max(count, min(jobs, (size - start) // _LEAST_PIECE_BYTES))
    borders = line_borders(path, count, start)
    return [Piece(name, begin, end) for begin, end in pairwise(borders)]


def pieces_of(args: Namespace, names: Sequence[str], jobs: int) -> list[Piece]:
    """Return the logs, large plain-text ones in pieces: equally many per job, of bounded size.

    Only if each line has an absolute time. With --strict, output to stdout ends at the bad line: one piece.
    """
    shown = args.output in {None, "-"} or args.summary or args.json
    found: list[Piece] = []
    for name in names:
        whole = name == "-" or jobs < 2 or args.deltas or (args.strict and shown)
        size = 0 if whole else os.path.getsize(name)
        count = max(size // _LEAST_PIECE_BYTES, 1)
        if count > 1:
            count = min(count, jobs * -(-size // (jobs * _PIECE_BYTES)))
        if count == 1 or log_kind(Path(name)) != "text" or not is_plain(Path(name)):
            found.append(Piece(name))
            continue
        borders = line_borders(Path(name), count)
        ends: list[int | None] = [*borders[1:-1], None]
        found += [Piece(name, start, end) for start, end in zip(borders[:-1], ends, strict=True)]
    return found


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_readable(args: Namespace, told: Told) -> None:
    """Raises LogError for an input without a frame, and for one without a sample if no flag leaves samples out.

    A log that is followed may have them later.
    """
    from tipforce_tools.cli.empty_log import MESSAGES, PACKED, PCAP, TEXT, no_frame, no_sample

    names = ", ".join(notes.source for notes in told.notes)
    frames = sum(notes.frames for notes in told.notes)
    if summaries.bad_lines(told) and not frames and not args.follow:
        raise no_frame(names, (TEXT, PACKED, MESSAGES, PCAP))
    narrowed = args.signals or args.calibration or args.follow or choice.narrowing_flags(args)
    if frames and not told.tally.messages and not told.tally.short and not told.events() and not narrowed:
        raise no_sample(names, frames, sum(notes.extended for notes in told.notes))
