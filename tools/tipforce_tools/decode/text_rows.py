"""Format tables as text lines, CSV and JSON lines."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from tipforce.host.decoding import status_words
from tipforce.host.decoding.sample_table import NO_COUNTER, Column, Table, is_missing
from tipforce_tools.decode import cells

TIME, CHANNEL, NODE, COUNTER = "t_s", "channel", "node", "counter"
_UNITS = {"degree": "deg"}
_CHUNK_ROWS = 32_768


def chunks(table: Table) -> list[Table]:
    """Split the table into pieces of bounded text size."""
    if len(table) <= _CHUNK_ROWS:
        return [table]
    starts = range(0, len(table), _CHUNK_ROWS)
    return [table.take(np.arange(start, min(start + _CHUNK_ROWS, len(table)))) for start in starts]


def channel_names(table: Table, quoted: bool = False) -> cells.Cells:
    """Return the channel of each row."""
    names = [json.dumps(name)[1:-1] if quoted else name for name in table.channels]
    return cells.word_cells(np.array([name.encode() for name in names])[table.channel])


def base_cells(table: Table, name: str) -> tuple[cells.Cells, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Return (cells, mask of missing values) of one of the columns that every table has."""
    nothing = np.zeros(len(table), dtype=np.bool_)
    if name == TIME:
        if not table.timed:
            return np.zeros((len(table), 1), dtype=np.uint8), ~nothing
        return cells.time_cells(table.t_ns), nothing
    if name == NODE:
        return cells.whole_cells(table.node.astype(np.int64)), nothing
    if name == CHANNEL:
        return channel_names(table), nothing
    missing = table.counter == NO_COUNTER
    found = cells.whole_cells(np.where(missing, 0, table.counter))
    found[missing] = 0
    return found, missing


def csv_header(base: Sequence[str], columns: Sequence[Column]) -> bytes:
    """Return the header line."""
    return ",".join([*base, *(_csv_name(column.name) for column in columns)]).encode() + b"\n"


def _csv_name(name: str) -> str:
    return f'"{name.replace(chr(34), chr(34) * 2)}"' if any(mark in name for mark in ',"\n') else name


def csv_rows(table: Table, base: Sequence[str], columns: Sequence[Column]) -> bytes:
    """Format lines with these columns; those that the table lacks are empty."""
    text = b""
    for piece in chunks(table):
        parts: list[bytes | cells.Cells] = []
        for name in base:
            parts += [base_cells(piece, name)[0], b","]
        for column in columns:
            if column.name in piece.values:
                parts.append(cells.column_cells(column, piece.values[column.name]))
            parts.append(b",")
        parts[-1] = b"\n"
        text += cells.rows_text(parts, len(piece))
    return text


def json_rows(table: Table, base: Sequence[str]) -> bytes:
    """Format JSON lines: null for missing values; keys that no row of the table has are left out."""
    text = b""
    for piece in chunks(table):
        parts: list[bytes | cells.Cells] = []
        start = b"{"
        for name in base:
            found, missing = base_cells(piece, name)
            if name == CHANNEL:
                parts += [start + b'"channel": "', channel_names(piece, quoted=True), b'"']
            else:
                parts += [start + f'"{name}": '.encode(), cells.instead(found, missing, b"null")]
            start = b", "
        for column in piece.columns:
            parts += [start + f"{json.dumps(column.name)}: ".encode(), _json_cells(column, piece)]
        parts.append(b"}\n")
        text += cells.rows_text(parts, len(piece))
    return text


def _json_cells(column: Column, table: Table) -> cells.Cells:
    values = table.values[column.name]
    missing = is_missing(column, values)
    if column.kind == "flag":
        return cells.instead(cells.chosen(values == 1, b"true", b"false"), missing, b"null")
    if column.kind == "real":
        missing = ~np.isfinite(values)
    return cells.instead(cells.column_cells(column, values), missing, b"null")


def people_rows(table: Table, base: Sequence[str]) -> bytes:
    """Format one line per sample, in columns: time, node, values with units, counter, status words."""
    text = b""
    for piece in chunks(table):
        parts: list[bytes | cells.Cells] = []
        if piece.timed:
            parts += [b"(", cells.time_cells(piece.t_ns), b")  "]
        if CHANNEL in base:
            width = max(len(name.encode()) for name in piece.channels)
            parts += [cells.right(channel_names(piece), width), b"  "]
        node = piece.node.astype(np.int64)
        hexadecimal = np.array([f"(0x{number:02X})".encode() for number in range(128)])
        parts += [b"node ", cells.right(cells.whole_cells(node), 3), b" ", cells.word_cells(hexadecimal[node])]
        for column in piece.columns:
            if column.kind != "flag":
                parts += [f"  {column.signal} ".encode(), _people_cells(column, piece), _unit(column, piece)]
        if COUNTER in base:
            counter, without = base_cells(piece, COUNTER)
            counter = np.pad(counter, ((0, 0), (1, 0)), constant_values=ord("#"))
            parts += [b"  ", cells.instead(counter, without, b"-"), b" "]
        said = np.zeros(len(piece), dtype=np.bool_)
        for column in piece.columns:
            if column.kind == "flag":
                is_set = piece.values[column.name] == 1
                words = status_words.BY_NAME.get(column.signal, column.signal).encode()
                parts += [cells.chosen(is_set & said, b", " + words), cells.chosen(is_set & ~said, b" " + words)]
                said |= is_set
        parts.append(b"\n")
        text += cells.rows_text(parts, len(piece))
    return text


def _unit(column: Column, table: Table) -> bytes | cells.Cells:
    """Return the unit after a value, blanks after an unknown one."""
    unit = f" {_UNITS.get(column.unit, column.unit)}".encode() if column.unit else b""
    missing = is_missing(column, table.values[column.name])
    return cells.chosen(missing, b" " * len(unit), unit) if unit and missing.any() else unit


def _people_cells(column: Column, table: Table) -> cells.Cells:
    values = table.values[column.name]
    width = 7 if column.kind == "real" else 3
    found = cells.column_cells(column, values)
    missing = is_missing(column, values)
    found = cells.instead(found, missing, b"unknown" if column.kind == "real" else b"-")
    absent = table.absent.get(column.name)
    if absent is not None:
        found = cells.instead(found, absent, b"-")
    return cells.right(found, width)
