"""Read and write measurements as CSV: gauge readings with loads, times and modes; bad rows by line and reason."""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce.errors import InputError
from tipforce.host.configuration.measurement_rows import MODES, Block, Columns, read_block, time_faults
from tipforce.output_file import CSV, write_file

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
        found = np.zeros(len(self.line), dtype=np.bool_)
        if self.mode is not None:
            found |= self.mode == MODES.index("tare")
        if self.P_newtons is not None:
            found |= self.P_newtons == 0.0
        return found


def read_measurements(path: str | Path, *, loads: bool) -> Measurements:
    """Read a CSV file of measurements; loads: the columns P_N, phi_deg, theta_deg are required.

    Gauge columns SG1..SGn, SG1_ue.. (of a decoded log) or e1_ue.. in microstrain, n = 3 to 8; optional t_s,
    temperature_degC, weight, mode (push, pull, tare). A row that cannot be used is in ``bad`` with its line and
    reason. Raises InputError if the whole file cannot be used: not readable, empty, not UTF-8, a header with a
    missing or duplicate column, a decoded log with estimates beside the gauges.
    """
    lines = _lines(path)
    columns = _header(path, lines[0], loads)
    if not any(line.strip() for line in lines[1:]):
        raise InputError(f"{path}: line 1 is a header without rows")
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
    return _measurements(columns, Block(line, values, mode, []), tuple(bad))


def write_measurements(path: str | Path, measurements: Measurements) -> None:
    """Write rows with full precision: they read back unchanged. Raises InputError for an unusable path, WriteError."""
    n = measurements.strain.shape[1]
    columns: dict[str, Sequence[object]] = {}
    if measurements.t_s is not None:
        columns["t_s"] = measurements.t_s.tolist()
    for k in range(n):
        columns[f"SG{k + 1}"] = (measurements.strain[:, k] * 1e6).tolist()
    angles = (measurements.phi_rad, measurements.theta_rad)
    if measurements.P_newtons is not None:
        columns["P_N"] = measurements.P_newtons.tolist()
        for name, angle in zip(LOAD_COLUMNS[1:], angles, strict=True):
            columns[name] = np.degrees(angle if angle is not None else 0.0 * measurements.P_newtons).tolist()
    for name in OPTIONAL_COLUMNS[1:]:
        values = getattr(measurements, name)
        if values is not None:
            columns[name] = values.tolist()
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


def _measurements(columns: Columns, block: Block, bad: tuple[BadRow, ...]) -> Measurements:
    found = {name: block.values[:, k] for k, name in enumerate(columns.names)}
    gauges = [values for name, values in found.items() if name.startswith("SG")]
    angles = [np.radians(found[name]) if name in found else None for name in LOAD_COLUMNS[1:]]
    return Measurements(
        line=block.line,
        strain=np.stack(gauges, axis=-1) * 1e-6,
        P_newtons=found.get("P_N"),
        phi_rad=angles[0],
        theta_rad=angles[1],
        t_s=found.get("t_s"),
        temperature_degC=found.get("temperature_degC"),
        weight=found.get("weight"),
        mode=None if columns.mode is None else block.mode,
        bad=bad,
        ignored_columns=columns.ignored,
    )
