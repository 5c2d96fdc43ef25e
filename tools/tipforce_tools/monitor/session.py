"""One run of `tipforce monitor`: from a source through the monitor to the screen, until an end condition."""

from __future__ import annotations

import math
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

from tipforce.errors import InputError
from tipforce.host.live.receiver import InterfaceDownError, Selection
from tipforce.host.live.targets import ANY, STDIN, split_targets
from tipforce.host.logs.notes import no_frame, no_sample
from tipforce.watching.bus_monitor import QUANTITIES, BusView, Monitor, NodeView, Reading
from tipforce.watching.frame_sources import BusSource, FrameSource, LogSource, PipeSource
from tipforce_tools.cli import bus_flags, common, log_flags
from tipforce_tools.cli.common import shown_id
from tipforce_tools.cli.listening import Hints, StopSignals, check_sync, counted, open_targets
from tipforce_tools.cli.main import INTERRUPTED
from tipforce_tools.cli.tables import console as rich_console

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Group
    from rich.live import Live

    from tipforce.host.logs.reader import LogReader

BITRATE = 1_000_000
_SCREEN_S, _LINE_S = 0.25, 1.0
_SLICE_S = 0.1  # maximum delay of a key or a signal


def monitor(args: Namespace) -> int:
    """Show the nodes until the source ends, a signal, or --once; return 0, or 130 after a signal."""
    log_name, targets = split_targets(args.targets)
    check_sync(args, log_name)
    watched = Monitor(args.gauges, args.nodes, log_flags.eds_files(args.eds or ()))
    screen = sys.stdout.isatty() and not common.OUTPUT.json and args.once is None
    interval_s = args.interval or (_SCREEN_S if screen else _LINE_S)
    with ExitStack() as opened:
        stop = opened.enter_context(StopSignals())
        hints = Hints(lambda _text: None)
        source, log = _source(args, log_name, targets, interval_s, opened, hints)
        bitrate = bus_flags.bus_options(args).get("bitrate", BITRATE)
        live = None
        if screen:
            from rich.live import Live

            live = opened.enter_context(Live(console=rich_console(), auto_refresh=False, transient=False))
        show = partial(_show, live, bitrate, interval_s, hints)
        each = show if screen or (common.OUTPUT.json and args.once is None) else None
        shown = run(watched, source, stop, interval_s, each, args.once or math.inf)
        if log is not None and source.ended:
            if not watched.frames:
                raise no_frame(str(log_name), log.first_bad)
            if not args.nodes and not any(bus.nodes for bus in watched.views()):
                raise no_sample(str(log_name), watched.frames, log.extended)
        if not screen and not shown:
            show(watched, source.now_ns())
    if log is not None and log.bad:
        reasons = ", ".join(f"{count} {reason}" for reason, count in log.bad.items())
        common.note(f"tipforce monitor: {counted(sum(log.bad.values()), 'bad line')} left out ({reasons})")
    return INTERRUPTED if stop() else 0


def run(
    watched: Monitor, source: FrameSource, stopped: Callable[[], bool], interval_s: float,
    show: Callable[[Monitor, int | None], None] | None, once_s: float = math.inf,
) -> bool:  # fmt: skip
    """Update the monitor until the source ends, ``stopped`` is true, or --once is over; return whether it was shown. It
    is shown at each interval of the frames' clock, so that a log gives the same lines."""
    begun_s, first_ns, due_ns, shown = time.monotonic(), None, 0, False
    interval_ns = round(interval_s * 1e9)
    while not source.ended and not stopped():
        try:
            frames, names = source.take(_SLICE_S)
        except InterfaceDownError:  # it may recover; until then all values become stale
            continue
        watched.feed(frames, names)
        now_ns = source.now_ns()
        if now_ns is None:
            if time.monotonic() - begun_s >= once_s:
                break
            continue
        if first_ns is None or now_ns < first_ns:  # or a recording with a clock set back
            first_ns = int(frames["t_ns"][0]) if len(frames) else now_ns
            due_ns = first_ns + interval_ns
        if now_ns - first_ns >= once_s * 1e9:
            break
        if now_ns >= due_ns and show is not None:
            show(watched, now_ns)
            shown = True
            due_ns = max(due_ns, now_ns - interval_ns) + interval_ns
    return shown


