"""A calibration as a TOML file: written by a fit, read by everything that applies or uses it."""

from __future__ import annotations

import binascii
import datetime
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from tipforce.arrays import FloatArray
from tipforce.dictionary import table
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration, version_2_bytes
from tipforce.output_file import CALIBRATION, write_file
from tipforce.sensor.structure.layouts import CASE_OF_CODE
from tipforce.toml_table import convert, read_table

if TYPE_CHECKING:
    from tipforce.sensor.calibration.result import Fit


class _Table(msgspec.Struct, forbid_unknown_fields=True):
    matrix_newtons_per_strain: list[list[float]]
    offset_microstrain: list[float]
    covariance_microstrain2: list[list[float]]
    load_sense: str
    serial: int = 0
    date: datetime.date | None = None
    reference_temperature_degC: float = 20.0
    layout: str = "custom"
    tip_radius_m: float = 0.015
    theta_min_deg: float = 0.0
    theta_max_deg: float = 180.0
    contact_on_newtons: float = 0.05
    contact_off_newtons: float = 0.03
    calibrated_force_newtons: float | None = None
    overload_force_newtons: float | None = None
    temperature_min_degC: float | None = None
    temperature_max_degC: float | None = None
    model_uncertainty: float | None = None
    converter_limit_microstrain: list[float] | None = None
    offset_temperature_microstrain_per_K: list[float] | None = None
    gain_temperature_per_K: float | None = None
    redundancy_limit: float | None = None
    tare_drift_microstrain_per_s: float = 0.0
    """For the host alone: not in the node's record, so the crc32 does not cover it."""
    crc32: str | None = None


_SCALARS = (
    "calibrated_force_newtons", "overload_force_newtons", "temperature_min_degC", "temperature_max_degC",
    "model_uncertainty", "gain_temperature_per_K", "redundancy_limit",
)  # fmt: skip
"""Of version 2, absent in files of version 1: the names are those of ``Calibration``."""
_PER_GAUGE = {
    "converter_limit_microstrain": "converter_limit_strain",
    "offset_temperature_microstrain_per_K": "offset_temperature_strain_per_K",
}


class FitRecord(msgspec.Struct):
    """The [fit] table: how the matrix came about, and all that the covariance of an estimate needs.

    The crc32 of the file covers the node's record, not this table. Keys that others write into it are let be.
    """

    dof: float | None = None
    residual_covariance_microstrain2: list[list[float]] | None = None
    """S, (n, n)."""
    normal_matrix: list[list[float]] | None = None
    """N, the sum of G G^T with G = (F, 1), (4, 4) in newtons; (3, 3) for a fit without offset."""
    parameter_covariance_microstrain2: list[list[float]] | None = None
    """(4 n, 4 n): gauge by gauge (A1, A2, A3, offset). Without it S and N give it."""
    matrix_standard_uncertainty_newtons_per_strain: list[list[float]] | None = None
    coverage_factor: float | None = None
    """Standard uncertainties to either side that make 95 %."""
    sigma0: float | None = None
    condition_number: float | None = None
    row_equilibrated_condition_number: float | None = None
    data: str | None = None
    rows: int | None = None
    unloaded_rows: int | None = None
    bad_lines: list[int] = []
    outlier_lines: list[int] = []
    saturated_lines: list[int] = []
    """Lines with a reading left out at the converter's limit, or too near to it."""
    drift: str | None = None
    loss: str | None = None
    angle_scatter_deg: float | None = None

    def parameter_covariance(self) -> FloatArray:
        """Covariance of A and the offsets, (n, 4, n, 4), strain^2: what covariance_of_estimate() takes."""
        if self.parameter_covariance_microstrain2 is not None:
            n = len(self.parameter_covariance_microstrain2) // 4
            return np.array(self.parameter_covariance_microstrain2).reshape(n, 4, n, 4) * 1e-12
        from tipforce.sensor.calibration.result import kronecker

        return kronecker(np.array(self.residual_covariance_microstrain2) * 1e-12, np.array(self.normal_matrix))


class _File(msgspec.Struct, forbid_unknown_fields=True):
    calibration: _Table
    fit: dict[str, object] | None = None


