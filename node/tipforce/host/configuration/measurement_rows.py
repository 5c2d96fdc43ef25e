"""Rows of a CSV file of measurements: a block at once where all is well, row by row with reasons where it is not."""

from __future__ import annotations

import csv
from bisect import bisect_right
from math import isfinite, nan
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray

MODES = ("push", "pull", "tare")
LARGEST_ANGLE_DEG = 720.0
LARGEST_MICROSTRAIN = 1e6


class Columns(NamedTuple):
    """What the header says."""

    names: tuple[str, ...]
    """The columns of numbers that are read, gauges first."""
    places: tuple[int, ...]
    """Where each stands in a row."""
    mode: int | None
    """Where the mode stands."""
    cells: int
    """Cells of a row."""
    ignored: tuple[str, ...]


class Block(NamedTuple):
    """Rows that can be used, and the faults of those that cannot."""

    line: IntArray
    values: FloatArray
    """(rows, names)."""
    mode: npt.NDArray[np.int8]
    faults: list[tuple[int, str]]


def read_block(lines: list[str], first_line: int, columns: Columns) -> Block:
    """Return the rows of some lines; first_line is the number of the first of them."""
    return _quick(lines, first_line, columns) or _careful(lines, first_line, columns)


def time_faults(line: IntArray, t_s: FloatArray) -> list[tuple[int, str]]:
    """Return the fewest rows whose removal leaves the times in order, with the reason.

    One clock jump is then one bad row (or one run of rows), not all that follow it.
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
    """All rows at once; None where any of them is not plainly good."""
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


def _all_good(values: FloatArray, mode: npt.NDArray[np.int8], names: tuple[str, ...]) -> bool:
    if not np.isfinite(values).all():
        return False
    gauges = sum(name.startswith("SG") for name in names)
    good = bool((np.abs(values[:, :gauges]) <= LARGEST_MICROSTRAIN).all())
    for name, column in zip(names[gauges:], values[:, gauges:].T, strict=True):
        if name == "P_N":
            good &= bool((column >= 0.0).all()) and not (column[mode == MODES.index("tare")] != 0.0).any()
        elif name in ("phi_deg", "theta_deg"):
            good &= bool((np.abs(column) <= LARGEST_ANGLE_DEG).all())
        elif name == "weight":
            good &= bool((column > 0.0).all())
    return good


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
    """(values, mode) of one line, or what is wrong with it."""
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
    """The number in a cell, or what is wrong with it."""
    if not cell and unloaded and name in ("P_N", "phi_deg", "theta_deg"):
        return 0.0
    try:
        value = float(cell) if "_" not in cell else nan
    except ValueError:
        return f"{name} is {cell!r}, not a number" if cell else f"{name} is blank"
    if not isfinite(value):
        return f"{name} is {cell!r}, allowed are finite numbers"
    if name == "P_N" and value < 0.0:
        return f"P_N is {cell}, allowed is 0 or more: turn phi_deg by 180 for the opposite force"
    if name in ("phi_deg", "theta_deg") and abs(value) > LARGEST_ANGLE_DEG:
        return f"{name} is {cell}, allowed is -{LARGEST_ANGLE_DEG:g} to {LARGEST_ANGLE_DEG:g} degrees"
    if name == "weight" and value <= 0.0:
        return f"weight is {cell}, allowed is above 0: the number of readings that the row is the mean of"
    if name.startswith("SG") and abs(value) > LARGEST_MICROSTRAIN:
        return f"{name} is {cell}, allowed is -{LARGEST_MICROSTRAIN:g} to {LARGEST_MICROSTRAIN:g} microstrain"
    return value
