"""What a recording holds: per node samples, lost ones, missing values with reasons, and times; events as CSV."""

from __future__ import annotations

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tipforce.arrays import BoolArray
from tipforce.host.decoding.recording import Told
from tipforce.host.decoding.sample_table import NODE_BITS, Column, Table
from tipforce.host.decoding.services import BusEvent
from tipforce.output_file import Kind, write_file
from tipforce.samples.reasons import CAUSES
from tipforce_tools.cli.common import shown_id
from tipforce_tools.writing.text_rows import event_rows

EVENT_COLUMNS = ("t_s", "channel", "node", "event", "code", "text")
_EVENTS_KIND = Kind("a file of events of `tipforce decode`", rb"\A" + ",".join(EVENT_COLUMNS).encode() + rb"\n")
NO_FRAME, UNKNOWN = "no_frame", "unknown"
_EVENTS = {"emcy_reset": "EMCY no error", "boot_up": "boot-up", "state": "NMT state", "calibration": "calibration"}
_ORDER = (*CAUSES, UNKNOWN)


@dataclass(slots=True)
class NodeSummary:
    """One node. Times in nanoseconds, None for a log without.

    ``told``: by column and reason, samples whose frame says that there is no value; ``present``: by column, samples
    with a frame that carries it.
    """

    channel: str
    node: int
    samples: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    told: defaultdict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    present: Counter[str] = field(default_factory=Counter)

    @property
    def missing(self) -> dict[str, dict[str, int]]:
        """Return by column and reason the number of samples without a value; columns never sent are left out."""
        found = {}
        for name, present in self.present.items():
            told = self.told.get(name, Counter())
            reasons = {reason: told[reason] for reason in _ORDER if reason in told}
            if present < self.samples:
                reasons[NO_FRAME] = self.samples - present
            if reasons and present:
                found[name] = reasons
        return found

    def append(self, other: NodeSummary) -> None:
        """Add the statistics of other samples."""
        self.samples += other.samples
        self.first_ns = min((t for t in (self.first_ns, other.first_ns) if t is not None), default=None)
        self.last_ns = max((t for t in (self.last_ns, other.last_ns) if t is not None), default=None)
        self.present.update(other.present)
        for column, reasons in other.told.items():
            self.told[column].update(reasons)

    def record(self, told: Told) -> dict[str, Any]:
        """Return the JSON record."""
        place = self.channel, self.node
        messages = {
            name: {"frames": count.frames, **({} if count.lost is None else {"lost": count.lost})}
            for (channel, node, name), count in told.tally.messages.items()
            if (channel, node) == place
        }
        return {
            "channel": self.channel,
            "node": self.node,
            "samples": self.samples,
            "lost": told.tally.lost().get(place),
            "first_s": None if self.first_ns is None else self.first_ns / 1_000_000_000,
            "last_s": None if self.last_ns is None else self.last_ns / 1_000_000_000,
            "missing": self.missing,
            "messages": messages,
            "short": {
                name: short for (channel, node, name), short in told.tally.short.items() if (channel, node) == place
            },
        }


class Summary:
    """Collect statistics of tables that pass through."""

    def __init__(self, reasons: bool = True) -> None:
        """``reasons``: count the missing values by their reasons."""
        self._nodes: dict[tuple[str, int], NodeSummary] = {}
        self._reasons = reasons
        self.samples = 0

    def passing(self, tables: Iterable[Table]) -> Iterator[Table]:
        """Return the same tables."""
        for table in tables:
            self.add(table)
            yield table

    def add(self, table: Table) -> None:
        """Count a table."""
        self.samples += len(table)
        nodes = {}
        order = np.argsort(table.key, kind="stable")
        sorted_key, t_ns = table.key[order], table.t_ns[order]
        starts = np.flatnonzero(np.append(True, sorted_key[1:] != sorted_key[:-1]))
        counts = np.diff(np.append(starts, len(table)))
        lows, highs = np.minimum.reduceat(t_ns, starts), np.maximum.reduceat(t_ns, starts)
        for number, key in enumerate(sorted_key[starts].tolist()):
            place = table.channels[key >> NODE_BITS], key & ((1 << NODE_BITS) - 1)
            node = nodes[key] = self._nodes.setdefault(place, NodeSummary(*place))
            span = (int(lows[number]), int(highs[number])) if table.timed else (None, None)
            node.append(NodeSummary(*place, int(counts[number]), *span))
        if not self._reasons:
            return
        causes = [
            (number, table.values[name] == is_set, signals)
            for number, (name, is_set, signals) in enumerate(CAUSES.values())
            if name in table.values
        ]
        for column in table.columns:
            if column.kind == "real":
                absent = table.absent.get(column.name)
                there = counts if absent is None else np.add.reduceat(~absent[order], starts, dtype=np.int64)
                for number, key in enumerate(nodes):
                    nodes[key].present[column.name] += int(there[number])
                self._add_missing(column, table, nodes, causes)

    def append(self, other: Summary) -> None:
        """Add the statistics of other tables."""
        self.samples += other.samples
        for place, node in other._nodes.items():
            self._nodes.setdefault(place, NodeSummary(*place)).append(node)

    def _add_missing(
        self,
        column: Column,
        table: Table,
        nodes: dict[int, NodeSummary],
        causes: list[tuple[int, BoolArray, set[str] | None]],
    ) -> None:
        """Count the missing values of a column, each by the first reason that its row tells."""
        rows = np.flatnonzero(np.isnan(table.values[column.name]))
        absent = table.absent.get(column.name)
        if absent is not None:
            rows = rows[~absent[rows]]
        reason = np.full(len(rows), _ORDER.index(UNKNOWN))
        for number, is_set, signals in reversed(causes):  # the first one counts
            if signals is None or column.signal in signals:
                reason[is_set[rows]] = number
        counts = np.bincount(table.key[rows].astype(np.intp) * len(_ORDER) + reason)
        places = np.flatnonzero(counts)
        for place, count in zip(places.tolist(), counts[places].tolist(), strict=True):
            key, number = divmod(place, len(_ORDER))
            nodes[key].told[column.name][_ORDER[number]] += count

    def nodes(self) -> list[NodeSummary]:
        """Return the nodes by channel and node-id."""
        return [self._nodes[place] for place in sorted(self._nodes)]


