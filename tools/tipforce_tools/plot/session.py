"""One run of `tipforce plot`: from logs to the figure, and the final report."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable, Sequence
from pathlib import Path

from tipforce.errors import InputError
from tipforce.host.dataset.reader import tables_of_logs
from tipforce.host.decoding.log_part import Notes
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.recording import Recording
from tipforce.host.decoding.sample_table import Table
from tipforce.host.logs.empty import no_sample
from tipforce.output_file import FIGURES, check_output, figure_kind, save_figure
from tipforce_tools.cli import common, log_choice
from tipforce_tools.cli.listening import counted
from tipforce_tools.plot import figure
from tipforce_tools.plot.fingers import Fingers

MOST_FINGERS = 20
STATUS, GAUGES = "status", "gauges"
_DEFAULT = ("P", "phi", "theta", GAUGES, STATUS)


def plot(args: Namespace) -> int:
    """Draw; return 0. Raises InputError for unusable input, EnvironmentLackError without matplotlib."""
    if args.output is None:
        raise InputError("no output: add -o FILE.png, .svg or .pdf")
    path = Path(args.output)
    names = log_choice.logs(args.logs)
    check_output(path, figure_kind(path, FIGURES), names)
    plt = figure.import_matplotlib()
    layouts, calibrations = log_choice.layouts(args)
    contact, computed = None, frozenset[str]()
    if calibrations:  # the contact is estimated from gauges
        from tipforce.host.decoding.contact_columns import COLUMNS, ContactColumns

        contact, computed = ContactColumns(calibrations, None), frozenset(column.signal for column in COLUMNS)
    wanted = log_choice.names_of(args.signals) or _default(layouts)
    reading = log_choice.reading(args, names, layouts, None)
    recording = Recording(reading)
    fingers = Fingers(_signals(wanted, layouts, computed), computed)
    tables: Iterable[Table] = tables_of_logs(recording, names)
    for table in tables if contact is None else contact.tables(tables):
        fingers.add(table)
    notes = recording.told.notes
    _check(args, fingers, notes)
    if STATUS not in wanted and not any(finger.traces for _, finger in fingers.named()):
        raise InputError(f"{', '.join(names)}: no {', '.join(wanted)} in it, so there is nothing to draw")
    drawn = figure.draw(fingers, plt, args.size, status=STATUS in wanted)
    try:
        save_figure(drawn, path, FIGURES, dpi=130)
    finally:
        plt.close(drawn)
    for log in notes:
        if log.bad:
            common.note(f"tipforce plot: {log.source}: {counted(sum(log.bad.values()), 'bad line')} left out")
    if args.json:
        common.print_json(_record(fingers, path))
    else:
        common.note(f"{path}: {counted(len(fingers.named()), 'node')}")
    return 0


def _default(layouts: Layouts) -> Iterable[str]:
    """Return the contact, gauges and status of fingertips, or every signal of devices of another kind."""
    messages = layouts.decoder().messages().values()
    signals = {signal.name: None for _, message in messages for signal in message.signals}
    return _DEFAULT if "P" in signals else signals


def _signals(wanted: Iterable[str], layouts: Layouts, computed: frozenset[str]) -> frozenset[str]:
    """Return the signals of the requested panels. Raises InputError for an unknown name."""
    signals: set[str] = set()
    for name in wanted:
        if name == GAUGES:
            signals |= {f"SG{k + 1}" for k in range(layouts.gauges)}
        elif name != STATUS:
            known = name.rpartition("_")[0] if name in {"P_N", "phi_deg", "theta_deg"} else name
            signals.add(known if known in computed else (log_choice.checked_signals(layouts, (known,)) or (known,))[0])
    return frozenset(signals)


def _check(args: Namespace, fingers: Fingers, notes: Sequence[Notes]) -> None:
    names = ", ".join(log.source for log in notes)
    count = len(fingers.named())
    if not count:
        frames = sum(log.frames for log in notes)
        flags = log_choice.narrowing_flags(args)
        if not flags:
            raise no_sample(names, frames, sum(log.extended for log in notes))
        why = f" (of {counted(frames, 'frame')}, with {flags})"
        raise InputError(f"{names}: no PDO of a fingertip{why}, so there is nothing to draw")
    if not fingers.timed:
        raise InputError(f"{names}: no timestamps, which a plot needs; candump -L writes them")
    if count > MOST_FINGERS:
        raise InputError(f"{count} nodes: allowed are at most {MOST_FINGERS} in a plot; choose with --nodes")


def _record(fingers: Fingers, path: Path) -> dict[str, object]:
    nodes = [
        {
            "node": name, "signals": list(finger.traces), "lost": finger.lost.total,
            "unknown": {signal: trace.unknown for signal, trace in finger.traces.items()},
            "flags": sorted(name for flags in finger.flags.values() for name in flags.bars()),
        }
        for name, finger in fingers.named()
    ]  # fmt: skip
    return {"output": str(path), "start_ns": fingers.start_ns, "nodes": nodes}
