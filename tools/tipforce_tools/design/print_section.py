"""Print a table of `tipforce design`: as JSON lines, or as text."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce_lab.design.tables import Record, Section


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
