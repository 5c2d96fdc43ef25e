"""Format columns as text, many rows at a time: each column is a matrix of characters, unused ones removed at the end.

Numbers are rounded to their digits, 4.400 for three; values at that resolution are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.sample_table import Column, Values, is_missing

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
        first = 1 + whole - np.maximum(_length(size, width) - digits, 1)
        out[negative, first[negative] - 1] = _MINUS
    return out


def _length(size: npt.NDArray[np.int64], width: int) -> npt.NDArray[np.intp]:
    limits = np.array([10**place for place in range(1, width)], dtype=np.int64)
    return np.searchsorted(limits, size, side="right") + 1


def real_cells(values: Values, digits: int | None) -> Cells:
    """Format float64 (k,) with ``digits`` decimals; None, or for numbers that are too large: shortest exact text.

    Non-finite numbers give no characters.
    """
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


def column_cells(column: Column, values: Values) -> Cells:
    """Format the values of a column; flags as 0 and 1, no characters for missing values."""
    if column.kind == "real":
        return real_cells(values, column.digits)
    if column.kind == "word":
        return word_cells(values)
    cells = whole_cells(np.where(is_missing(column, values), 0, values).astype(np.int64))
    cells[is_missing(column, values)] = 0
    return cells


def word_cells(values: Values) -> Cells:
    """Byte strings."""
    width = max(values.dtype.itemsize, 1)
    return np.ascontiguousarray(values).view(np.uint8).reshape(len(values), width) if width else np.zeros((0, 1), "u1")


def instead(cells: Cells, where: npt.NDArray[np.bool_], text: bytes) -> Cells:
    """Return the cells with ``text`` in some rows."""
    if not where.any():
        return cells
    missing = max(len(text) - cells.shape[1], 0)
    out = np.pad(cells, ((0, 0), (0, missing)))
    out[where] = 0
    out[where, : len(text)] = np.frombuffer(text, dtype=np.uint8)
    return out


def chosen(where: npt.NDArray[np.bool_], text: bytes, otherwise: bytes = b"") -> Cells:
    """Return one text or the other for each row."""
    width = max(len(text), len(otherwise), 1)
    pair = np.zeros((2, width), dtype=np.uint8)
    pair[0, : len(otherwise)] = np.frombuffer(otherwise, dtype=np.uint8)
    pair[1, : len(text)] = np.frombuffer(text, dtype=np.uint8)
    found: Cells = pair[where.astype(np.intp)]
    return found


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
