"""One table of the reproduction: records for JSON, columns for text output, and notes."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from typing import Any

from tipforce_tools.cli import common

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


def print_section(args: argparse.Namespace, section: Section) -> None:
    """Print as JSON lines (records, then one line with the notes), or as a table."""
    if args.json:
        for record in section.records:
            common.print_json({"table": section.name, **record})
        if section.notes:
            common.print_json({"table": section.name, "notes": section.notes})
        return
    from rich import box
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    table = Table(title=section.title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for key, heading in section.columns.items():
        numeric = all(isinstance(_cell(record, key), (int, float, type(None))) for record in section.records)
        table.add_column(heading, justify="right" if numeric else "left", overflow="fold")
    for record in section.records:
        table.add_row(*(shown(_cell(record, key)) for key in section.columns))
    common.print_table(args, table)
    console = common.console(args)
    for note in section.notes:
        console.print(Padding(Text(note), (0, 0, 1, 2)), highlight=False)


def _cell(record: Record, key: str) -> Any:
    name, _, index = key.partition(".")
    return record[name][int(index)] if index else record.get(name)


def shown(value: object) -> str:
    """Format a cell: four significant digits, lists joined, empty for None."""
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return " ".join(shown(item) for item in value)
    if isinstance(value, float):
        if math.isnan(value):
            return "any"
        return f"{value + 0.0:.4g}" if abs(value) >= 1e-12 else "0"
    return str(value)