def _source(
    args: Namespace, name: Path | str | None, targets: Sequence[Selection], interval_s: float, opened: ExitStack,
    hints: Hints,
) -> tuple[FrameSource, LogReader | None]:  # fmt: skip
    if name is None:
        if args.follow or args.speed != math.inf:
            raise InputError("--follow and --speed: need a log")
        channels = {target.channel for target in targets}
        if len(targets) > (1 if ANY in channels else len(channels)):  # each frame twice looks like two nodes
            raise InputError(f"{', '.join(sorted(channels))}: allowed is each bus once, with all its filters")
        return BusSource(opened.enter_context(open_targets(targets, args, hints=hints))), None
    if targets:
        raise InputError(f"{targets[0].channel}: not allowed with the log {name}; --nodes selects from a log")
    from tipforce.host.logs.reader import open_log

    log = open_log(name, follow=args.follow)
    if name == STDIN or args.follow:
        return PipeSource(log), log  # not closed: its thread may read
    opened.enter_context(log)
    step_ns = round((args.once or interval_s) * 1e9)
    return LogSource(log, args.speed, step_ns), log


def _show(
    live: Live | None, bitrate: int, interval_s: float, hints: Hints, watched: Monitor, now_ns: int | None
) -> None:
    buses = watched.views(now_ns)
    if live is not None:
        foot = f"{counted(watched.frames, 'frame')}; every {interval_s:g} s; Ctrl-C ends"
        live.update(tables(buses, bitrate, _missing(hints, buses), foot, live.console.width), refresh=True)
    elif common.OUTPUT.json:
        common.print_json(record(buses, None if now_ns is None else now_ns / 1_000_000_000, bitrate))
    else:
        print("\n".join([*plain(buses, bitrate), *_missing(hints, buses)]))
    sys.stdout.flush()


_DIGITS = {"N": 3, "degree": 2}
_UNITS = {"degree": "deg"}
TWO_NODES = "TWO NODES with this id"
"""In place of the status: its values are those of either."""
WIDE = 120
"""Width of the whole table in characters."""
_VALUES = ("node", *QUANTITIES)
_WIDE_ONLY = frozenset({"Hz", "period ms p50/p99/max"})
_NARROW = {"node": 8, "age": 6, "P": 8, "phi": 10, "theta": 10, "NMT": 11, "last EMCY": 5, "lost": 4}
COLUMNS = ("node", "Hz", "period ms p50/p99/max", "age", *QUANTITIES, "status", "NMT", "last EMCY", "lost")


def record(buses: Sequence[BusView], t_s: float | None, bitrate: int) -> dict[str, Any]:
    """Return one JSON record: all buses at a time in seconds."""
    records = []
    for fields in map(asdict, buses):
        loads = fields.pop("least_bits_hz"), fields.pop("worst_bits_hz")
        records.append(fields | {"load_percent": [round(100 * bits / bitrate, 2) for bits in loads]})
    return {"t": t_s, "buses": records}


def headline(bus: BusView, bitrate: int) -> str:
    """Return the line above a bus's table."""
    low, high = (100 * bits / bitrate for bits in (bus.least_bits_hz, bus.worst_bits_hz))
    errors = f", {bus.errors} error frames" if bus.errors else ""
    load = f"load {low:.0f} to {high:.0f} % of {bitrate / 1000:g} kbit/s"
    return f"{bus.name or 'bus'}: {bus.frames_hz:.0f} frames/s, {load}, SYNC {bus.sync_hz:.1f} Hz{errors}"


