"""One table of the reproduction: records for JSON, columns for text output, and notes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Section:
    """A table with its notes. Records have the same keys; some may be missing."""

    name: str
    """Name in `tipforce design table`."""
    title: str
    columns: dict[str, str]
    """Heading per key of a record, in order; keys that are not here are for JSON only. "key.2" is an item of a list."""
    records: list[Record]
    notes: list[str] = field(default_factory=list)
    """Differences from the paper's numbers, with reasons."""
