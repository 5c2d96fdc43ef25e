"""Parse rows of a measurement CSV: a block at once if all rows are valid, otherwise row by row with reasons."""

from __future__ import annotations

import csv
from bisect import bisect_right
from math import isfinite, nan
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray

MODES = ("push", "pull", "tare")
LEAST_LOAD_NEWTONS, MOST_LOAD_NEWTONS = 1e-9, 1e9
LARGEST_ANGLE_DEG = 720.0
LARGEST_MICROSTRAIN = 1e6
_ANGLE = (-LARGEST_ANGLE_DEG, LARGEST_ANGLE_DEG, "degrees")
_LIMITS = {
    "P_N": (0.0, MOST_LOAD_NEWTONS, "N: turn phi_deg by 180 for the opposite force"),
    "phi_deg": _ANGLE,
    "theta_deg": _ANGLE,
    "temperature_degC": (-273.15, 1000.0, "degrees Celsius"),
    "weight": (1e-9, 1e9, "readings that the row is the mean of"),
    "t_s": (-1e18, 1e18, "s"),
}
"""Least and largest value of a column, and the unit for messages; the columns of gauges are in microstrain."""


class Columns(NamedTuple):
    """The columns in the header."""

    names: tuple[str, ...]
    """The numeric columns that are read, gauges first."""
    places: tuple[int, ...]
    """The position of each in a row."""
    mode: int | None
    """The position of the mode."""
    cells: int
    """Number of cells of a row."""
    ignored: tuple[str, ...]


class Block(NamedTuple):
    """Valid rows, and the faults of the others."""

    line: IntArray
    values: FloatArray
    """(rows, names)."""
    mode: npt.NDArray[np.int8]
    faults: list[tuple[int, str]]


def read_block(lines: list[str], first_line: int, columns: Columns) -> Block:
    """Return the rows of some lines; first_line is the number of the first."""
    return _quick(lines, first_line, columns) or _careful(lines, first_line, columns)


def time_faults(line: IntArray, t_s: FloatArray) -> list[tuple[int, str]]:
    """Return the fewest rows whose removal leaves the times in order, with the reason.

    One clock jump is then one bad row (or one run of rows), not all following rows.
    """
    if not (np.diff(t_s) < 0.0).any():
        return []
    times = t_s.tolist()
    ends: list[float] = []
    end_rows: list[int] = []
    before = [-1] * len(times)
    for row, t in enumerate(times):
        place = bisect_right(ends, t)
        before[row] = end_rows[place - 1] if place else -1
        ends[place : place + 1] = [t]
        end_rows[place : place + 1] = [row]
    kept, row = set(), end_rows[-1]
    while row >= 0:
        kept.add(row)
        row = before[row]
    faults, last, after = [], None, None
    followers = sorted(kept)
    for row, t in enumerate(times):
        if row in kept:
            last = row
            continue
        place = bisect_right(followers, row)
        after = followers[place] if place < len(followers) else None
        if last is not None and t < times[last]:
            reason = f"t_s is {t:g}, before the {times[last]:g} of line {line[last]}"
        else:
            reason = f"t_s is {t:g}, after the {times[after]:g} of line {line[after]}" if after is not None else "t_s"
        faults.append((int(line[row]), reason + ": times must not decrease"))
    return faults


def _quick(lines: list[str], first_line: int, columns: Columns) -> Block | None:
    """Return all rows at once; None if any of them may be invalid."""
    separators = columns.cells - 1
    if any(text.count(",") != separators or '"' in text or "_" in text for text in lines):
        return None
    try:
        values = np.loadtxt(lines, delimiter=",", usecols=columns.places, comments=None, ndmin=2)
    except ValueError:
        return None
    mode = np.full(len(lines), -1, dtype=np.int8)
    if columns.mode is not None:
        codes = {name: code for code, name in enumerate(MODES)} | {"": -1}
        found = [codes.get(text.split(",")[columns.mode].strip()) for text in lines]
        if None in found:
            return None
        mode = np.array(found, dtype=np.int8)
    if values.shape[0] != len(lines) or not _all_good(values, mode, columns.names):
        return None
    return Block(first_line + np.arange(len(lines)), values, mode, [])


def _limits(name: str) -> tuple[float, float, str]:
    return _LIMITS.get(name, (-LARGEST_MICROSTRAIN, LARGEST_MICROSTRAIN, "microstrain"))


def _all_good(values: FloatArray, mode: npt.NDArray[np.int8], names: tuple[str, ...]) -> bool:
    low, high = np.array([_limits(name)[:2] for name in names]).T
    if not ((values >= low) & (values <= high)).all():
        return False
    if "P_N" not in names:
        return True
    P = values[:, names.index("P_N")]
    return not ((P > 0.0) & ((P < LEAST_LOAD_NEWTONS) | (mode == MODES.index("tare")))).any()


def _careful(lines: list[str], first_line: int, columns: Columns) -> Block:
    line, values, modes, faults = [], [], [], []
    for number, text in enumerate(lines, first_line):
        row = _row(text, columns)
        if isinstance(row, str):
            faults.append((number, row))
        else:
            line.append(number)
            values.append(row[0])
            modes.append(row[1])
    return Block(
        np.array(line, dtype=np.int64),
        np.array(values, dtype=np.float64).reshape(len(values), len(columns.names)),
        np.array(modes, dtype=np.int8),
        faults,
    )


def _row(text: str, columns: Columns) -> tuple[list[float], int] | str:
    """Return (values, mode) of one line, or its fault."""
    if not text.strip():
        return "the line is empty"
    try:
        cells = [cell.strip() for cell in next(csv.reader([text], strict=True))]
    except csv.Error as error:
        return f"the quotes do not match ({error})"
    if len(cells) != columns.cells:
        return f"{len(cells)} cells, the header has {columns.cells}"
    word = "" if columns.mode is None else cells[columns.mode]
    if word and word not in MODES:
        return f"mode is {word!r}, allowed: {', '.join(MODES)} or blank"
    row: dict[str, float] = {}
    for name, place in zip(columns.names, columns.places, strict=True):
        value = _value(name, cells[place], word == "tare" or row.get("P_N") == 0.0)
        if isinstance(value, str):
            return value
        row[name] = value
    if word == "tare" and row.get("P_N", 0.0) != 0.0:
        return f"mode is tare, an unloaded reading, but P_N is {row['P_N']:g}"
    return list(row.values()), MODES.index(word) if word else -1


def _value(name: str, cell: str, unloaded: bool) -> float | str:
    """Return the number in a cell, or its fault."""
    if not cell and unloaded and name in ("P_N", "phi_deg", "theta_deg"):
        return 0.0
    try:
        value = float(cell) if "_" not in cell else nan
    except ValueError:
        return f"{name} is {cell!r}, not a number" if cell else f"{name} is blank"
    if not isfinite(value):
        return f"{name} is {cell!r}, allowed are finite numbers"
    low, high, unit = _limits(name)
    if not low <= value <= high:
        return f"{name} is {cell}, allowed is {low:g} to {high:g} {unit}"
    if name == "P_N" and 0.0 < value < LEAST_LOAD_NEWTONS:
        return f"P_N is {cell}, allowed is 0 (unloaded), or {LEAST_LOAD_NEWTONS:g} N and more"
    return value
