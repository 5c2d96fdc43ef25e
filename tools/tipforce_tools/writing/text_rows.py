"""Format tables as text lines, CSV and JSON lines."""

import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.sample_table import Column, Table, Values, is_missing
from tipforce.host.decoding.services import NO_TIME, BusEvent
from tipforce.samples import reasons

Cells = npt.NDArray[np.uint8]
"""(k, width) characters; 0 means no character."""

_MOST = 1 << 53
_ZERO, _POINT, _MINUS = 48, 46, 45


@cache
def _four_digits() -> npt.NDArray[np.uint32]:
    """Return the text of 0000 to 9999, each as one number of four bytes."""
    n = np.arange(10_000)
    digits = np.stack([n // 1000, n // 100 % 10, n // 10 % 10, n % 10], axis=-1).astype(np.uint8) + _ZERO
    return digits.view(np.uint32)[:, 0]


def digits_of(number: npt.NDArray[Any], width: int) -> Cells:
    """Format non-negative numbers (k,) with leading zeros: (k, width)."""
    groups = -(-width // 4)
    text = np.empty((len(number), groups), dtype=np.uint32)
    left: npt.NDArray[Any] = number.astype(np.uint32 if width <= 9 else np.uint64)
    for group in range(groups - 1, 0, -1):
        above = left // 10_000
        text[:, group] = _four_digits()[left - above * 10_000]
        left = above
    text[:, 0] = _four_digits()[left]
    return text.view(np.uint8)[:, 4 * groups - width :]


def whole_cells(number: npt.NDArray[np.int64], digits: int = 0) -> Cells:
    """Format integers (k,) with the last ``digits`` after a decimal point."""
    size = np.abs(number)
    width = max(len(str(int(size.max(initial=0)))), digits + 1)
    cells = digits_of(size, width)
    out = np.zeros((len(number), 1 + width + (digits > 0)), dtype=np.uint8)
    whole = width - digits
    out[:, 1 : 1 + whole] = cells[:, :whole]
    if digits:
        out[:, 1 + whole] = _POINT
        out[:, 2 + whole :] = cells[:, whole:]
    for place in range(whole - 1):  # no leading zeros
        out[size < 10 ** (width - 1 - place), 1 + place] = 0
    negative = number < 0
    if negative.any():
        limits = np.array([10**place for place in range(1, width)], dtype=np.int64)
        length = np.searchsorted(limits, size, side="right") + 1
        first = 1 + whole - np.maximum(length - digits, 1)
        out[negative, first[negative] - 1] = _MINUS
    return out


def real_cells(values: Values, digits: int | None) -> Cells:
    """Format float64 (k,): ``digits`` decimals, or the shortest exact text (None, large numbers); "" if not finite."""
    finite = np.isfinite(values)
    if digits is not None:
        scaled = np.rint(np.where(finite, values, 0.0) * 10.0**digits)
        if np.abs(scaled).max(initial=0.0) < _MOST:
            cells = whole_cells(scaled.astype(np.int64), digits)
            cells[~finite] = 0
            return cells
    text = np.where(finite, values, 0.0).astype("S32")
    cells = text.view(np.uint8).reshape(len(values), 32).copy()
    cells[~finite] = 0
    return cells


def time_cells(t_ns: npt.NDArray[np.int64]) -> Cells:
    """Format seconds of the epoch with 6 decimals, or 9 if one of the times needs them."""
    digits = 6 if not (t_ns % 1000).any() else 9
    return whole_cells(t_ns // 10 ** (9 - digits), digits)


def word_cells(values: Values) -> Cells:
    """Byte strings."""
    width = max(values.dtype.itemsize, 1)
    return np.ascontiguousarray(values).view(np.uint8).reshape(len(values), width) if width else np.zeros((0, 1), "u1")


def instead(cells: Cells, where: npt.NDArray[np.bool_], text: bytes) -> Cells:
    """Return the cells with ``text`` in some rows."""
    if not where.any():
        return cells
    out = np.pad(cells, ((0, 0), (0, max(len(text) - cells.shape[1], 0))))
    out[where] = np.frombuffer(text.ljust(out.shape[1], b"\0"), dtype=np.uint8)
    return out


def chosen(where: npt.NDArray[np.bool_], text: bytes, otherwise: bytes = b"") -> Cells:
    """Return one text or the other for each row."""
    return word_cells(np.array([otherwise, text])[where.astype(np.intp)])


def right(cells: Cells, width: int) -> Cells:
    """Return cells of at least ``width`` characters, right-aligned."""
    used = cells != 0
    out = np.full((len(cells), max(width, cells.shape[1])), ord(" "), dtype=np.uint8)
    length = used.sum(axis=1)
    row, place = np.nonzero(used)
    column = place - (np.argmax(used, axis=1))[row] + (out.shape[1] - length)[row]
    out[row, column] = cells[row, place]
    return out


def rows_text(parts: Sequence[bytes | Cells], rows: int) -> bytes:
    """Return one text of all rows, each joined from constant texts and cells."""
    widths = [len(part) if isinstance(part, bytes) else part.shape[1] for part in parts]
    matrix = np.empty((rows, sum(widths)), dtype=np.uint8)
    at = 0
    for part, width in zip(parts, widths, strict=True):
        matrix[:, at : at + width] = np.frombuffer(part, dtype=np.uint8) if isinstance(part, bytes) else part
        at += width
    return matrix.tobytes().replace(b"\0", b"")


TIME, CHANNEL, NODE, COUNTER = BASE = tuple(
    Column(name, name, name, 0, "", 0) for name in ("t_s", "channel", "node", "counter")
)
"""The columns that every table has, each of its own kind."""
EVENT_COLUMNS = (TIME.name, CHANNEL.name, NODE.name, "event", "code", "text")
"""Names of those of ``event_rows``."""
_UNITS = {"degree": "deg"}
_CHUNK_ROWS = 32_768


def _text(table: Table, cells: Callable[[Table], Iterable[bytes | Cells]]) -> bytes:
    if len(table) <= _CHUNK_ROWS:
        return rows_text([*cells(table)], len(table))
    starts = range(0, len(table), _CHUNK_ROWS)
    return b"".join(_text(table.take(np.arange(len(table))[start : start + _CHUNK_ROWS]), cells) for start in starts)


def channel_names(table: Table, quoted: bool = False) -> Cells:
    """Return the channel of each row."""
    names = [json.dumps(name)[1:-1] if quoted else name for name in table.channels]
    return word_cells(np.array([name.encode() for name in names])[table.channel])


def column_cells(column: Column, table: Table) -> tuple[Cells, npt.NDArray[np.bool_]]:
    """Return (cells, mask of missing values) of a column; flags as 0 and 1, no characters for missing values."""
    nothing = np.zeros(len(table), dtype=np.bool_)
    if column == TIME:
        return (time_cells(table.t_ns), nothing) if table.timed else (np.zeros((len(table), 1), np.uint8), ~nothing)
    if column == NODE:
        return whole_cells(table.node.astype(np.int64)), nothing
    if column == CHANNEL:
        return channel_names(table), nothing
    values = table.counter if column == COUNTER else table.values[column.name]
    missing = is_missing(column, values)
    if column.kind == "real":
        return real_cells(values, column.digits), missing
    if column.kind == "flag":
        return np.where(missing, 0, values + ord("0")).astype(np.uint8)[:, np.newaxis], missing
    cells = whole_cells(np.where(missing, 0, values).astype(np.int64))
    cells[missing] = 0
    return cells, missing


def csv_header(columns: Sequence[Column]) -> bytes:
    """Return the header line."""
    import csv

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(column.name for column in columns)
    return text.getvalue().encode()


def csv_rows(table: Table, columns: Sequence[Column]) -> bytes:
    """Format lines with these columns; those that the table lacks are empty."""

    def cells(piece: Table) -> Iterator[bytes | Cells]:
        for number, column in enumerate(columns):
            if number:
                yield b","
            if column in BASE or column.name in piece.values:
                yield column_cells(column, piece)[0]
        yield b"\n"

    return _text(table, cells)


def json_rows(table: Table, base: Sequence[Column]) -> bytes:
    """Format JSON lines: null for missing values; keys that no row of the table has are left out."""

    def cells(piece: Table) -> Iterator[bytes | Cells]:
        for number, column in enumerate((*base, *piece.columns)):
            yield f"{', ' if number else '{'}{json.dumps(column.name)}: ".encode()
            if column == CHANNEL:
                yield from (b'"', channel_names(piece, quoted=True), b'"')
            else:
                yield _json_cells(column, piece)
        yield b"}\n"

    return _text(table, cells)


def _json_cells(column: Column, table: Table) -> Cells:
    if column.kind == "flag":
        values = table.values[column.name]
        return instead(chosen(values == 1, b"true", b"false"), is_missing(column, values), b"null")
    cells, missing = column_cells(column, table)
    return instead(cells, ~np.isfinite(table.values[column.name]) if column.kind == "real" else missing, b"null")


def people_rows(table: Table, base: Sequence[Column]) -> bytes:
    """Format one line per sample, in columns: time, node, values with units, counter, status words."""

    def cells(piece: Table) -> Iterator[bytes | Cells]:
        if piece.timed:
            yield from (b"(", time_cells(piece.t_ns), b")  ")
        if CHANNEL in base:
            yield right(channel_names(piece), max(len(name.encode()) for name in piece.channels))
            yield b"  "
        node = piece.node.astype(np.int64)
        hexadecimal = np.array([f"(0x{number:02X})".encode() for number in range(128)])
        yield from (b"node ", right(whole_cells(node), 3), b" ", word_cells(hexadecimal[node]))
        for column in piece.columns:
            if column.kind != "flag":
                yield from (f"  {column.signal} ".encode(), _people_cells(column, piece), _unit(column, piece))
        if COUNTER in base:
            counter, without = column_cells(COUNTER, piece)
            counter = np.pad(counter, ((0, 0), (1, 0)), constant_values=ord("#"))
            yield from (b"  ", instead(counter, without, b"-"), b" ")
        said = np.zeros(len(piece), dtype=np.bool_)
        for column in piece.columns:
            if column.kind == "flag":
                is_set = piece.values[column.name] == 1
                words = reasons.BY_NAME.get(column.signal, column.signal).encode()
                yield from (chosen(is_set & said, b", " + words), chosen(is_set & ~said, b" " + words))
                said |= is_set
        yield b"\n"

    return _text(table, cells)


def _unit(column: Column, table: Table) -> bytes | Cells:
    unit = f" {_UNITS.get(column.unit, column.unit)}".encode() if column.unit else b""
    missing = is_missing(column, table.values[column.name])
    return chosen(missing, b" " * len(unit), unit) if unit and missing.any() else unit


def _people_cells(column: Column, table: Table) -> Cells:
    is_real, absent = column.kind == "real", table.absent.get(column.name)
    cells = instead(*column_cells(column, table), b"unknown" if is_real else b"-")
    return right(cells if absent is None else instead(cells, absent, b"-"), 7 if is_real else 3)


def event_rows(events: Sequence[BusEvent]) -> Iterator[tuple[str, str, int, str, str, str]]:
    """Yield the cells of each event."""
    for event in events:
        t_s = "" if event.t_ns == NO_TIME else f"{event.t_ns // 1_000_000_000}.{event.t_ns % 1_000_000_000:09d}"
        yield t_s, event.channel, event.node_id, event.kind, f"0x{event.code:04X}", event.text