def fit_record(fit: Fit, **facts: object) -> FitRecord:
    """The [fit] table of a fit; facts: fields of FitRecord that the fit does not know (data, lines, ...)."""
    n = fit.A.shape[0]
    values: dict[str, object] = {
        "dof": fit.dof,
        "residual_covariance_microstrain2": (fit.residual_covariance_strain2 * 1e12).tolist(),
        "normal_matrix": fit.N.tolist(),
        "parameter_covariance_microstrain2": (fit.parameter_covariance * 1e12).reshape(4 * n, 4 * n).tolist(),
        "matrix_standard_uncertainty_newtons_per_strain": fit.C_uncertainty.tolist(),
        "coverage_factor": fit.coverage_factor,
        "sigma0": fit.sigma0 if np.isfinite(fit.sigma0) else None,
        "condition_number": fit.condition_number,
        "row_equilibrated_condition_number": fit.row_equilibrated_condition_number,
        "drift": fit.drift,
        "loss": fit.loss,
    }
    return msgspec.convert({**values, **facts}, FitRecord)


_LAYOUT_CODES = {**{name: code for code, name in CASE_OF_CODE.items()}, "custom": table.CUSTOM_LAYOUT}
_SENSES = {"push": False, "pull": True}


def read_calibration(path: str | Path, with_fit: bool = False) -> Calibration:
    """A calibration file. Raises InputError naming the place and what is allowed.

    A ``crc32`` in the file must be that of the record: a number edited by hand is noticed. Take the line out to
    accept the edit. ``with_fit``: with the ``parameter_covariance`` of its [fit] table, where it has one.
    """
    content = _decoded(path).calibration
    found = _checked(content, path)
    try:
        record = found.record()
    except InputError as error:
        raise InputError(f"calibration {path}: {error}") from None
    if _is_version_1(content):
        record = record[: -version_2_bytes(found.gauges)]
    crc = binascii.crc32(record)
    if content.crc32 is not None and content.crc32.lower() != f"0x{crc:08x}":
        raise InputError(
            f"calibration {path}: crc32 is {content.crc32}, but the numbers give 0x{crc:08X}; "
            "the file was changed: restore it, or take out the crc32 line to accept the change"
        )
    fit = read_fit(path) if with_fit else None
    try:
        found.check()
        if fit is not None:
            found = replace(found, parameter_covariance=fit.parameter_covariance())
            found.check()
    except InputError as error:
        raise InputError(f"calibration {path}: {str(error).removeprefix('calibration ')}") from None
    return found


def _is_version_1(content: _Table) -> bool:
    return all(getattr(content, name) is None for name in (*_SCALARS, *_PER_GAUGE))


def read_fit(path: str | Path) -> FitRecord | None:
    """The [fit] table of a calibration file, None where it has none. Raises InputError for shapes that do not fit."""
    content = _decoded(path)
    if content.fit is None:
        return None
    record = convert(FitRecord, content.fit, f"calibration {path}: fit", finite=False)
    n = len(content.calibration.offset_microstrain)
    if record.parameter_covariance_microstrain2 is None and None in (
        record.residual_covariance_microstrain2,
        record.normal_matrix,
    ):
        raise InputError(
            f"calibration {path}: fit: parameter_covariance_microstrain2 is missing, or in its place "
            "residual_covariance_microstrain2 and normal_matrix"
        )
    shapes = {
        "residual_covariance_microstrain2": (record.residual_covariance_microstrain2, ((n, n),)),
        "normal_matrix": (record.normal_matrix, ((4, 4), (3, 3))),
        "parameter_covariance_microstrain2": (record.parameter_covariance_microstrain2, ((4 * n, 4 * n),)),
    }
    for name, (rows, allowed) in shapes.items():
        matrix = None if rows is None else _matrix(path, name, rows)
        if matrix is not None and (matrix.shape not in allowed or not np.isfinite(matrix).all()):
            raise InputError(f"calibration {path}: {name} must be {' or '.join(map(str, allowed))}, finite")
    return record


def _decoded(path: str | Path) -> _File:
    place = f"calibration {path}"
    return convert(_File, read_table(path, place), place, finite=False)


