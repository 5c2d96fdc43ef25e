"""One run of `tipforce decode`: from logs through the requested steps to the output and the report. The rows pass
through this process, or workers decode and write the parts of the logs themselves."""

from __future__ import annotations

import os
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.core import core, how_to_build
from tipforce.errors import InputError, WriteError
from tipforce.host.dataset.reader import tables_of_logs
from tipforce.host.dataset.store import is_dataset, is_url
from tipforce.host.decoding.log_part import Piece, Reading, StrictError
from tipforce.host.decoding.recording import Recording, Tap
from tipforce.host.decoding.sample_table import Table
from tipforce.host.frames.frame_array import MAX_CHANNELS
from tipforce.host.logs.lines import is_plain, line_borders
from tipforce.host.logs.reader import log_kind
from tipforce.output_file import NewFile
from tipforce.samples import reasons
from tipforce_tools.cli import common, log_choice
from tipforce_tools.cli.listening import StopSignals, counted
from tipforce_tools.cli.main import INTERRUPTED
from tipforce_tools.decode import summary as summaries
from tipforce_tools.decode.resample import steps_of
from tipforce_tools.writing.text_rows import COUNTER, NODE, TIME
from tipforce_tools.writing.writers import KINDS, JoinedFile, Shape, StreamWriter, check_format, format_of, is_directory

if TYPE_CHECKING:
    from tipforce_tools.decode.workers import Sink, Workers

_FIRST_ROWS = 100_000  # inspected before the first is written, so that rare columns are known
_SMALL_BYTES = 1_000_000_000  # of all logs: to it one process needs less processor time and memory, and seconds
_LEAST_PIECE_BYTES = 8_000_000  # minimum size of a piece
_PIECE_BYTES = 32_000_000  # of a large log: several results fit in memory
_FOLLOW_S = 2.0  # between looks at a growing log
_FOLLOWED_BYTES = 16_000_000  # of a part that is written again while its log grows
_DATASET_PIECE_BYTES = 64_000_000  # a file per node of some megabytes
_MANY_FRAMES = 100_000  # from there on a missing core costs a second
_JOINED = ("csv", "jsonl", "parquet")
"""Formats whose parts can be written apart."""
_FEWEST_JOBS = {"parquet": 3}  # of processes: one that reads, decodes and encodes in threads keeps two cores busy


def decode(args: Namespace) -> int:
    """Decode logs; return 0, or 1 for a bad line with --strict, and where frames of too many interfaces are left out.
    Raises InputError for unusable input, EnvironmentLackError for a missing package, OSError for a full disk."""
    _check(args)
    run = _Run(args)
    code, complete = 0, False
    try:
        with run.stop or nullcontext(), _progress(args, run.names) as advance:
            run.write(advance)
        complete = True
    except StrictError as error:
        print(f"tipforce decode: {error}", file=sys.stderr)
        code = 1
    finally:
        run.report(complete, at_bad_line=code == 1)
    if args.json and (_to_file(args) or args.summary):
        common.print_json(summaries.record(run.summary, run.recording, args.output))
    elif args.summary:
        for line in (*summaries.lines(run.summary, run.recording), *summaries.event_lines(run.recording)):
            print(line)
    dropped = summaries.bad_lines(run.recording).get("interface", 0)
    if dropped:
        print(
            f"tipforce decode: {counted(dropped, 'frame')} left out: a log may have {MAX_CHANNELS} interfaces; decode "
            "the others apart, as with `grep ' can300 ' run.log | tipforce decode -`",
            file=sys.stderr,
        )
    return 1 if dropped else INTERRUPTED if run.stop is not None and run.stop() else code


def _to_file(args: Namespace) -> bool:
    return args.output not in {None, "-"}


def _alone(args: Namespace) -> bool:
    """Whether the summary is all that is shown."""
    return bool(args.summary) and args.output is None


def _to_dataset(args: Namespace) -> bool:
    return args.output is not None and is_directory(args.output)


