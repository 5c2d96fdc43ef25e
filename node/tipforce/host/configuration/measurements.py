"""Read and write measurements as CSV: gauge readings with loads, times and modes; bad rows by line and reason.

A block of lines is parsed at once if all its rows are valid, otherwise row by row with reasons.
"""

from __future__ import annotations

import codecs
import csv
import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce.errors import InputError
from tipforce.output_file import CSV, write_file

MODES = ("push", "pull", "tare")
LEAST_LOAD_NEWTONS, MOST_LOAD_NEWTONS = 1e-9, 1e9
LARGEST_ANGLE_DEG = 720.0
LARGEST_MICROSTRAIN = 1e6
_SHOWN = 5  # nodes in a message
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
        mode_codes = [codes.get(text.split(",")[columns.mode].strip()) for text in lines]
        if None in mode_codes:
            return None
        mode = np.array(mode_codes, dtype=np.int8)
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


MIN_GAUGES, MAX_GAUGES = 3, 8
LOAD_COLUMNS = ("P_N", "phi_deg", "theta_deg")
OPTIONAL_COLUMNS = ("t_s", "temperature_degC", "weight")
BLOCK_LINES = 50_000


class BadRow(NamedTuple):
    """A line that cannot be used, and the reason."""

    line: int
    """Line number in the file; the header is line 1."""
    reason: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """The m good rows of a file, and the bad ones; columns that the file lacks are None."""

    line: IntArray
    """(m,): line number of each row."""
    strain: FloatArray
    """(m, n): gauge strain (not microstrain)."""
    P_newtons: FloatArray | None
    """(m,); 0 for an unloaded reading. The angles of such a row may be blank in the file and are 0 here."""
    phi_rad: FloatArray | None
    theta_rad: FloatArray | None
    t_s: FloatArray | None
    temperature_degC: FloatArray | None
    weight: FloatArray | None
    mode: npt.NDArray[np.int8] | None
    """(m,): index into MODES, or -1 where the cell is blank."""
    bad: tuple[BadRow, ...]
    """In the order of the file."""
    ignored_columns: tuple[str, ...]
    """Columns of the file that are ignored."""

    @property
    def unloaded(self) -> npt.NDArray[np.bool_]:
        """Which rows are unloaded readings: mode tare, or P_N = 0; (m,)."""
        is_unloaded = np.zeros(len(self.line), dtype=np.bool_)
        if self.mode is not None:
            is_unloaded |= self.mode == MODES.index("tare")
        if self.P_newtons is not None:
            is_unloaded |= self.P_newtons == 0.0
        return is_unloaded


def read_measurements(path: str | Path, *, loads: bool) -> Measurements:
    """Read a CSV file of measurements; loads: the columns P_N, phi_deg, theta_deg are required.

    Gauge columns SG1..SGn, SG1_ue.. (of a decoded log) or e1_ue.. in microstrain, n = 3 to 8; optional t_s,
    temperature_degC, weight, mode (push, pull, tare). A row that cannot be used is in ``bad`` with its line and
    reason. Raises InputError if the whole file cannot be used: not readable, empty, not UTF-8, a header with a
    missing or duplicate column, a decoded log with estimates beside the gauges, or one of several nodes.
    """
    lines = _lines(path)
    columns = _header(path, lines[0], loads)
    if not any(line.strip() for line in lines[1:]):
        raise InputError(f"{path}: line 1 is a header without rows")
    _require_one_node(path, lines)
    blocks = [
        read_block(lines[start : start + BLOCK_LINES], start + 1, columns)
        for start in range(1, len(lines), BLOCK_LINES)
    ]
    line = np.concatenate([block.line for block in blocks])
    values = np.concatenate([block.values for block in blocks])
    mode = np.concatenate([block.mode for block in blocks])
    bad = [BadRow(*fault) for block in blocks for fault in block.faults]
    if "t_s" in columns.names:
        late = time_faults(line, values[:, columns.names.index("t_s")])
        bad = sorted([*bad, *(BadRow(*fault) for fault in late)])
        good = ~np.isin(line, [fault[0] for fault in late])
        line, values, mode = line[good], values[good], mode[good]
    values_of = {name: values[:, k] for k, name in enumerate(columns.names)}
    gauges = [column for name, column in values_of.items() if name.startswith("SG")]
    angles = [np.radians(values_of[name]) if name in values_of else None for name in LOAD_COLUMNS[1:]]
    return Measurements(
        line=line,
        strain=np.stack(gauges, axis=-1) * 1e-6,
        P_newtons=values_of.get("P_N"),
        phi_rad=angles[0],
        theta_rad=angles[1],
        t_s=values_of.get("t_s"),
        temperature_degC=values_of.get("temperature_degC"),
        weight=values_of.get("weight"),
        mode=None if columns.mode is None else mode,
        bad=tuple(bad),
        ignored_columns=columns.ignored,
    )


