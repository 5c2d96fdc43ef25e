"""Read measurements as CSV: gauge readings with loads, times and modes; bad rows by line and reason."""

import codecs
import csv
import re
from bisect import bisect_right
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce.dictionary.table import MAX_GAUGES, MIN_GAUGES
from tipforce.errors import InputError

MODES = ("push", "pull", "tare")
LEAST_LOAD_NEWTONS, MOST_LOAD_NEWTONS = 1e-9, 1e9
LARGEST_ANGLE_DEG = 720.0
LARGEST_MICROSTRAIN = 1e6
_SHOWN = 5  # nodes in a message
_ANGLE = (-LARGEST_ANGLE_DEG, LARGEST_ANGLE_DEG, "degrees")
_GAUGE = (-LARGEST_MICROSTRAIN, LARGEST_MICROSTRAIN, "microstrain")
_LIMITS = {
    "P_N": (0.0, MOST_LOAD_NEWTONS, "N: turn phi_deg by 180 for the opposite force"),
    "phi_deg": _ANGLE,
    "theta_deg": _ANGLE,
    "temperature_degC": (-273.15, 1000.0, "degrees Celsius"),
    "weight": (1e-9, 1e9, "readings that the row is the mean of"),
    "t_s": (-1e18, 1e18, "s"),
}
"""Least and largest value of a column, and the unit for messages; the columns of gauges are in microstrain."""


LOAD_COLUMNS = ("P_N", "phi_deg", "theta_deg")


class BadRow(NamedTuple):
    """A line that cannot be used, and the reason."""

    line: int
    """Line number in the file; the header is line 1."""
    reason: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.reason}"


def _row(text: str, places: dict[str, int], mode: int | None, count: int) -> tuple[list[float], int]:
    if not text.strip():
        raise InputError("the line is empty")
    try:
        cells = next(csv.reader([text], strict=True)) if '"' in text else text.split(",")
    except csv.Error as error:
        raise InputError(f"the quotes do not match ({error})") from None
    if len(cells) != count:
        raise InputError(f"{len(cells)} cells, the header has {count}")
    word = "" if mode is None else cells[mode].strip()
    if word and word not in MODES:
        raise InputError(f"mode is {word!r}, allowed: {', '.join(MODES)} or blank")
    row: dict[str, float] = {}
    for name, place in places.items():
        row[name] = _value(name, cells[place].strip(), word == "tare" or row.get("P_N") == 0.0)
    if word == "tare" and row.get("P_N", 0.0) != 0.0:
        raise InputError(f"mode is tare, an unloaded reading, but P_N is {row['P_N']:g}")
    return list(row.values()), MODES.index(word) if word else -1


def _value(name: str, cell: str, unloaded: bool) -> float:
    if not cell and unloaded and name in LOAD_COLUMNS:
        return 0.0
    try:
        value = float(cell)
    except ValueError:
        raise InputError(f"{name} is {cell[:80]!r}, not a number" if cell else f"{name} is blank") from None
    if not isfinite(value) or "_" in cell:
        raise InputError(f"{name} is {cell!r}, allowed are finite numbers")
    low, high, unit = _LIMITS.get(name, _GAUGE)
    if not low <= value <= high:
        raise InputError(f"{name} is {cell}, allowed is {low:g} to {high:g} {unit}")
    if name == "P_N" and 0.0 < value < LEAST_LOAD_NEWTONS:
        raise InputError(f"P_N is {cell}, allowed is 0 (unloaded), or {LEAST_LOAD_NEWTONS:g} N and more")
    return value