class _Run:
    def __init__(self, args: Namespace) -> None:
        self._args = args
        self.names = log_choice.logs(args.logs)
        if args.follow and not _to_dataset(args):
            if len(self.names) > 1:
                raise InputError(f"--follow: allowed is one log; {len(self.names)} logs grow in a dataset, -o DIR/")
            path = Path(self.names[0])
            if path.is_file() and not (log_kind(path) == "text" and is_plain(path)):
                raise InputError(f"--follow: {path}: allowed is candump text that is not packed")
        json_on_stdout = args.json and not _to_file(args) and args.format is None
        self._kind = "jsonl" if json_on_stdout else format_of(args.output, args.format)
        layouts, signals, self._contact, self._resampled = steps_of(args)
        self._reading = replace(
            log_choice.reading(args, self.names, layouts, signals),
            reasons=bool(args.summary or args.verbose or args.json), rows=not _alone(args),
        )  # fmt: skip
        # Ctrl-C ends the input of what has no end of its own, and its output is complete; a dataset is, every 2 s.
        self.stop = StopSignals() if ("-" in self.names or args.follow) and not _to_dataset(args) else None
        if self.stop is not None:
            self._reading = replace(self._reading, stop=self.stop)
        self.recording = Recording(self._reading)
        self.summary = summaries.Summary(self._reading.reasons)

    def write(self, advance: Callable[[float], None]) -> None:
        """Decode and write; ``advance`` takes the bytes of the logs that are done since the last call. Raises
        InputError, WriteError, OSError for stdout."""
        args = self._args
        if _to_dataset(args):
            self._write_dataset(advance)
        elif pieces := pieces_of(args, self._kind, self.names):
            self._write_parts(pieces, advance)
        elif _alone(args):
            for _ in self._tables(advance):
                pass
            _check_readable(args, self.recording)
        else:
            self._write_all(advance)

    def _tables(self, advance: Callable[[float], None], tap: Tap | None = None) -> Iterable[Table]:
        tables = tables_of_logs(self.recording, self.names, advance, tap)
        return self._resampled(self.summary.passing(self._contact(tables)))

    def _write_all(self, advance: Callable[[float], None]) -> None:
        args, kind = self._args, self._kind
        check_format(args.output, kind)
        base = (TIME, NODE, *(() if args.resample is not None else (COUNTER,)))
        looked_ahead = _looked_ahead if _to_file(args) and not args.follow else iter
        with self._output([name for name in self.names if name != "-"]) as file:
            if file is not None and kind in {"parquet", "csv"}:
                with JoinedFile(file, kind, shape := Shape(base)) as joined:
                    joined.add(joined.write(0, looked_ahead(self._tables(advance)), shape), shape)
                return
            with nullcontext(sys.stdout.buffer) if file is None else file.partial.open("wb") as stream:
                if kind == "mcap":
                    from tipforce_robots.mcap_file import McapWriter

                    mcap = McapWriter(stream)
                    for table in looked_ahead(self._tables(advance, mcap.frames)):
                        mcap.write(table)
                    mcap.close(self.recording.bus.found)
                    return
                writer = StreamWriter(stream, kind, base)
                for table in looked_ahead(self._tables(advance)):
                    writer.write(table)
        if writer.left_out:
            left_out = ", ".join(sorted(writer.left_out))
            common.note(f"not in the CSV, because they appeared after its header: {left_out}")

    def _write_parts(self, pieces: list[Piece], advance: Callable[[float], None]) -> None:
        from tipforce_tools.decode.workers import InOrder

        shape = Shape((TIME, NODE, COUNTER))
        with self._output([piece.name for piece in pieces]) as file:
            assert file is not None
            with JoinedFile(file, self._kind, shape) as output:
                workers = _workers(self._args, self._reading, output, len(pieces))
                for piece, written, *_ in InOrder(pieces, self.recording, shape, workers):
                    self.summary.append(written.summary)
                    output.add(written.record, written.shape)
                    advance(_size(piece))

    @contextmanager
    def _output(self, inputs: Sequence[str]) -> Iterator[NewFile | None]:
        """Give the file to write, None for stdout; after the block it is complete, with the events beside it. Where
        something fails, it is gone. Raises InputError; ``inputs`` are refused."""
        output = self._args.output
        file = NewFile(output, KINDS[self._kind], inputs) if _to_file(self._args) else None
        try:
            yield file
            _check_readable(self._args, self.recording)
            if file is not None:
                file.keep()
                summaries.write_events(output, self.recording.bus.found)
        except OSError as error:
            if file is None:
                raise
            file.drop()
            raise WriteError(f"{output}: {error.strerror or error}; an old file is unchanged") from error
        except BaseException:
            if file is not None:
                file.drop()
            raise

    def _write_dataset(self, advance: Callable[[float], None]) -> None:
        from tipforce_tools.decode.dataset_run import DatasetRun

        args = self._args
        reading = replace(self._reading, follow=False)  # a growing log is read again and again
        names = self.names if args.scheduler is None else [os.path.abspath(name) for name in self.names]
        cut, workers = partial(_pieces_from, args), partial(_workers, args, reading)
        run = DatasetRun(args.output, reading, self.recording, args.hand, cut, workers)
        try:
            while True:
                with closing(run.add(names)) as parts:
                    for piece, written, *_ in parts:
                        self.summary.append(written.summary)
                        advance(_size(piece))
                        _check_readable(args, self.recording)
                if not args.follow:
                    break
                time.sleep(_FOLLOW_S)
                names = log_choice.logs(args.logs)  # `tipforce log --rotate-size` has begun another file
        except OSError as error:
            raise WriteError(f"{args.output}: {error.strerror or error}; what was committed before stays") from error
        if not run.added:
            common.note(f"{args.output}: nothing new in {counted(len(names), 'log')}")

    def report(self, complete: bool, at_bad_line: bool) -> None:
        """Report on stderr what is noteworthy; ``complete``: the output is; ``at_bad_line``: it ends there."""
        args, recording, summary = self._args, self.recording, self.summary
        for line in summaries.notes_lines(recording):
            common.note(line)
        if core is None and sum(notes.frames for notes in recording.notes) > _MANY_FRAMES:
            common.note(f"slow, without the compiled core: {how_to_build()}")
        if recording.unseen and not args.calibration and (args.verbose or args.summary):
            common.note(reasons.not_seen(node for _, node in recording.unseen))
        if complete and not summary.samples and recording.notes:
            frames = sum(notes.frames for notes in recording.notes)
            flags = log_choice.narrowing_flags(args)
            chosen = f"; {flags} may exclude it" if flags and frames else ""
            common.note(f"no sample of a fingertip in {counted(frames, 'frame')}{chosen}")
        if args.summary and not args.json:
            return
        for line in summaries.event_lines(recording):
            common.note(line)
        lost_lines = summaries.lost_lines(recording) if complete or at_bad_line else ()
        for line in summaries.lines(summary, recording) if args.verbose else lost_lines:
            common.note(line)
        if complete and _to_file(args) and not args.json and (recording.notes or not _to_dataset(args)):
            lost = sum(recording.tally.lost().values())
            samples, nodes = counted(summary.samples.total(), "sample"), counted(len(summary.samples), "node")
            common.note(f"{args.output}: {samples} of {nodes}, {lost} lost")
            if (events := recording.bus.found) and not _to_dataset(args):
                common.note(f"{summaries.events_path(args.output)}: {counted(len(events), 'event')}")


