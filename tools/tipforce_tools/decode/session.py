"""One run of `tipforce decode`: from logs through the requested steps to the output and the report."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce.host.dataset.reader import tables_of_logs
from tipforce.host.dataset.store import is_dataset, is_url
from tipforce.host.decoding.log_part import StrictError
from tipforce.host.decoding.recording import Recording, Tap, Told
from tipforce.host.decoding.sample_table import Column, Table
from tipforce.host.frames.frame_array import MAX_CHANNELS
from tipforce.samples import reasons
from tipforce_tools.cli import common
from tipforce_tools.cli.listening import counted
from tipforce_tools.decode import choice
from tipforce_tools.decode import summary as summaries
from tipforce_tools.decode.events import events_path, write_events
from tipforce_tools.decode.part_session import (
    JOINED,
    FilePart,
    aborted,
    check_readable,
    in_parts,
    write_dataset,
    write_file,
    write_parts,
)
from tipforce_tools.decode.progress import ProgressBar
from tipforce_tools.decode.text_rows import COUNTER, NODE, TIME
from tipforce_tools.decode.writers import Shape, StreamWriter, check_format, format_of, is_directory

if TYPE_CHECKING:
    from tipforce_robots.mcap_file import McapWriter
    from tipforce_tools.decode.part_files import PartFile


_FIRST_ROWS = 100_000  # inspected before the first is written, so that rare columns are known


def decode(args: Namespace) -> int:
    """Decode logs; return 0, or 1 for a bad line with --strict, and where frames of too many interfaces are left out.

    Raises InputError for unusable input, EnvironmentLackError for a missing package, OSError for a full disk.
    """
    names = choice.logs(args.logs)
    kind = "jsonl" if args.json and args.output in {None, "-"} and args.format is None else None
    kind = kind or format_of(args.output, args.format)
    steps = _Steps(args)
    reading = choice.reading(args, names, steps.layouts, steps.signals)
    recording = Recording(reading)
    summary = summaries.Summary()
    bar = ProgressBar(names, args)
    directory = args.output is not None and is_directory(args.output)
    pieces = [] if directory else in_parts(args, kind, names)
    code, complete = 0, False
    try:
        if directory:
            write_dataset(args, names, reading, recording.told, summary, bar)
        elif pieces:
            write_parts(args, kind, pieces, reading, recording, summary, bar)
        else:
            _write_all(args, kind, names, steps, recording, summary, bar)
        complete = True
    except StrictError as error:
        bar.close()
        print(f"tipforce decode: {error}", file=sys.stderr)
        code = 1
    finally:
        bar.close()
        _report(args, summary, recording.told, complete)
    if args.json and (args.output not in {None, "-"} or args.summary):
        common.print_json(summaries.record(summary, recording.told, args.output))
    elif args.summary:
        for line in (*summaries.lines(summary, recording.told), *summaries.event_lines(recording.told)):
            print(line)
    dropped = summaries.bad_lines(recording.told).get("interface", 0)
    if dropped:
        print(f"tipforce decode: {_left_out(dropped)}", file=sys.stderr)
    return 1 if dropped else code


def _left_out(frames: int) -> str:
    return (
        f"{counted(frames, 'frame')} left out: a log may have {MAX_CHANNELS} interfaces; decode the others apart, as "
        "with `grep ' can300 ' run.log | tipforce decode -`"
    )


class _Steps:
    """The steps on tables between the logs and the output."""

    def __init__(self, args: Namespace) -> None:
        self.layouts = choice.layouts(args)
        names = choice.names_of(args.signals)
        self._contact = None
        computed: dict[str, str] = {}
        if args.calibration:
            from tipforce.host.decoding import contact_columns

            calibrations = contact_columns.read_calibrations(args.calibration)
            if not args.gauges and not args.dcf and not args.ask:
                self.layouts = replace(self.layouts, gauges=contact_columns.gauges_of(calibrations))
            computed = {name: signal for name in names or () if (signal := contact_columns.is_computed(name))}
            rest = choice.checked_signals(self.layouts, tuple(n for n in names or () if n not in computed))
            asked = None
            if names is not None:
                left = iter(rest or ())
                asked = tuple(computed[name] if name in computed else next(left, "") for name in names)
            self._contact = contact_columns.ContactColumns(calibrations, asked)
            self.asked, self.signals = asked, contact_columns.signals_needed(asked, calibrations)
        else:
            self.asked = self.signals = choice.checked_signals(self.layouts, names)
        self.rate_hz: float | None = args.resample
        self._resampler = None
        if args.resample is not None:
            from tipforce_tools.decode.resample import Resampler

            self._resampler = Resampler(args.resample, self.asked)

    def contact(self, tables: Iterable[Table]) -> Iterable[Table]:
        """Add the contact columns if a calibration is given."""
        return tables if self._contact is None else self._contact.tables(tables)

    def resampled(self, tables: Iterable[Table]) -> Iterable[Table]:
        """Resample to a uniform grid if a rate is given."""
        return tables if self._resampler is None else self._resampler.tables(tables)


def _write_all(args: Namespace, kind: str, names: Sequence[str], steps: _Steps, recording: Recording,
               summary: summaries.Summary, bar: ProgressBar) -> None:  # fmt: skip
    """Write the rows, which pass through this process. Raises as ``write_file`` does."""

    def tables(tap: Tap | None = None) -> Iterable[Table]:
        found = tables_of_logs(recording, names, bar if bar.wanted else None, tap)
        return steps.resampled(summary.passing(steps.contact(found)))

    told = recording.told
    if args.summary and args.output is None:
        for _ in tables():
            pass
        check_readable(args, told)
        return
    check_format(args.output, kind)
    base = (TIME, NODE, *(() if steps.rate_hz is not None else (COUNTER,)))
    inputs = [name for name in names if name != "-"]
    to_file = args.output not in {None, "-"}
    looked_ahead = _looked_ahead if to_file and not args.follow else iter
    if to_file and kind in {"parquet", "csv"}:

        def part(sink: PartFile, shape: Shape) -> Iterator[FilePart]:
            yield 0, sink.write(0, looked_ahead(tables()), shape), shape

        write_file(args, kind, base, inputs, told, part)
        return
    writer: StreamWriter | McapWriter = _mcap(args, inputs) if kind == "mcap" else StreamWriter(
        args.output, kind, base, inputs)  # fmt: skip
    with aborted(args, writer):
        for table in looked_ahead(tables(writer.frames)):
            writer.write(table)
        check_readable(args, told)
        writer.close(told.events())
        if to_file:
            write_events(args.output, told.events())
    if writer.left_out:
        left_out = ", ".join(sorted(writer.left_out))
        common.note(args, f"not in the CSV, because they appeared after its header: {left_out}")


def _mcap(args: Namespace, inputs: Sequence[str]) -> McapWriter:
    from tipforce_robots.mcap_file import McapWriter

    return McapWriter(Path(args.output), inputs)


def _looked_ahead(tables: Iterable[Table]) -> Iterator[Table]:
    """Return the same tables, the first rows with the union of their columns."""
    first: list[Table] = []
    iterator = iter(tables)
    for table in iterator:
        first.append(table)
        if sum(map(len, first)) >= _FIRST_ROWS:
            break
    columns: dict[str, Column] = {}
    for table in first:
        columns |= {column.name: column for column in table.columns}
    channels = first[-1].channels if first else ()
    if first and (len(columns) > len(first[0].columns) or len(first[0].channels) < len(channels)):
        first[0] = first[0].with_columns(columns.values(), channels)
    yield from first
    first.clear()
    yield from iterator


def _report(args: Namespace, summary: summaries.Summary, told: Told, complete: bool) -> None:
    for line in summaries.notes_lines(told):
        common.note(args, line)
    if told.unseen and not args.calibration:
        common.note(args, reasons.not_seen(node for _, node in told.unseen))
    if complete and not summary.samples and told.notes:
        common.note(args, _nothing(args, told))
    if args.summary and not args.json:
        return
    for line in summaries.event_lines(told):
        common.note(args, line)
    for line in summaries.lines(summary, told) if args.verbose else summaries.lost_lines(told):
        common.note(args, line)
    directory = args.output is not None and is_directory(args.output)
    if complete and args.output not in {None, "-"} and not args.json and not (directory and not told.notes):
        lost = sum(told.tally.lost().values())
        common.note(args, f"{args.output}: {summary.samples} samples of {len(summary.nodes())} nodes, {lost} lost")
        if (events := told.events()) and not directory:
            common.note(args, f"{events_path(args.output)}: {counted(len(events), 'event')}")


def _nothing(args: Namespace, told: Told) -> str:
    """Return the reason for an output without rows."""
    frames = sum(notes.frames for notes in told.notes)
    flags = choice.narrowing_flags(args)
    chosen = f"; {flags} may exclude it" if flags and frames else ""
    return f"no sample of a fingertip in {counted(frames, 'frame')}{chosen}"


def check(args: Namespace) -> None:
    """Check for incompatible flags. Raises InputError."""
    if format_of(args.output, args.format) == "mcap":
        given = {"--dbc": args.dbc, "--eds": args.eds, "--signals": args.signals, "--scheduler": args.scheduler}
        for flag, value in given.items():
            if value:
                raise InputError(f"{flag}: MCAP has whole contacts and all frames; for {flag} write .csv or .parquet")
    if args.jobs is not None and args.jobs < 1:
        raise InputError(f"--jobs {args.jobs}: allowed is 1 or more")
    if args.follow and len(args.logs) > 1:
        raise InputError("--follow: allowed is one log")
    if args.follow and args.scheduler:
        raise InputError("--follow: a growing log is decoded locally; leave out --scheduler")
    if (args.follow or args.scheduler) and any(map(is_url, args.logs)):
        raise InputError("a log behind a URL is copied first: leave out --follow and --scheduler, or name a file")
    _check_dataset(args)
    _check_scheduler(args)


def _check_dataset(args: Namespace) -> None:
    directory = args.output is not None and is_directory(args.output)
    if directory and args.format not in {None, "parquet"}:
        raise InputError(f"--format {args.format}: a dataset has Parquet files; name a file with --output")
    if directory and (args.calibration or args.resample is not None or "-" in args.logs or not args.logs):
        raise InputError(
            f"--output {args.output}: a dataset has what the nodes sent, of log files: leave out --calibration, "
            "--resample and stdin; apply a calibration when reading it"
        )
    if directory and (found := [name for name in args.logs if is_dataset(name)]):
        raise InputError(f"{found[0]}: is a dataset, and {args.output} is filled from logs; name the logs")
    if args.hand is not None and not directory:
        raise InputError("--hand: is a partition of a dataset; name one with --output DIR/")


def _check_scheduler(args: Namespace) -> None:
    if not args.scheduler:
        return
    rows_pass_here = args.output in {None, "-"} or args.calibration or args.resample is not None
    if rows_pass_here or format_of(args.output, args.format) not in JOINED:
        raise InputError(
            "--scheduler: its workers write .csv, .jsonl, .parquet or DIR/: name one with --output, and leave out "
            "--calibration and --resample"
        )
    if args.eds:
        raise InputError("--scheduler: --eds follows the SDO traffic of the logs in sequence; leave one out")
    if not [name for name in args.logs if name != "-"]:
        raise InputError("--scheduler: name log files that its workers can read")
