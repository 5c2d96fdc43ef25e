"""The TOML file of a calibration: its table [calibration] by the fields of ``Calibration``, and its table [fit]."""

from __future__ import annotations

import datetime
from dataclasses import MISSING, Field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from canopen_device.toml_table import convert, read_table
from tipforce import output_file
from tipforce.arrays import FloatArray
from tipforce.dictionary import table
from tipforce.errors import InputError, placed
from tipforce.sensor.structure.layouts import CASE_OF_CODE

if TYPE_CHECKING:
    from tipforce.sensor.calibration.result import Fit

    Fields = tuple[Field[Any], ...]

_WORDS: dict[str, dict[str, int | bool]] = {
    "pull": {"push": False, "pull": True},
    "layout_code": {**{name: code for code, name in CASE_OF_CODE.items()}, "custom": table.CUSTOM_LAYOUT},
}
"""What a file says in place of a number."""


class FitTable(msgspec.Struct):
    """The part of the table [fit] that is read; other keys are ignored. The crc32 of the file does not cover it."""

    residual_covariance_microstrain2: list[list[float]] | None = None
    """S, (n, n)."""
    normal_matrix: list[list[float]] | None = None
    """N, the sum of G G^T with G = (F, 1), (4, 4) in newtons; (3, 3) for a fit without offset."""
    parameter_covariance_microstrain2: list[list[float]] | None = None
    """(4 n, 4 n): gauge by gauge (A1, A2, A3, offset), of the record. Without it S and N give it."""

    def parameter_covariance(self, n: int) -> FloatArray:
        """Covariance of A and the offsets, (n, 4, n, 4), strain^2: what covariance_of_estimate() takes. Raises
        InputError for shapes that do not fit ``n`` gauges, and where it is missing."""
        S, N, whole = (
            None if rows is None else _matrix(name, rows) for name, rows in msgspec.structs.asdict(self).items()
        )
        shapes = ((n, n),), ((4, 4), (3, 3)), ((4 * n, 4 * n),)
        for name, matrix, allowed in zip(self.__struct_fields__, (S, N, whole), shapes, strict=True):
            if matrix is not None and (matrix.shape not in allowed or not np.isfinite(matrix).all()):
                raise InputError(f"{name} must be {' or '.join(map(str, allowed))}, finite")
        if whole is not None:
            return whole.reshape(n, 4, n, 4) * 1e-12
        if S is None or N is None:
            raise InputError(
                "fit: parameter_covariance_microstrain2 is missing, or in its place "
                "residual_covariance_microstrain2 and normal_matrix"
            )
        from tipforce.sensor.calibration.result import kronecker

        return kronecker(S * 1e-12, N)


def check_parameters(blocks: FloatArray) -> None:
    """Raise InputError where it is no covariance. One makes covariance_of_estimate() a covariance for every load: none
    needs a check of its own."""
    from tipforce.sensor.calibration.result import DIGITS

    side = blocks.shape[0] * blocks.shape[1]
    matrix = blocks.reshape(side, side)
    variance = np.diagonal(matrix)
    scale = np.where(variance > 0.0, variance, np.abs(matrix).max(initial=0.0) or 1.0)  # 0: an offset not fitted
    correlation = matrix / np.sqrt(scale) / np.sqrt(scale)[:, np.newaxis]
    # A file's numbers are rounded to a place of the largest one.
    rounding = side * 10.0 ** (1 - DIGITS) * float(np.abs(matrix).max(initial=0.0) / scale.min())
    if not np.isfinite(matrix).all() or np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] < -1e-9 - rounding:
        raise InputError("calibration parameter covariance: not positive semi-definite; no correlation may be over 1")


def fit_table(fit: Fit, angle_scatter_deg: float, **facts: object) -> dict[str, object]:
    """The table [fit]: how the matrix came about, and all that the covariance of an estimate needs. ``facts`` of the
    data: file, rows, lines with bad rows, outliers, readings at or too near to the converter's limit."""
    from tipforce.sensor.calibration.result import to_digits

    side = 4 * len(fit.A)
    return {
        "dof": fit.dof,
        "residual_covariance_microstrain2": (fit.residual_covariance_strain2 * 1e12).tolist(),
        "normal_matrix": fit.N.tolist(),
        "parameter_covariance_microstrain2": (to_digits(fit.record_covariances[1]) * 1e12).reshape(side, side).tolist(),
        "matrix_standard_uncertainty_newtons_per_strain": fit.C_uncertainty.tolist(),
        "coverage_factor": fit.coverage_factor,
        **({"sigma0": fit.sigma0} if np.isfinite(fit.sigma0) else {}),
        "condition_number": fit.condition_number,
        "row_equilibrated_condition_number": fit.row_equilibrated_condition_number,
        **facts,
        "drift": fit.drift,
        "loss": fit.loss,
        "angle_scatter_deg": angle_scatter_deg,
    }


