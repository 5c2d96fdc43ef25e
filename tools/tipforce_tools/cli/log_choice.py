"""What the flags of ``log_flags.add_choice_arguments`` choose: logs, times, signals, layouts, calibrations."""

from __future__ import annotations

import re
import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce.host.dataset.reader import logs_named, start_of
from tipforce.host.dataset.store import is_dataset, local_copy
from tipforce.host.decoding.log_part import Reading, When
from tipforce.host.decoding.pdo_layout import Layouts, dcf_layout, node_layout, signals_named, with_layouts
from tipforce.shipped_files import file_or_shipped
from tipforce_tools.cli import bus_flags
from tipforce_tools.cli.common import note
from tipforce_tools.cli.log_flags import eds_files

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration

STDIN = "-"
_EPOCH_FROM_S = 100_000_000  # 1973: smaller numbers are seconds since the first frame


def logs(words: Sequence[str]) -> list[str]:
    """Return the logs that words and globs name, default stdin; of a URL a local copy. Raises InputError."""
    if not words and sys.stdin.isatty():
        raise InputError("no log: name one (`tipforce decode run.log`), or pipe candump text to stdin")
    found = [name for word in words or [STDIN] for name in ([word] if word == STDIN else logs_named(word))]
    for name in found:
        if name != STDIN and Path(name).is_dir() and not is_dataset(name):
            raise InputError(f"{name}: is a directory; name its logs: {name.rstrip('/')}/*.log")
    if found.count(STDIN) and len(found) > 1:
        raise InputError("-: stdin cannot be decoded together with files")
    return [name if is_dataset(name) else local_copy(name) for name in found]


def narrowing_flags(args: Namespace) -> str:
    """Return the given flags that leave samples out, as written; empty for none."""
    given = (("--nodes", args.nodes), ("--bus", args.bus), ("--from", args.start), ("--to", args.end))
    return ", ".join(flag for flag, value in given if value is not None)


def when(flag: str, text: str | None) -> When | None:
    """Parse a time: seconds from the start, seconds of the epoch, or ISO 8601. Raises InputError."""
    if text is None:
        return None
    number = re.fullmatch(r"(\d+)(?:\.(\d{1,9}))?", text.strip())
    if number is not None:
        ns = int(number[1]) * 1_000_000_000 + int((number[2] or "0").ljust(9, "0"))
        return When(ns, int(number[1]) < _EPOCH_FROM_S)
    try:
        return When(round(datetime.fromisoformat(text.strip()).timestamp() * 1e6) * 1000, False)
    except ValueError:
        raise InputError(
            f"{flag} {text}: allowed are seconds from the start, seconds of the epoch, or ISO time: "
            "2026-05-17T09:30:00 (local; with Z or +02:00 of that zone)"
        ) from None


def layouts(args: Namespace) -> tuple[Layouts, Mapping[int | None, Calibration]]:
    """Return the layouts that --gauges, --nodes, --dcf, --dbc, --eds and --ask select, and the calibrations. Without
    those flags the layouts are of nodes with the gauges of --calibration. Raises InputError."""
    if args.dbc and (args.dcf or args.ask):
        raise InputError("--dbc: defines all layouts; leave out --dcf and --ask")
    if args.eds and (args.dbc or args.dcf or args.ask or args.gauges):
        raise InputError("--eds: defines all layouts; leave out --dbc, --dcf, --ask and --gauges")
    nodes = None if args.nodes is None else tuple(args.nodes)
    dbc = str(file_or_shipped(args.dbc, "dbc")) if args.dbc else None
    chosen = Layouts(nodes=nodes, eds=eds_files(args.eds)) if args.eds else Layouts(args.gauges or 3, nodes, dbc)
    if args.dcf:
        chosen = with_layouts(chosen, [dcf_layout(path) for path in args.dcf])
    if args.ask:
        from tipforce.host.network.bus import Bus

        with Bus(bus_flags.open_bus(args)) as bus:
            chosen = with_layouts(chosen, [node_layout(bus.sdo(node)) for node in args.ask])
    if args.gauges and chosen.gauges != args.gauges:
        raise InputError(f"--gauges {args.gauges}: the layouts are of nodes with {chosen.gauges}")
    if not args.calibration:
        return chosen, {}
    from tipforce.host.decoding.contact_columns import gauges_of, read_calibrations

    calibrations = read_calibrations(args.calibration)
    if not (args.gauges or args.dcf or args.ask):
        chosen = replace(chosen, gauges=gauges_of(calibrations))
    return chosen, calibrations


def names_of(text: str | None) -> tuple[str, ...] | None:
    """Split `P,theta` into names. Raises InputError for an empty list."""
    if text is None:
        return None
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if not names:
        raise InputError("--signals: expected names such as P,theta")
    return names


def reading(args: Namespace, names: Sequence[str], chosen: Layouts, signals: tuple[str, ...] | None) -> Reading:
    """Return the selection of the logs' content. Raises InputError."""
    start, end = when("--from", args.start), when("--to", args.end)
    if start and end and start.relative == end.relative and start.ns >= end.ns:
        raise InputError(f"--from {args.start} --to {args.end}: allowed is an end after the start")
    found = Reading(
        chosen, signals, args.bus and tuple(args.bus.split(",")), start, end,
        strict=args.strict, follow=args.follow, deltas=args.deltas,
    )  # fmt: skip
    relative = any(limit is not None and limit.relative for limit in (start, end))
    for name in names if relative else ():
        if name == STDIN or Path(name).is_fifo() or found.origin_ns is not None:
            break
        found = replace(found, origin_ns=start_of(name))
    return found


def checked_signals(chosen: Layouts, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    """Return the signals of the names. Raises InputError, also for incompatible layouts."""
    decoder = chosen.decoder(say=note)
    return None if names is None else signals_named(decoder, names)