def write_measurements(path: str | Path, measurements: Measurements) -> None:
    """Write rows with full precision: they read back unchanged. Raises InputError for an unusable path, WriteError."""
    n = measurements.strain.shape[1]
    arrays: dict[str, FloatArray | None] = {"t_s": measurements.t_s}
    arrays |= {f"SG{k + 1}": measurements.strain[:, k] * 1e6 for k in range(n)}
    P = measurements.P_newtons
    if P is not None:
        phi, theta = (0.0 * P if angle is None else angle for angle in (measurements.phi_rad, measurements.theta_rad))
        arrays |= {"P_N": P, "phi_deg": np.degrees(phi), "theta_deg": np.degrees(theta)}
    arrays |= {"temperature_degC": measurements.temperature_degC, "weight": measurements.weight}
    columns: dict[str, Sequence[object]] = {
        name: column.tolist() for name, column in arrays.items() if column is not None
    }
    if measurements.mode is not None:
        columns["mode"] = ["" if code < 0 else MODES[code] for code in measurements.mode]
    rows = (",".join(str(value) for value in row) for row in zip(*columns.values(), strict=True))
    write_file(path, "\n".join([",".join(columns), *rows, ""]), CSV)


def _lines(path: str | Path) -> list[str]:
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{path}: the text is UTF-16; save it as UTF-8")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}: line {line}: byte 0x{content[error.start]:02X} is not UTF-8; save the file as UTF-8"
        ) from None
    if "\0" in text:
        raise InputError(
            f"{path}: line {text.count(chr(10), 0, text.index(chr(0))) + 1}: a NUL byte; the file is not a text file"
        )
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise InputError(f"{path}: the file is empty; it needs a header such as SG1,SG2,SG3,P_N,phi_deg,theta_deg")
    return lines


def _require_one_node(path: str | Path, lines: list[str]) -> None:
    """Raise InputError if the columns of a decoded log name more than one node (or node and channel)."""
    rows = csv.reader(lines)
    header = [name.strip() for name in next(rows)]
    places = [header.index(name) for name in ("channel", "node") if name in header]
    if not places:
        return
    senders = {" ".join(row[k].strip() for k in places) for row in rows if len(row) == len(header)}
    nodes = sorted(senders, key=lambda text: (len(text), text))
    if len(nodes) > 1:
        shown = ", ".join(nodes[:_SHOWN]) + (", ..." if len(nodes) > _SHOWN else "")
        raise InputError(
            f"{path}: readings of {len(nodes)} nodes ({shown}), but a calibration is of one; write one file per node: "
            f"`tipforce decode LOG --nodes {nodes[0].split(' ')[-1]} --signals SG1,SG2,SG3 -o FILE.csv`, or "
            "estimate with `tipforce decode LOG --calibration NODE=CAL.toml` (repeat the option for each node)"
        )


def _header(path: str | Path, text: str, loads: bool) -> Columns:
    names = [name.strip().strip('"').strip() for name in text.split(",")]
    if len(names) == 1 and (";" in text or "\t" in text):
        raise InputError(f"{path}: line 1: separate columns by commas (and write decimals with a point)")
    plain = [re.sub(r"(?:e|SG)(\d+)_ue", r"SG\1", name) for name in names]
    decoded = [name for name in names if re.fullmatch(r"SG\d+_ue", name)]
    if decoded and "P_N" in plain:
        raise InputError(
            f"{path}: line 1: {decoded[0]} beside P_N: this is a decoded log, whose P_N is the node's estimate, not a "
            "load; write `tipforce decode LOG --nodes ID --signals SG1,SG2,SG3 -o FILE.csv`, or let `decode "
            "--calibration CAL.toml` estimate"
        )
    twice = sorted({name for name in plain if name and plain.count(name) > 1})
    if twice:
        raise InputError(f"{path}: line 1: the column {', '.join(twice)} occurs more than once")
    gauges = [name for name in plain if name.startswith("SG") and not name.endswith("_fault")]
    expected = [f"SG{k + 1}" for k in range(len(gauges))]
    if sorted(gauges) != sorted(expected) or not MIN_GAUGES <= len(gauges) <= MAX_GAUGES:
        raise InputError(
            f"{path}: line 1: gauge columns {', '.join(gauges) or 'are missing'}: allowed are SG1 to SGn without a "
            f"gap, n = {MIN_GAUGES} to {MAX_GAUGES} (or e1_ue to en_ue)"
        )
    has_load = [name for name in LOAD_COLUMNS if name in plain]
    missing = [name for name in LOAD_COLUMNS if name not in plain]
    if missing and (loads or (has_load and has_load != ["P_N"])):
        raise InputError(f"{path}: line 1: the column {', '.join(missing)} is missing; present: {', '.join(names)}")
    known = [*expected, *has_load, *(name for name in OPTIONAL_COLUMNS if name in plain)]
    mode = plain.index("mode") if "mode" in plain else None
    ignored = tuple(name for name, key in zip(names, plain, strict=True) if key not in known and key != "mode")
    return Columns(tuple(known), tuple(plain.index(name) for name in known), mode, len(names), ignored)
