"""What a recording holds: per node samples, lost ones, missing values with reasons, and times; events as CSV."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.recording import Recording
from tipforce.host.decoding.sample_table import Column, Table, place_of
from tipforce.host.decoding.services import NO_TIME, BusEvent
from tipforce.output_file import Kind, write_file
from tipforce.samples.reasons import CAUSES
from tipforce_tools.cli.common import shown_id
from tipforce_tools.writing.text_rows import EVENT_COLUMNS, event_rows

_EVENTS_KIND = Kind("a file of events of `tipforce decode`", rb"\A" + ",".join(EVENT_COLUMNS).encode() + rb"\n")
NO_FRAME, UNKNOWN = "no_frame", "unknown"
_EVENTS = {"emcy_reset": "EMCY no error", "boot_up": "boot-up", "state": "NMT state", "calibration": "calibration"}
_ORDER = (*CAUSES, UNKNOWN)
_FIRST = np.array([f"{1 << len(CAUSES) | bits:b}"[::-1].index("1") for bits in range(1 << len(CAUSES))])
"""The place in ``_ORDER`` of the first one of bits."""


Place = tuple[str, int]
"""Channel and node-id."""


class Summary:
    """Statistics of tables that pass through."""

    def __init__(self, reasons: bool = True) -> None:
        """``reasons``: count the missing values by their reasons."""
        self._reasons = reasons
        self.samples = Counter[Place]()
        self.spans_ns: dict[Place, tuple[int, int]] = {}
        """First and last time, of a log with times."""
        self._present = Counter[tuple[Place, str]]()  # by column: samples with a frame that carries it
        self._told = Counter[tuple[Place, str, str]]()  # by column and reason: samples whose frame has no value
        self._places: dict[int, Place] = {}  # by key of the tables
        self._not_told: dict[str, npt.NDArray[np.intp]] = {}  # by column, key and reason: those not in ``_told`` yet

    def passing(self, tables: Iterable[Table]) -> Iterator[Table]:
        """Count the tables, and return the same ones."""
        for table in tables:
            self._add(table)
            yield table

    def append(self, other: Summary) -> None:
        """Add the statistics of other tables."""
        self.samples.update(other.samples)
        self._present.update(other._present)
        self._told.update(other._all_told())
        for place, span in other.spans_ns.items():
            self._widen(place, *span)

    def _widen(self, place: Place, first_ns: int, last_ns: int) -> None:
        before = self.spans_ns.get(place, (first_ns, last_ns))
        self.spans_ns[place] = min(before[0], first_ns), max(before[1], last_ns)

    def _add(self, table: Table) -> None:
        order = np.argsort(table.key, kind="stable")
        sorted_key, t_ns = table.key[order], table.t_ns[order]
        starts = np.flatnonzero(np.append(True, sorted_key[1:] != sorted_key[:-1]))
        counts = np.diff(np.append(starts, len(table)))
        places = {key: place_of(table.channels, key) for key in sorted_key[starts].tolist()}
        self._places |= places
        spans = zip(np.minimum.reduceat(t_ns, starts).tolist(), np.maximum.reduceat(t_ns, starts).tolist(), strict=True)
        for place, count, span in zip(places.values(), counts.tolist(), spans, strict=True):
            self.samples[place] += count
            if table.timed:
                self._widen(place, *span)
        if not self._reasons:
            return
        causes = np.zeros(len(table), dtype=np.uint16)  # a bit for each
        for number, (name, is_set, _) in enumerate(CAUSES.values()):
            if name in table.values:
                causes |= (table.values[name] == is_set).astype(np.uint16) << np.uint16(number)
        for column in table.columns:
            if column.kind == "real":
                absent = table.absent.get(column.name)
                there = counts if absent is None else np.add.reduceat(~absent[order], starts, dtype=np.int64)
                for place, present in zip(places.values(), there.tolist(), strict=True):
                    self._present[place, column.name] += present
                self._add_missing(column, table, causes)

    def _add_missing(self, column: Column, table: Table, causes: npt.NDArray[np.uint16]) -> None:
        rows = np.flatnonzero(np.isnan(table.values[column.name]))
        absent = table.absent.get(column.name)
        if absent is not None:
            rows = rows[~absent[rows]]
        of_signal = [signals is None or column.signal in signals for _, _, signals in CAUSES.values()]
        reason = _FIRST[causes[rows] & sum(1 << number for number, counts in enumerate(of_signal) if counts)]
        before = self._not_told.get(column.name, np.zeros(0, dtype=np.intp))
        counts = np.bincount(table.key[rows].astype(np.intp) * len(_ORDER) + reason, minlength=len(before))
        counts[: len(before)] += before
        self._not_told[column.name] = counts

    def _all_told(self) -> Counter[tuple[Place, str, str]]:
        for name, counts in self._not_told.items():
            for cell in np.flatnonzero(counts).tolist():
                key, number = divmod(cell, len(_ORDER))
                self._told[self._places[key], name, _ORDER[number]] += int(counts[cell])
        self._not_told.clear()
        return self._told

    def missing(self, place: Place) -> dict[str, dict[str, int]]:
        """Return by column and reason the number of samples without a value; columns never sent are left out."""
        found, all_told = {}, self._all_told()
        for name in (name for (of, name), present in self._present.items() if of == place and present):
            told = {reason: all_told[place, name, reason] for reason in _ORDER}
            told[NO_FRAME] = self.samples[place] - self._present[place, name]
            if any(told.values()):
                found[name] = {reason: count for reason, count in told.items() if count}
        return found


def bad_lines(recording: Recording) -> dict[str, int]:
    """Return the bad lines of all logs by reason."""
    return sum((Counter(notes.bad) for notes in recording.notes), Counter())


def record(summary: Summary, recording: Recording, output: str | None) -> dict[str, Any]:
    """Return the whole summary as a JSON record."""
    return {
        "output": output,
        "logs": [notes.source for notes in recording.notes],
        "frames": sum(notes.frames for notes in recording.notes),
        "samples": summary.samples.total(),
        "lost": sum(recording.tally.lost().values()),
        "bad": bad_lines(recording),
        "skipped": sum((Counter(notes.skipped) for notes in recording.notes), Counter()),
        "events": [
            dict(zip(EVENT_COLUMNS, (None if of.t_ns == NO_TIME else of.t_ns / 1e9, *of[1:]), strict=True))
            for of in recording.bus.found
        ],
        "nodes": [_node_record(summary, recording, place) for place in sorted(summary.samples)],
    }


def _node_record(summary: Summary, recording: Recording, place: Place) -> dict[str, Any]:
    first_s, last_s = (t_ns / 1_000_000_000 for t_ns in span) if (span := summary.spans_ns.get(place)) else (None, None)
    messages = {name: count for (*of, name), count in recording.tally.messages.items() if tuple(of) == place}
    return {
        "channel": place[0],
        "node": place[1],
        "samples": summary.samples[place],
        "lost": recording.tally.lost().get(place),
        "first_s": first_s,
        "last_s": last_s,
        "missing": summary.missing(place),
        "messages": {
            name: {"frames": count.frames, **({} if count.lost is None else {"lost": count.lost})}
            for name, count in messages.items()
        },
        "short": {name: short for (*of, name), short in recording.tally.short.items() if tuple(of) == place},
    }


def lines(summary: Summary, recording: Recording) -> Iterator[str]:
    """Yield the summary as text, a line per node."""
    several = len({channel for channel, _ in summary.samples}) > 1
    lost = recording.tally.lost()
    for place, samples in sorted(summary.samples.items()):
        span = summary.spans_ns.get(place)
        duration = "" if span is None else f" in {(span[1] - span[0]) / 1e9:.3f} s"
        losses = f", {lost[place]} lost" if place in lost else ""
        yield f"{f'{place[0]} ' * several}node {shown_id(place[1])}: {samples} samples{duration}{losses}"
        for name, reasons in summary.missing(place).items():
            yield f"  {name} missing: " + ", ".join(f"{count} {reason}" for reason, count in reasons.items())


def event_lines(recording: Recording) -> Iterator[str]:
    """Yield the events per node: EMCYs by their text, boot-ups and other changes of the NMT state."""
    counts: dict[Place, Counter[str]] = {}
    for event in recording.bus.found:
        what = f"EMCY {event.text}" if event.kind == "emcy" else _EVENTS.get(event.kind, event.text)
        counts.setdefault((event.channel, event.node_id), Counter())[what] += 1
    for (channel, node), of_node in sorted(counts.items()):
        yield f"{channel} node {shown_id(node)}: " + "; ".join(f"{count} {what}" for what, count in of_node.items())


def lost_lines(recording: Recording) -> Iterator[str]:
    """Yield the nodes that lost samples."""
    for (channel, node), lost in sorted(recording.tally.lost().items()):
        if lost:
            yield f"{channel} node {shown_id(node)}: {lost} lost samples"


def notes_lines(recording: Recording) -> Iterator[str]:
    """Yield the problems, for stderr."""
    for notes in recording.notes:
        if notes.bad:
            counts = ", ".join(f"{count} {reason}" for reason, count in sorted(notes.bad.items()))
            first = "" if notes.first_bad is None else f"; the first: {notes.first_bad}"  # a dataset has counts alone
            yield f"{notes.source}: bad lines: {counts}{first}"
        if notes.skipped:
            counts = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in notes.skipped.items())
            yield f"{notes.source}: without samples: {counts}"
    for (channel, node, name), short in sorted(recording.tally.short.items()):
        yield f"{channel} node {shown_id(node)} {name}: {short} frames too short for their mapping"


def events_path(output: str) -> Path:
    """Return the file beside an output: run.events.csv for run.csv, DIR/events.csv for DIR/."""
    path = Path(output)
    return path / "events.csv" if path.is_dir() else path.with_name(f"{path.stem}.events.csv")


def write_events(output: str, events: Sequence[BusEvent]) -> None:
    """Write the events beside an output as CSV; without events only if an earlier file of events is there. Raises
    InputError for a file of another kind, WriteError."""
    path = events_path(output)
    if events or path.exists():
        import csv

        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(EVENT_COLUMNS)
        rows.writerows(event_rows(events))
        write_file(path, text.getvalue(), _EVENTS_KIND)
