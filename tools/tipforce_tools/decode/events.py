"""The events of a recording beside its samples: EMCYs, changes of NMT states and of calibrations, as CSV."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.output_file import Kind, write_file

if TYPE_CHECKING:
    from tipforce.host.decoding.services import BusEvent

COLUMNS = ("t_s", "channel", "node", "event", "code", "text")
_KIND = Kind("a file of events of `tipforce decode`", rb"\A" + ",".join(COLUMNS).encode() + rb"\n")


def events_path(output: str) -> Path:
    """Return the file beside an output: run.events.csv for run.csv, DIR/events.csv for DIR/."""
    path = Path(output)
    return path / "events.csv" if path.is_dir() else path.with_name(f"{path.stem}.events.csv")


def write_events(output: str, events: Sequence[BusEvent]) -> None:
    """Write the events beside an output; without events only if an earlier file of events is there.

    Raises InputError for a file of another kind, WriteError.
    """
    path = events_path(output)
    if events or path.exists():
        write_file(path, events_text(events), _KIND)


def events_text(events: Sequence[BusEvent]) -> str:
    """Return the events as CSV."""
    import csv

    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    rows.writerows(event_rows(events))
    return text.getvalue()


def event_rows(events: Sequence[BusEvent]) -> Iterator[tuple[str, str, int, str, str, str]]:
    """Yield the cells of each event."""
    for event in events:
        t_s = f"{event.t_ns // 1_000_000_000}.{event.t_ns % 1_000_000_000:09d}"
        yield t_s, event.channel, event.node_id, event.kind, f"0x{event.code:04X}", event.text
