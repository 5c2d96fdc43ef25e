"""Display of a monitor's state: a table, or JSON records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from tipforce_tools.cli.common import shown_id
from tipforce_tools.monitor.state import QUANTITIES, BusView, NodeView, Reading

if TYPE_CHECKING:
    from rich.console import Group

_DIGITS = {"N": 3, "degree": 2}
_UNITS = {"degree": "deg"}
TWO_NODES = "TWO NODES with this id"
"""In place of the status: its values are those of either."""
WIDE = 120
"""Width of the whole table in characters."""
_WIDE_ONLY = frozenset({"Hz", "period ms p50/p99/max"})
_NARROW = {"node": 8, "age": 6, "P": 8, "phi": 10, "theta": 10, "NMT": 11, "last EMCY": 5, "lost": 4}
COLUMNS = ("node", "Hz", "period ms p50/p99/max", "age", *QUANTITIES, "status", "NMT", "last EMCY", "lost")


def record(buses: Sequence[BusView], t_s: float | None, bitrate: int) -> dict[str, Any]:
    """Return one JSON record: all buses at a time in seconds."""
    return {"t": t_s, "buses": [_bus_record(bus, bitrate) for bus in buses]}


def _bus_record(bus: BusView, bitrate: int) -> dict[str, Any]:
    fields = asdict(bus)
    least, worst = fields.pop("least_bits_hz"), fields.pop("worst_bits_hz")
    fields["load_percent"] = [round(100 * bits / bitrate, 2) for bits in (least, worst)]
    return fields


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
    """Return a value of a node with an EDS: `-2 rpm`."""
    if reading.value is None:
        return "STALE" if reading.stale else "unknown"
    return f"{reading.value:.9g} {reading.unit}".rstrip()


def _seconds(seconds: float) -> str:
    return f"{seconds * 1000:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


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


def tables(buses: Sequence[BusView], bitrate: int, foot: str, width: int = WIDE) -> Group:
    """Return the table for a terminal of ``width`` characters: a narrow one has no borders, no rate, and no periods."""
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
        for k in kept:
            fixed = _NARROW.get(COLUMNS[k], status_width) if narrow else None
            table.add_column(COLUMNS[k], width=fixed, overflow="fold")
        for node in bus.nodes:
            texts = cells(node)
            row = (Text(texts[k], style=_style(texts[k])) for k in kept)
            table.add_row(*row, style="dim" if node.stale else "")
        parts += [table, *(Text(node.duplicate, style="bold red") for node in bus.nodes if node.duplicate)]
    return Group(*parts, Text(foot, style="dim"))


def _style(text: str) -> str:
    if "STALE" in text or text == TWO_NODES or text.endswith("heartbeat lost"):
        return "bold red"
    return "yellow" if text.startswith("unknown") else ""