def time_faults(line: list[int], times: list[float]) -> list[BadRow]:
    """Return the fewest rows whose removal leaves the times in order: one clock jump is one run of bad rows."""
    if times == sorted(times):
        return []
    ends: list[float] = []
    end_rows: list[int] = []
    before = [-1] * len(times)
    for row, t in enumerate(times):
        place = bisect_right(ends, t)
        before[row] = end_rows[place - 1] if place else -1
        ends[place : place + 1], end_rows[place : place + 1] = [t], [row]
    kept = end_rows[-1:]
    while before[kept[-1]] >= 0:
        kept.append(before[kept[-1]])
    kept.reverse()
    faults = []
    for row in sorted(set(range(len(times))).difference(kept)):
        place = bisect_right(kept, row)
        early = place > 0 and times[row] < times[kept[place - 1]]
        other = kept[place - 1] if early else kept[place]
        reason = f"t_s is {times[row]:g}, {'before' if early else 'after'} the {times[other]:g} of line {line[other]}"
        faults.append(BadRow(line[row], f"{reason}: times must not decrease"))
    return faults


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
    """Read a CSV file of measurements: SG1..SGn, SG1_ue.. or e1_ue.. in microstrain, n = 3 to 8.

    ``loads``: P_N, phi_deg, theta_deg are required. Optional: t_s, temperature_degC, weight, mode (push, pull, tare).
    Unusable rows are in ``bad`` with line and reason. Raises InputError for an unusable file or header, a log with
    estimates beside the gauges, or one of several nodes."""
    lines = _lines(path)
    places, mode, count, ignored = _header(path, lines[0], loads)
    if not any(line.strip() for line in lines[1:]):
        raise InputError(f"{path}: line 1 is a header without rows")
    _require_one_node(path, lines)
    line, rows, modes, bad = list[int](), list[list[float]](), list[int](), list[BadRow]()
    for number, text in enumerate(lines[1:], 2):
        try:
            values, word = _row(text, places, mode, count)
        except InputError as error:
            bad.append(BadRow(number, str(error)))
        else:
            line.append(number)
            rows.append(values)
            modes.append(word)
    good = np.ones(len(line), dtype=np.bool_)
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(places))
    if "t_s" in places:
        late = time_faults(line, table[:, list(places).index("t_s")].tolist())
        bad = sorted([*bad, *late])
        good = ~np.isin(line, [row.line for row in late])
    values_of = {name: table[good, k] for k, name in enumerate(places)}
    gauges = [column for name, column in values_of.items() if name.startswith("SG")]
    angles = [np.radians(values_of[name]) if name in values_of else None for name in LOAD_COLUMNS[1:]]
    return Measurements(
        line=np.array(line, dtype=np.int64)[good], strain=np.stack(gauges, axis=-1) * 1e-6,
        P_newtons=values_of.get("P_N"), phi_rad=angles[0], theta_rad=angles[1],
        t_s=values_of.get("t_s"), temperature_degC=values_of.get("temperature_degC"), weight=values_of.get("weight"),
        mode=None if mode is None else np.array(modes, dtype=np.int8)[good], bad=tuple(bad), ignored_columns=ignored,
    )  # fmt: skip


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
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"{path}: line {line}: a NUL byte; the file is not a text file")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise InputError(f"{path}: the file is empty; it needs a header such as SG1,SG2,SG3,P_N,phi_deg,theta_deg")
    return lines


def _require_one_node(path: str | Path, lines: list[str]) -> None:
    rows = csv.reader(lines)
    try:
        header = [name.strip() for name in next(rows)]
        if not (places := [header.index(name) for name in ("channel", "node") if name in header]):
            return
        senders = {" ".join(row[k].strip() for k in places) for row in rows if len(row) == len(header)}
    except csv.Error as error:
        raise InputError(f"{path}: line {rows.line_num}: {error}; do the quotes match?") from None
    nodes = sorted(senders, key=lambda text: (len(text), text))
    if len(nodes) > 1:
        shown = ", ".join(nodes[:_SHOWN]) + (", ..." if len(nodes) > _SHOWN else "")
        raise InputError(
            f"{path}: readings of {len(nodes)} nodes ({shown}), but a calibration is of one; write one file per node: "
            f"`tipforce decode LOG --nodes {nodes[0].split(' ')[-1]} --signals SG1,SG2,SG3 -o FILE.csv`, or "
            "estimate with `tipforce decode LOG --calibration NODE=CAL.toml` (repeat the option for each node)"
        )


def _header(path: str | Path, text: str, loads: bool) -> tuple[dict[str, int], int | None, int, tuple[str, ...]]:
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
    known = [*expected, *has_load, *(name for name in ("t_s", "temperature_degC", "weight") if name in plain)]
    mode = plain.index("mode") if "mode" in plain else None
    ignored = tuple(name for name, key in zip(names, plain, strict=True) if key not in known and key != "mode")
    return {name: plain.index(name) for name in known}, mode, len(names), ignored