@contextmanager
def _progress(args: Namespace, names: Sequence[str]) -> Iterator[Callable[[float], None]]:
    total = sum(Path(name).stat().st_size for name in names if Path(name).is_file())
    rows_on_screen = sys.stdout.isatty() and args.output is None and not args.summary
    if not sys.stderr.isatty() or args.quiet or args.follow or not total or rows_on_screen:
        yield lambda _bytes: None
        return
    with common.progress("bytes", total) as advance:
        yield advance


def _looked_ahead(tables: Iterable[Table]) -> Iterator[Table]:
    """Return the same tables, the first rows with the union of their columns."""
    first: list[Table] = []
    iterator = iter(tables)
    for table in iterator:
        first.append(table)
        if sum(map(len, first)) >= _FIRST_ROWS:
            break
    columns = {column.name: column for table in first for column in table.columns}
    channels = first[-1].channels if first else ()
    if first and (len(columns) > len(first[0].columns) or len(first[0].channels) < len(channels)):
        first[0] = first[0].with_columns(columns.values(), channels)
    yield from first
    first.clear()
    yield from iterator


def pieces_of(args: Namespace, kind: str, names: Sequence[str]) -> list[Piece]:
    """Return the logs in pieces that workers decode and write; none for rows that pass through this process. Large logs
    are cut: equally many pieces per job, of bounded size."""
    here = not _to_file(args) or args.follow or kind not in _JOINED or args.resample is not None or args.calibration
    # SDO traffic is followed in sequence; stdin and pipes are read once, and a dataset's rows only read.
    if here or args.eds or not all(map(os.path.isfile, names)):
        return []
    jobs, sizes = _jobs(args), list(map(os.path.getsize, names))
    if args.scheduler is not None:
        names = [os.path.abspath(name) for name in names]
    elif jobs < _FEWEST_JOBS.get(kind, 2) or (args.jobs is None and sum(sizes) < _SMALL_BYTES):
        return []
    pieces: list[Piece] = []
    for name, size in zip(names, sizes, strict=True):
        count = min(size // _LEAST_PIECE_BYTES, jobs * -(-size // (jobs * _PIECE_BYTES)))
        whole = (
            count < 2 or jobs < 2 or (args.strict and (args.summary or args.json))
        )  # the bad line ends what is recording
        pieces += [Piece(name)] if whole else _cut(args, name, 0, count)
    return pieces if len(pieces) > 1 or args.scheduler is not None else []


def _workers(args: Namespace, reading: Reading, sink: Sink, parts: int) -> Workers:
    from tipforce_tools.decode.workers import Cluster, Here, Processes

    if args.scheduler is not None:
        return Cluster(args.scheduler, reading, sink)
    jobs = min(_jobs(args), parts)
    return Here(reading, sink) if jobs < 2 or args.follow or args.eds else Processes(jobs, reading, sink)


def _pieces_from(args: Namespace, name: str, start: int) -> list[Piece]:
    """Return a log from a byte on in pieces that are parts of a dataset."""
    size = os.path.getsize(name) - start
    count = max(-(-size // (_FOLLOWED_BYTES if args.follow else _DATASET_PIECE_BYTES)), 1)
    jobs = max(min(_jobs(args), size // _LEAST_PIECE_BYTES), 1)
    return _cut(args, name, start, -(-count // jobs) * jobs)  # equally many for each worker


def _cut(args: Namespace, name: str, start: int, count: int) -> list[Piece]:
    """Return plain text from a byte on in pieces; whole what cannot be cut: its lines need those in front."""
    path = Path(name)
    if args.deltas or args.eds or log_kind(path) != "text" or not is_plain(path):
        return [Piece(name)]
    return [Piece(name, begin, end) for begin, end in pairwise(line_borders(path, count, start))]


def _size(piece: Piece) -> int:
    return (Path(piece.name).stat().st_size if piece.end is None else piece.end) - piece.start


def _jobs(args: Namespace) -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return args.jobs or cores


def _check_readable(args: Namespace, recording: Recording) -> None:
    """Raises LogError for an input without a frame, and for one without a sample if no flag leaves samples out. A log
    that is followed may have them later."""
    from tipforce.host.logs.notes import no_frame, no_sample

    names, frames = ", ".join(notes.source for notes in recording.notes), sum(notes.frames for notes in recording.notes)
    begun = _to_dataset(args) and not summaries.bad_lines(recording)  # a log of a dataset may begin empty, and grow
    if recording.notes and not frames and not args.follow and not begun:
        raise no_frame(names)
    narrowed = args.signals or args.calibration or args.follow or log_choice.narrowing_flags(args)
    if frames and not (recording.tally.messages or recording.tally.short or recording.bus.found or narrowed):
        raise no_sample(names, frames, sum(notes.extended for notes in recording.notes))


def _check(args: Namespace) -> None:
    kind, to_dataset = format_of(args.output, args.format), _to_dataset(args)
    rows_pass_here = not _to_file(args) or args.calibration or args.resample is not None
    not_of_mcap = {"--dbc": args.dbc, "--eds": args.eds, "--signals": args.signals, "--scheduler": args.scheduler}
    given = next((flag for flag, value in not_of_mcap.items() if value), "")
    source = next(filter(is_dataset, args.logs), "") if to_dataset else ""
    refused = {
        f"{given}: MCAP has whole contacts and all frames; for {given} write .csv or .parquet":
            kind == "mcap" and given,
        "--follow: allowed is one log, or one pattern and -o DIR/": args.follow and len(args.logs) > 1,
        "--follow: a growing log is decoded locally; leave out --scheduler": args.follow and args.scheduler,
        "a log behind a URL is copied first: leave out --follow and --scheduler, or name a file":
            (args.follow or args.scheduler) and any(map(is_url, args.logs)),
        f"--format {args.format}: a dataset has Parquet files; name a file with --output":
            to_dataset and args.format not in {None, "parquet"},
        f"--output {args.output}: a dataset has what the nodes sent, of log files: leave out --calibration, --resample "
        "and stdin; apply a calibration when reading it":
            to_dataset and (args.calibration or args.resample is not None or "-" in args.logs or not args.logs),
        f"{source}: is a dataset, and {args.output} is filled from logs; name the logs": source,
        "--hand: is a partition of a dataset; name one with --output DIR/": args.hand is not None and not to_dataset,
        "--scheduler: its workers write .csv, .jsonl, .parquet or DIR/: name one with --output, and leave out "
        "--calibration and --resample": args.scheduler and (rows_pass_here or kind not in _JOINED),
        "--scheduler: --eds follows the SDO traffic of the logs in sequence; leave one out":
            args.scheduler and args.eds,
        "--scheduler: name log files that its workers can read": args.scheduler and not {*args.logs} - {"-"},
    }  # fmt: skip
    for why, is_refused in refused.items():
        if is_refused:
            raise InputError(why)