def read_file(path: str | Path, fields: Fields) -> tuple[dict[str, Any], str | None, FitTable | None]:
    """The fields of a file by name; its CRC-32; its [fit] table. Raises InputError naming the key and the limits."""
    place = f"calibration {path}"
    content: Any = convert(_file_type(fields), read_table(path, place), place, finite=False)
    with placed(place):
        values = {
            of.name: _value(of, key, unit, cell)
            for of, key, unit, _ in _rows(fields)
            if (cell := getattr(content.calibration, key)) is not None
        }
    fit = None if content.fit is None else convert(FitTable, content.fit, f"{place}: fit", finite=False)
    return values, content.calibration.crc32, fit


def write_file(path: str | Path, fields: Fields, calibration: object, crc32: int, fit: object) -> None:
    """Write a file with the fields of a calibration, the CRC-32 of its record, and its table [fit], None for none.
    Raises InputError for a layout code or a date that the file has no words for, and when the disk refuses."""
    with placed(f"calibration {path}"):
        content = {key: _cell(of, unit, getattr(calibration, of.name)) for of, key, unit, _ in _rows(fields)}
    content["tare_drift_microstrain_per_s"] = content["tare_drift_microstrain_per_s"] or None
    content |= {"crc32": f"0x{crc32:08X}", "date": content.pop("date")}
    cells = {key: cell for key, cell in content.items() if cell is not None}
    document: dict[str, object] = {"calibration": cells} if fit is None else {"calibration": cells, "fit": fit}
    output_file.write_file(path, msgspec.toml.encode(document), output_file.CALIBRATION)


def _rows(fields: Fields) -> list[tuple[Field[Any], str, float, int]]:
    """The fields in the order of a file: key, unit, and rank (0 required, numbers, arrays, 3 what no node holds)."""
    rows = []
    for of in fields:
        required = of.type == "bool" or of.default is of.default_factory is MISSING
        rank = 3 if not of.metadata["place"][0] else 0 if required else 1 + (of.type == "FloatArray")
        unit = 1e12 if "_strain2" in of.name else 1e6 if "_strain" in of.name else 1.0
        rows.append((of, of.metadata["key"] or of.name.replace("_strain", "_microstrain"), unit, rank))
    return sorted((row for row in rows if row[0].type != "FloatArray | None"), key=lambda row: row[3])


def _file_type(fields: Fields) -> type[msgspec.Struct]:
    keys: list[Any] = []
    for of, key, _, rank in _rows(fields):
        words, plain = of.name in _WORDS, int if of.type == "int" else float
        kind: Any = str if words else datetime.date if of.name == "date" else plain
        for _ in of.metadata["shape"]:
            kind = list[kind]
        keys.append((key, kind | None, None) if rank else (key, kind))
    keys.append(("crc32", str | None, None))
    calibration = msgspec.defstruct("_Table", keys, forbid_unknown_fields=True)
    tables: list[Any] = [("calibration", calibration), ("fit", dict[str, object] | None, None)]
    return msgspec.defstruct("_File", tables, forbid_unknown_fields=True)


def _value(of: Field[Any], key: str, unit: float, cell: Any) -> Any:
    if of.name in _WORDS:
        if cell not in _WORDS[of.name]:
            raise InputError(f"{key} is {cell!r}, allowed: {', '.join(_WORDS[of.name])}")
        return _WORDS[of.name][cell]
    if of.name == "date":
        return cell.year * 10000 + cell.month * 100 + cell.day
    value = _matrix(key, cell) if of.metadata["shape"] else cell
    return value if unit == 1.0 else value * (1.0 / unit)


def _cell(of: Field[Any], unit: float, value: Any) -> Any:
    if of.name in _WORDS:
        names = {code: word for word, code in _WORDS[of.name].items()}
        if value not in names:
            raise InputError(f"layout code {value}, allowed: {', '.join(map(str, names))}")
        return names[value]
    if of.name == "date":
        try:
            return datetime.date(value // 10000, value // 100 % 100, value % 100) if value else None
        except ValueError:
            raise InputError(f"date {value}, allowed is YYYYMMDD of a day that there was, or 0") from None
    number = value if unit == 1.0 else value * unit
    return number.tolist() if of.metadata["shape"] else number


def _matrix(name: str, rows: object) -> FloatArray:
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError:
        raise InputError(f"the rows of {name} differ in length") from None