def bad_lines(told: Told) -> dict[str, int]:
    """Return the bad lines of all logs by reason."""
    return sum((Counter(notes.bad) for notes in told.notes), Counter())


def record(summary: Summary, told: Told, output: str | None) -> dict[str, Any]:
    """Return the whole summary as a JSON record."""
    return {
        "output": output,
        "logs": [notes.source for notes in told.notes],
        "frames": sum(notes.frames for notes in told.notes),
        "samples": summary.samples,
        "lost": sum(told.tally.lost().values()),
        "bad": bad_lines(told),
        "skipped": sum((Counter(notes.skipped) for notes in told.notes), Counter()),
        "events": [
            dict(zip(EVENT_COLUMNS, (event.t_ns / 1_000_000_000, *event[1:]), strict=True)) for event in told.events()
        ],
        "nodes": [node.record(told) for node in summary.nodes()],
    }


def lines(summary: Summary, told: Told) -> Iterator[str]:
    """Yield the summary as text, a line per node."""
    several = len({node.channel for node in summary.nodes()}) > 1
    lost = told.tally.lost()
    for node in summary.nodes():
        place = f"{node.channel} " if several else ""
        span = ""
        if node.first_ns is not None and node.last_ns is not None:
            span = f" in {(node.last_ns - node.first_ns) / 1e9:.3f} s"
        line = f"{place}node {shown_id(node.node)}: {node.samples} samples{span}"
        if (node.channel, node.node) in lost:
            line += f", {lost[node.channel, node.node]} lost"
        yield line
        for name, reasons in node.missing.items():
            yield f"  {name} missing: " + ", ".join(f"{count} {reason}" for reason, count in reasons.items())


def event_lines(told: Told) -> Iterator[str]:
    """Yield the events per node: EMCYs by their text, boot-ups and other changes of the NMT state."""
    counts: dict[tuple[str, int], Counter[str]] = {}
    for event in told.events():
        what = f"EMCY {event.text}" if event.kind == "emcy" else _EVENTS.get(event.kind, event.text)
        counts.setdefault((event.channel, event.node_id), Counter())[what] += 1
    for (channel, node), of_node in sorted(counts.items()):
        yield f"{channel} node {shown_id(node)}: " + "; ".join(f"{count} {what}" for what, count in of_node.items())


def lost_lines(told: Told) -> Iterator[str]:
    """Yield the nodes that lost samples."""
    for (channel, node), lost in sorted(told.tally.lost().items()):
        if lost:
            yield f"{channel} node {shown_id(node)}: {lost} lost samples"


def notes_lines(told: Told) -> Iterator[str]:
    """Yield the problems, for stderr."""
    for notes in told.notes:
        if notes.bad:
            counts = ", ".join(f"{count} {reason}" for reason, count in sorted(notes.bad.items()))
            yield f"{notes.source}: bad lines: {counts}; the first: {notes.first_bad}"
        if notes.skipped:
            counts = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in notes.skipped.items())
            yield f"{notes.source}: without samples: {counts}"
    for (channel, node, name), short in sorted(told.tally.short.items()):
        yield f"{channel} node {shown_id(node)} {name}: {short} frames too short for their mapping"


def events_path(output: str) -> Path:
    """Return the file beside an output: run.events.csv for run.csv, DIR/events.csv for DIR/."""
    path = Path(output)
    return path / "events.csv" if path.is_dir() else path.with_name(f"{path.stem}.events.csv")


def write_events(output: str, events: Sequence[BusEvent]) -> None:
    """Write the events beside an output as CSV; without events only if an earlier file of events is there.

    Raises InputError for a file of another kind, WriteError.
    """
    path = events_path(output)
    if events or path.exists():
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(EVENT_COLUMNS)
        rows.writerows(event_rows(events))
        write_file(path, text.getvalue(), _EVENTS_KIND)