def _checked(content: _Table, path: str | Path) -> Calibration:
    C = _matrix(path, "matrix_newtons_per_strain", content.matrix_newtons_per_strain)
    n = C.shape[1] if C.ndim == 2 else 0
    if C.ndim != 2 or C.shape[0] != 3 or not table.MIN_GAUGES <= n <= table.MAX_GAUGES:
        raise InputError(f"calibration {path}: matrix_newtons_per_strain has shape {C.shape}, allowed (3, 3) to (3, 8)")
    offset = _matrix(path, "offset_microstrain", content.offset_microstrain)
    covariance = _matrix(path, "covariance_microstrain2", content.covariance_microstrain2)
    if offset.shape != (n,):
        raise InputError(f"calibration {path}: offset_microstrain has {offset.size} entries, the matrix {n} gauges")
    if covariance.shape != (n, n) or not np.array_equal(covariance, covariance.T):
        raise InputError(f"calibration {path}: covariance_microstrain2 must be {n} x {n} and symmetric")
    for name, value, allowed in (
        ("load_sense", content.load_sense, _SENSES),
        ("layout", content.layout, _LAYOUT_CODES),
    ):
        if value not in allowed:
            raise InputError(f"calibration {path}: {name} is {value!r}, allowed: {', '.join(allowed)}")
    date = content.date
    return Calibration(
        C, offset * 1e-6, covariance * 1e-12, content.serial,
        0 if date is None else date.year * 10000 + date.month * 100 + date.day,
        content.reference_temperature_degC, _LAYOUT_CODES[content.layout], content.tip_radius_m,
        content.theta_min_deg, content.theta_max_deg, content.contact_on_newtons, content.contact_off_newtons,
        _SENSES[content.load_sense], **_validity(content, path, n),
    )  # fmt: skip


def _validity(content: _Table, path: str | Path, n: int) -> dict[str, Any]:
    """The fields of version 2; what is absent is not known."""
    stated = {name: getattr(content, name) for name in _SCALARS}
    found: dict[str, Any] = {name: 0.0 if value is None else value for name, value in stated.items()}
    found["tare_drift_strain_per_s"] = content.tare_drift_microstrain_per_s * 1e-6
    for key, name in _PER_GAUGE.items():
        values = getattr(content, key)
        if values is not None and len(values) != n:
            raise InputError(f"calibration {path}: {key} has {len(values)} entries, the matrix {n} gauges")
        found[name] = np.zeros(n) if values is None else np.array(values, dtype=np.float64) * 1e-6
    return found


def _matrix(path: str | Path, name: str, rows: object) -> FloatArray:
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError:
        raise InputError(f"calibration {path}: the rows of {name} differ in length") from None


def _date(path: str | Path, number: int) -> datetime.date:
    try:
        return datetime.date(number // 10000, number // 100 % 100, number % 100)
    except ValueError:
        raise InputError(
            f"calibration {path}: date {number}, allowed is YYYYMMDD of a day that there was, or 0"
        ) from None


def write_calibration(
    path: str | Path, calibration: Calibration, fit: FitRecord | dict[str, object] | None = None
) -> None:
    """Write a calibration file that reads back to the same record.

    Raises InputError for a layout code or a date that the file has no words for, and when the disk refuses.
    """
    names = {code: name for name, code in _LAYOUT_CODES.items()}
    if calibration.layout_code not in names:
        raise InputError(
            f"calibration {path}: layout code {calibration.layout_code}, allowed: {', '.join(map(str, names))}"
        )
    content: dict[str, object] = {
        "matrix_newtons_per_strain": calibration.C.tolist(),
        "offset_microstrain": (calibration.offset_strain * 1e6).tolist(),
        "covariance_microstrain2": (calibration.covariance_strain2 * 1e12).tolist(),
        "load_sense": "pull" if calibration.pull else "push",
        "serial": calibration.serial,
        "reference_temperature_degC": calibration.reference_temperature_degC,
        "layout": names[calibration.layout_code],
        "tip_radius_m": calibration.tip_radius_m,
        "theta_min_deg": calibration.theta_min_deg,
        "theta_max_deg": calibration.theta_max_deg,
        "contact_on_newtons": calibration.contact_on_newtons,
        "contact_off_newtons": calibration.contact_off_newtons,
    }
    content |= {name: getattr(calibration, name) for name in _SCALARS}
    content |= {key: (getattr(calibration, name) * 1e6).tolist() for key, name in _PER_GAUGE.items()}
    if calibration.tare_drift_strain_per_s:
        content["tare_drift_microstrain_per_s"] = calibration.tare_drift_strain_per_s * 1e6
    content["crc32"] = f"0x{calibration.crc32():08X}"
    if calibration.date:
        content["date"] = _date(path, calibration.date)
    document: dict[str, object] = {"calibration": content}
    if fit is not None:
        record = msgspec.to_builtins(fit)
        document["fit"] = {name: value for name, value in record.items() if value is not None}
    write_file(path, msgspec.toml.encode(document), CALIBRATION)
