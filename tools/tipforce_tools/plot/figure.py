"""One run of `tipforce plot`, from logs to the figure: a column of panels per finger, readable without colour."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError, needing
from tipforce.host.dataset.reader import tables_of_logs
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.recording import Recording
from tipforce.host.decoding.sample_table import Table
from tipforce.host.logs.notes import LogNotes, no_sample
from tipforce.output_file import FIGURES, check_output, figure_kind, save_figure
from tipforce.samples.reasons import BY_NAME
from tipforce_tools.cli import common, log_choice
from tipforce_tools.cli.listening import counted
from tipforce_tools.plot.fingers import HATCHES, Finger, Fingers, Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_FINGERS = 20
STATUS, GAUGES = "status", "gauges"
_DEFAULT = ("P", "phi", "theta", GAUGES, STATUS)
TURN = 360.0
COLUMNS = 5  # fingers side by side; more are placed below
_TITLES = {"P": "P", "phi": "phi", "theta": "theta", "force": "force", "gauges": "strain", "temperature": "temperature"}
_UNITS = {"degree": "deg", "microstrain": "microstrain", "degC": "deg C"}
_STYLES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 3)), (0, (1, 3)), (0, (8, 2)))
_INK = ("#0b4f8a", "#a33c00", "#2b6a30", "#5b2a86", "#333333", "#8a6d00", "#00707a", "#91003f")
_LEGEND_COLUMNS = 4
_EPOCH_NS = 10**17  # 1973; earlier times are not dates
LOST = "lost samples"
_BEYOND = 7.0  # degrees beyond 180 on a full-circle axis, which shows a line at 180 on both sides


class _Frame(NamedTuple):
    """Settings shared by all fingers: the time, angles on a full-circle axis, the rows of the strip."""

    start_ns: int
    length_s: float
    circles: frozenset[str]
    bars: tuple[tuple[str, str, str], ...]  # name, label, hatch
    note: str


def plot(args: Namespace) -> int:
    """Draw; return 0. Raises InputError for unusable input, EnvironmentLackError without matplotlib."""
    if args.output is None:
        raise InputError("no output: add -o FILE.png, .svg or .pdf")
    path = Path(args.output)
    names = log_choice.logs(args.logs)
    check_output(path, figure_kind(path, FIGURES), names)
    with needing("a plot needs matplotlib: pip install 'tipforce[plot]'"):
        import matplotlib  # noqa: F401
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
    notes = recording.notes
    _check(args, fingers, notes)
    if STATUS not in wanted and not any(finger.traces for _, finger in fingers.named()):
        raise InputError(f"{', '.join(names)}: no {', '.join(wanted)} in it, so there is nothing to draw")
    save_figure(draw(fingers, args.size, status=STATUS in wanted), path, FIGURES, dpi=130)
    for log in notes:
        if log.bad:
            common.note(f"tipforce plot: {log.source}: {counted(sum(log.bad.values()), 'bad line')} left out")
    if args.json:
        common.print_json(_record(fingers, path))
    else:
        common.note(f"{path}: {counted(len(fingers.named()), 'node')}")
    return 0


def _default(layouts: Layouts) -> Iterable[str]:
    messages = layouts.decoder().messages().values()
    signals = {signal.name: None for _, message in messages for signal in message.signals}
    return _DEFAULT if "P" in signals else signals


def _signals(wanted: Iterable[str], layouts: Layouts, computed: frozenset[str]) -> frozenset[str]:
    signals, rest = set[str](), list[str]()
    for name in wanted:
        if name == GAUGES:
            signals |= {f"SG{k + 1}" for k in range(layouts.gauges)}
        elif name != STATUS:
            known = name.rpartition("_")[0] if name in {"P_N", "phi_deg", "theta_deg"} else name
            signals.add(known) if known in computed else rest.append(known)
    return frozenset(signals.union(log_choice.checked_signals(layouts, tuple(rest)) or ()))


def _check(args: Namespace, fingers: Fingers, notes: Sequence[LogNotes]) -> None:
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


def draw(fingers: Fingers, size_inches: tuple[float, float] | None, *, status: bool) -> Figure:
    """Draw the figure of all fingers. ``size_inches`` None: by its content."""
    from matplotlib.figure import Figure

    named = fingers.named()
    # The panels with data of any finger, from the contact down.
    order = ["P", "phi", "theta", "force", "gauges"]
    panels = list(dict.fromkeys(panel_of(signal) for _, finger in named for signal in finger.traces))
    panels.sort(key=lambda panel: order.index(panel) if panel in order else len(order))
    rows = [*panels, *([STATUS] if status else [])]
    across = min(len(named), COLUMNS)
    down = math.ceil(len(named) / COLUMNS)
    frame = _frame([finger for _, finger in named], fingers)
    heights = [
        *(1.6 if panel in {"P", "phi", "theta"} else 1.3 for panel in panels),
        *([0.35 + 0.17 * len(frame.bars)] * status),
    ]
    size = size_inches or ((9.0 if across == 1 else 1.2 + 3.3 * across), 1.0 + down * (sum(heights) + 0.6))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(
        down * len(rows), across, squeeze=False, sharex=True, sharey=False,
        gridspec_kw={"height_ratios": heights * down},
    )  # fmt: skip
    for number in range(across * down):
        block, column = divmod(number, COLUMNS)
        axes = list(grid[block * len(rows) : (block + 1) * len(rows), column])
        if number < len(named):
            _draw_finger(axes, rows, *named[number], frame)
        else:
            for ax in axes:
                ax.set_visible(False)
    for row, panel in enumerate(rows * down):
        if panel != STATUS:
            _share_limits(list(grid[row]), panel, whole=panel in frame.circles)
        else:
            for ax in grid[row][1:]:
                ax.tick_params(labelleft=False)
    title, start_ns = "", fingers.start_ns
    if start_ns is not None:
        start = datetime.fromtimestamp(start_ns // 10**9, UTC)
        title = f"from {start:%Y-%m-%d %H:%M:%S}.{start_ns // 10**6 % 1000:03d} UTC"
        title = title if start_ns >= _EPOCH_NS else f"from {start_ns * 1e-9:.9g} s of the log's clock"
    figure.suptitle("\n".join(filter(None, (title, frame.note))), fontsize=10)
    return figure


def panel_of(signal: str) -> str:
    """Return the panel of a signal: one for gauges, one for forces, one for each other signal."""
    if signal[:2] == "SG" and signal[2:].isdigit():
        return "gauges"
    return "force" if signal in {"F1", "F2", "F3"} else signal


def _frame(fingers: Sequence[Finger], recording: Fingers) -> _Frame:
    ends: dict[str, list[float]] = {}  # of all lines of a panel of angles, with bands
    for finger in fingers:
        for signal, trace in finger.traces.items():
            line = trace.line()
            if line is not None and finger.units[signal] == "degree":
                ends.setdefault(panel_of(signal), []).extend((float(np.nanmin(line.y)), float(np.nanmax(line.y))))
    circles = {panel for panel, of_panel in ends.items() if max(of_panel) - min(of_panel) >= TURN}
    happened = {name for finger in fingers for flags in finger.flags.values() for name in flags.bars()}
    names = [name for name in HATCHES if name in happened or name == "contact"] + sorted(happened - {*HATCHES})
    bars = [(name, BY_NAME.get(name, name.replace("_", " ")), HATCHES.get(name, "xx")) for name in names]
    if any(finger.lost.total for finger in fingers):
        bars.append((LOST, LOST, ""))
    banded = any(trace.banded for finger in fingers for trace in finger.traces.values())
    note = "grey: two standard uncertainties to either side (95 %)" if banded else ""
    start_ns = recording.start_ns or 0
    return _Frame(start_ns, (recording.end_ns - start_ns) * 1e-9, frozenset(circles), tuple(bars), note)


def _draw_finger(axes: Sequence[Axes], rows: Sequence[str], name: str, finger: Finger, frame: _Frame) -> None:
    start_ns = frame.start_ns
    for ax, panel in zip(axes, rows, strict=True):
        ax.tick_params(labelsize=8)
        if panel == STATUS:
            _draw_status(ax, finger, frame)
            continue
        ax.grid(True, color="0.9", linewidth=0.6)
        signals = [signal for signal in finger.traces if panel_of(signal) == panel]
        for number, signal in enumerate(sorted(signals)):
            line = finger.traces[signal].line()
            if line is not None:
                _draw_line(ax, signal, line, number, whole=panel in frame.circles, start_ns=start_ns)
        unit = finger.units[signals[0]] if signals else ""
        ax.set_ylabel(f"{_TITLES.get(panel, panel)} ({_UNITS.get(unit, unit)})" if unit else panel, fontsize=8)
        if len(signals) > 1:  # above the panel: inside it, it would cover a line at the gauges' limit
            ax.legend(
                loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, borderpad=0.1, frameon=False,
                fontsize=7, ncols=min(len(signals), _LEGEND_COLUMNS), handlelength=2.2, columnspacing=1.2,
            )  # fmt: skip
        if not signals or all(finger.traces[signal].line() is None for signal in signals):
            text = "always unknown" if signals else "not in the log"
            ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", fontsize=8, color="0.4")
    lost = f", {finger.lost.total} samples lost" if finger.lost.total else ""
    legend = axes[0].get_legend()  # it needs space below the title
    pad_points = 6.0 if legend is None else 8.0 + 12.0 * math.ceil(len(legend.get_texts()) / _LEGEND_COLUMNS)
    axes[0].set_title(f"{name}{lost}", fontsize=9, pad=pad_points)
    axes[-1].set_xlabel("time (s)", fontsize=8)
    axes[-1].set_xlim(0, max(frame.length_s, 1e-6))
    axes[-1].tick_params(labelbottom=True)


def _draw_line(ax: Axes, signal: str, line: Line, number: int, *, whole: bool, start_ns: int) -> None:
    x = np.asarray((line.t_ns - start_ns) * 1e-9, dtype=np.float64)
    ink, style = _INK[number % len(_INK)], _STYLES[number % len(_STYLES)]
    turns: tuple[float, ...] = (0.0,)
    if whole:
        turns = (0.0, -TURN, TURN)  # the parts of bands beyond 180 continue at -180
    t, (mean, low, high, band_low, band_high) = (wrapped if whole else broken)(line.starts, x, line.y)
    has_band = bool(np.isfinite(band_low).any())
    for turn in turns:
        if has_band:
            ax.fill_between(t, band_low + turn, band_high + turn, color="0.78", linewidth=0)
        if bool((line.y[2] > line.y[1]).any()):
            ax.fill_between(t, low + turn, high + turn, color=ink, alpha=0.5, linewidth=0.5)
    ax.plot(t, mean, color=ink, linestyle=style, linewidth=0.9, label=signal if panel_of(signal) != signal else "")
    # A line of one point is invisible.
    alone = line.starts & np.append(line.starts[1:], True)
    if alone.any():
        points = line.y[:3, alone]
        points = points - (TURN * np.ceil((points[0] - TURN / 2) / TURN) if whole else 0.0)
        ax.plot(x[alone], points[0], ".", color=ink, markersize=3)
        ax.vlines(x[alone], points[1], points[2], color=ink, linewidth=0.8)


def _share_limits(axes: Sequence[Axes], panel: str, *, whole: bool) -> None:
    """Set equal limits in a row, so that fingers are comparable; an angle that wraps gets the full circle."""
    from matplotlib.ticker import FuncFormatter, MultipleLocator

    drawn = [ax for ax in axes if ax.get_visible() and ax.has_data()]
    if not drawn:
        return
    low, high = min(ax.get_ylim()[0] for ax in drawn), max(ax.get_ylim()[1] for ax in drawn)
    if panel in {"phi", "theta"}:
        if whole:
            low, high = -TURN / 2 - _BEYOND, TURN / 2 + _BEYOND
            for ax in drawn:
                ax.yaxis.set_major_locator(MultipleLocator(90))
        for ax in drawn:
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _angle(value)))
    for ax in drawn:
        ax.set_ylim(low, high)
        if ax is not axes[0]:
            ax.tick_params(labelleft=False)
            ax.set_ylabel("")


def _angle(value: float) -> str:
    shown = value if abs(value) <= TURN / 2 else value - TURN * math.ceil((value - TURN / 2) / TURN)
    return f"{shown:g}"


def _draw_status(ax: Axes, finger: Finger, frame: _Frame) -> None:
    """Draw a row per kind of event of any finger, so that fingers are comparable."""
    bars = {name: runs for flags in finger.flags.values() for name, runs in flags.bars().items()}
    for number, (name, _, hatch) in enumerate(frame.bars):
        if name == LOST:
            x = (finger.lost.times_ns() - frame.start_ns) * 1e-9
            ax.plot(x, np.full(len(x), number), linestyle="", marker="x", color="black", markersize=5)
            continue
        spans = [((begin - frame.start_ns) * 1e-9, max(end - begin, 1) * 1e-9) for begin, end in bars.get(name, [])]
        face = "0.55" if name == "contact" else "#f2c9b8"
        # The edge keeps short bars visible.
        ax.broken_barh(spans, (number - 0.35, 0.7), facecolor=face, edgecolor="0.15", linewidth=0.6, hatch=hatch)
    ax.set_yticks(range(len(frame.bars)), [label for _, label, _ in frame.bars], fontsize=7)
    ax.set_ylim(len(frame.bars) - 0.5, -0.5)
    ax.grid(True, axis="x", color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)


def broken(starts: BoolArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return x (k,) and y (m, k) with a NaN before each point that starts a line."""
    at = np.flatnonzero(starts[1:]) + 1
    return np.insert(x, at, np.nan), np.insert(y, at, np.nan, axis=1)


def wrapped(starts: BoolArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Wrap unwrapped angles in degrees: return x (k,) and y (m, k) with the mean, y[0], within -180..180, the others
    with it. A line that crosses 180 continues beyond it, and starts again one turn lower; the axis is clipped."""
    shift = TURN * np.ceil((y[0] - TURN / 2) / TURN)
    crossing = np.flatnonzero((np.diff(shift) != 0) & ~starts[1:]) + 1  # the point after each
    at, before = np.repeat(crossing, 3), crossing - 1
    beyond, back = y[:, crossing] - shift[before], y[:, before] - shift[crossing]
    three = np.stack((beyond, np.full_like(beyond, np.nan), back), axis=-1).reshape(len(y), -1)
    times = np.stack((x[crossing], np.full(len(crossing), np.nan), x[before]), axis=-1).ravel()
    return broken(np.insert(starts, at, False), np.insert(x, at, times), np.insert(y - shift, at, three, axis=1))