def cells(node: NodeView) -> tuple[str, ...]:
    """Return one row, in the order of COLUMNS."""
    periods = node.periods
    regular = f"{periods.p50_ms:.2f}/{periods.p99_ms:.2f}/{periods.max_ms:.2f}" if periods else "-"
    age = "-" if node.age_s is None else f"{'STALE ' if node.stale else ''}{_seconds(node.age_s)}"
    emergency = node.emergency
    emcy = f"{emergency.code:04X}h {emergency.text}, {_seconds(emergency.age_s)} ago" if emergency else "-"
    nmt = f"{node.nmt}, heartbeat lost" if node.nmt_lost else node.nmt or "no heartbeat"
    readings = (shown(node.readings[name]) if name in node.readings else "-" for name in QUANTITIES)
    values = (f"{name}={_value(reading)}" for name, reading in node.readings.items() if name not in QUANTITIES)
    # A silent node has no present status, either.
    status = "STALE" if node.stale else " ".join((*node.status, *values)) or "-"
    if node.duplicate:
        status = TWO_NODES
    return shown_id(node.node_id), f"{node.rate_hz:.1f}", regular, age, *readings, status, nmt, emcy, str(node.lost)


def shown(reading: Reading) -> str:
    """Return `4.398 N`, `unknown: no contact`, `STALE, last 2.0 s ago`."""
    if reading.value is not None:
        return f"{reading.value:.{_DIGITS.get(reading.unit, 3)}f} {_UNITS.get(reading.unit, reading.unit)}"
    return f"STALE, {reading.reason}" if reading.stale else f"unknown: {reading.reason}"


def _value(reading: Reading) -> str:
    if reading.value is None:
        return "STALE" if reading.stale else "unknown"
    return f"{reading.value:.9g} {reading.unit}".rstrip()


def _seconds(seconds: float) -> str:
    return f"{seconds * 1000:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


def _missing(hints: Hints, buses: Sequence[BusView]) -> list[str]:
    duplicates = {node.duplicate for bus in buses for node in bus.nodes}
    return [text for text in map(str, hints.findings()) if text not in duplicates]


def plain(buses: Sequence[BusView], bitrate: int) -> Iterator[str]:
    """Yield lines of text with columns of minimum width."""
    for bus in buses:
        yield headline(bus, bitrate)
        rows = [COLUMNS, *(cells(node) for node in bus.nodes)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(COLUMNS))]
        for row in rows:
            yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        yield from (node.duplicate for node in bus.nodes if node.duplicate)
        if not bus.nodes:
            yield "no node found yet"
    if not buses:
        yield "no frames received"


def tables(buses: Sequence[BusView], bitrate: int, lines: Iterable[str], foot: str, width: int = WIDE) -> Group:
    """Return the table, ``lines`` and ``foot``; one narrower than WIDE has no borders, no rate, and no periods;
    below 80 characters only the values are in it."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    parts: list[Any] = []
    for bus in buses:
        narrow = width < WIDE
        table = Table(title=headline(bus, bitrate), title_justify="left", expand=False)
        if narrow:
            table.box, table.padding, table.pad_edge = None, (0, 1, 0, 0), False
        kept = [k for k, name in enumerate(COLUMNS) if not narrow or name not in _WIDE_ONLY]
        status_width = max(width - sum(_NARROW.values()) - len(kept), 10)
        # Below 80 characters a column would break numbers: all but the values is in a line for each node.
        below = [k for k in kept if width < 80 and COLUMNS[k] not in _VALUES]
        kept = [k for k in kept if k not in below]
        for k in kept:
            fixed = _NARROW.get(COLUMNS[k], status_width) if narrow else None
            table.add_column(COLUMNS[k], width=fixed, overflow="fold")
        for node in bus.nodes:
            texts = cells(node)
            row = (Text(texts[k], style=_style(texts[k])) for k in kept)
            table.add_row(*row, style="dim" if node.stale else "")
        parts.append(table)
        for texts in map(cells, bus.nodes if below else ()):
            line = f"{texts[0]}: {', '.join(f'{COLUMNS[k]} {texts[k]}' for k in below if texts[k] != '-')}"
            parts.append(Text(line, style=_style(line)))
        parts += (Text(node.duplicate, style="bold red") for node in bus.nodes if node.duplicate)
    return Group(*parts, *map(Text, lines), Text(foot, style="dim"))


def _style(text: str) -> str:
    if "STALE" in text or text == TWO_NODES or text.endswith("heartbeat lost"):
        return "bold red"
    return "yellow" if text.startswith("unknown") else ""
