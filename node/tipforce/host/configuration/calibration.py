"""A calibration on the host: the table of its fields makes its checks, its file and the record of a node (2140h)."""

from __future__ import annotations

import binascii
import math
import struct
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from canopen_device import types
from tipforce.arrays import FloatArray, floats
from tipforce.dictionary import indices, table, table_objects
from tipforce.errors import InputError, placed

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tipforce.sensor.calibration.result import Fit

_LEAST_RANK = 1e-9  # smallest over largest singular value: below, rounding alone decides
TYPICAL_NEWTONS_PER_STRAIN = 5e3
"""Smallest singular value of C by beam theory: 4.4e3 to 6.1e3 for the cases I to III in the fabricated dimensions."""
ALLOWED = 30.0
"""Factor to either side of it: other dimensions, materials, numbers of gauges."""
_NEAR = 3.0  # factor from a suspect
_SUSPECTS = {
    1e-6: "the matrix looks like newtons per microstrain: multiply it by 1e6",
    1e6: "the matrix looks like newtons per 1e-6 microstrain (converted twice): multiply it by 1e-6",
    1e-3: "the matrix looks like newtons per millistrain, or kilonewtons per strain: multiply it by 1000",
    1e3: "the matrix looks like millinewtons per strain: multiply it by 0.001",
    1000.0 / 9.80665: "the loads look like grams: multiply the matrix by 0.00980665",
}


def _row(index: int, sub: int = 0, shape: tuple[int | str, ...] = (), key: str = "") -> dict[str, Any]:
    """What the table says of a field: its place in the dictionary (index 0: a node does not hold it), ``shape`` ("n":
    number of gauges), and ``key`` in a file where that is not the field's name in microstrain."""
    return {"place": (index, sub), "shape": shape, "key": key}


def _not_known() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Calibration:
    """F = C (V - offset), with what the node needs to judge it. V is gauge strain (not microstrain), n gauges."""

    C: FloatArray = field(metadata=_row(indices.CALIBRATION_MATRIX, 0, (3, "n"), "matrix_newtons_per_strain"))
    """Calibration matrix, (3, n), newtons per unit strain."""
    offset_strain: FloatArray = field(metadata=_row(indices.CALIBRATION_OFFSET, shape=("n",)))
    """What each gauge reads unloaded, (n,)."""
    covariance_strain2: FloatArray = field(metadata=_row(indices.CALIBRATION_NOISE, shape=("n", "n")))
    """Covariance of the gauges' noise, (n, n), symmetric."""
    serial: int = field(default=0, metadata=_row(indices.CALIBRATION_FACTS, 1))
    date: int = field(default=0, metadata=_row(indices.CALIBRATION_FACTS, 2))
    """YYYYMMDD."""
    reference_temperature_degC: float = field(default=20.0, metadata=_row(indices.CALIBRATION_FACTS, 3))
    layout_code: int = field(default=table.CUSTOM_LAYOUT, metadata=_row(indices.CALIBRATION_FACTS, 4, key="layout"))
    """1, 2, 3 for cases I, II, III; 255 for any other layout (2102h:4)."""
    tip_radius_m: float = field(default=0.015, metadata=_row(indices.CONTACT_SETTINGS, 1))
    theta_min_deg: float = field(default=0.0, metadata=_row(indices.CONTACT_SETTINGS, 2))
    theta_max_deg: float = field(default=180.0, metadata=_row(indices.CONTACT_SETTINGS, 3))
    contact_on_newtons: float = field(default=0.05, metadata=_row(indices.CONTACT_SETTINGS, 4))
    contact_off_newtons: float = field(default=0.03, metadata=_row(indices.CONTACT_SETTINGS, 5))
    pull: bool = field(default=False, metadata=_row(indices.CONTACT_SETTINGS, 6, key="load_sense"))
    """Load sense: True where the load pulls at the surface (rope in a groove), False where it pushes (contact)."""
    calibrated_force_newtons: float = field(default=0.0, metadata=_row(indices.CALIBRATION_VALIDITY, 1))
    """Largest force of the calibration (2112h:1); beyond it the estimate is extrapolated. 0: not known."""
    overload_force_newtons: float = field(default=0.0, metadata=_row(indices.CALIBRATION_VALIDITY, 2))
    """Force beyond which the structure is not linear: slit closed, yield (2112h:2). 0: not known."""
    temperature_min_degC: float = field(default=0.0, metadata=_row(indices.CALIBRATION_VALIDITY, 3))
    temperature_max_degC: float = field(default=0.0, metadata=_row(indices.CALIBRATION_VALIDITY, 4))
    """Range of temperatures of the calibration (2112h:3, 4). Both 0: not known."""
    model_uncertainty: float = field(default=0.0, metadata=_row(indices.CALIBRATION_VALIDITY, 5))
    """Relative standard uncertainty of the force from nonlinearity and misfit (2112h:5). 0: not known."""
    converter_limit_strain: FloatArray = field(
        default_factory=_not_known, metadata=_row(indices.CALIBRATION_CONVERTER_LIMIT, shape=("n",))
    )
    """Symmetric limit of the converter per gauge (2113h), (n,). 0: not known, the span 6148h/6149h alone holds."""
    offset_temperature_strain_per_K: FloatArray = field(
        default_factory=_not_known, metadata=_row(indices.CALIBRATION_OFFSET_TEMPERATURE, shape=("n",))
    )
    """Offset of each gauge against ``reference_temperature_degC`` (2114h), (n,). 0: not known, or none."""
    gain_temperature_per_K: float = field(default=0.0, metadata=_row(indices.CALIBRATION_GAIN_TEMPERATURE))
    """Relative change of the gauges' response per kelvin (2115h): F = C V / (1 + this (T - reference))."""
    redundancy_limit: float = field(default=0.0, metadata=_row(indices.CALIBRATION_REDUNDANCY_LIMIT))
    """Limit of the redundancy check, chi-square of n - 3 degrees of freedom (2116h). 0: off."""
    tare_drift_strain_per_s: float = field(default=0.0, metadata=_row(0))
    """Standard deviation of the rate at which each gauge's offset drifts after a tare. 0: not stated. A node does not
    hold it: the uncertainty that the host computes grows with the age of the tare, the node's own does not."""
    parameter_covariance: FloatArray | None = field(default=None, metadata=_row(0, shape=("n", 4, "n", 4)))
    """Covariance of the fitted strain per newton and offset, (n, 4, n, 4), strain^2: what the calibration itself
    contributes to the uncertainty (``covariance_of_estimate``). A node does not hold it."""

    def __post_init__(self) -> None:
        """Copy the arrays: read-only, float64. Raises InputError naming the shape and what is allowed."""
        n = 0
        for of in fields(self):
            value, shape = getattr(self, of.name), of.metadata["shape"]
            if shape and value is not None:
                value = _array(_label(of), value)
                if of.name == "C":
                    n = value.shape[1] if value.ndim == 2 and value.shape[0] == 3 else 0
                    if not table.MIN_GAUGES <= n <= table.MAX_GAUGES:
                        raise InputError(f"calibration matrix: shape {value.shape}, allowed (3, 3) to (3, 8)")
                elif of.default_factory is _not_known and not value.size:
                    value = np.zeros(n)
                allowed = tuple(n if side == "n" else side for side in shape)
                if value.shape != allowed:
                    raise InputError(f"calibration {_label(of)}: shape {value.shape}, allowed is {allowed}")
                value = value.copy()
                value.flags.writeable = False  # what is prepared from a calibration stays true
            elif of.type in ("int", "float"):
                value = _number(of.name, value, of.type)
            elif of.type == "bool" and not isinstance(value, (bool, np.bool_)):
                raise InputError(f"calibration {of.name}: {value!r}, allowed are True and False")
            object.__setattr__(self, of.name, value)

    @classmethod
    def from_microstrain(
        cls, matrix: npt.ArrayLike, offset: npt.ArrayLike | None = None, covariance: npt.ArrayLike | None = None, *,
        noise: npt.ArrayLike | None = None, pull: bool = False, **facts: Any,
    ) -> Calibration:  # fmt: skip
        """A calibration in microstrain: F = matrix (microstrain - offset).

        matrix: (3, n), N per microstrain; offset: (n,), None for zero; covariance of the noise: (n, n), or ``noise``,
        its standard deviation, (n,) or one; ``facts``: other fields. Raises InputError for shapes, numbers that are not
        finite, no rank 3, and a covariance that is none, or is missing."""
        with np.errstate(over="ignore"):  # check() refuses the infinity
            C = _array("matrix", matrix) * 1e6
        n = C.shape[-1] if C.ndim else 0
        if covariance is None:
            if noise is None:
                raise InputError("calibration: give covariance, (n, n) microstrain^2, or noise, microstrain: 1 sigma")
            deviation = _array("noise", noise)
            if deviation.shape not in {(), (n,)}:
                raise InputError(f"calibration noise: shape {deviation.shape}, allowed are one number and ({n},)")
            if (wrong := deviation[~((deviation > 0.0) & (deviation <= 1e6))]).size:
                raise InputError(f"calibration noise: {wrong[0]:g} microstrain, allowed is above 0 to 1e+06")
            covariance = np.diag(np.broadcast_to(deviation**2, n))
        zero = np.zeros(n) if offset is None else _array("offset", offset) * 1e-6
        calibration = cls(C, zero, _array("covariance", covariance) * 1e-12, pull=pull, **facts)
        calibration.check()
        return calibration

    @staticmethod
    def read(path: str | Path) -> Calibration:
        """A calibration file (TOML), with the uncertainty of its fit. Raises InputError naming what is allowed."""
        return read_calibration(path, with_fit=True)

    @classmethod
    def from_fit(cls, fit: Fit, *, pull: bool, **facts: Any) -> Calibration:
        """The calibration that a fit found, with its uncertainty. ``facts`` as in ``from_microstrain``."""
        noise, facts["parameter_covariance"] = fit.record_covariances
        calibration = cls(fit.C, fit.offset_strain, noise, pull=pull, **facts)
        calibration.check()
        return calibration

    def write(self, path: str | Path) -> None:
        """Write a calibration file that reads back to the same record. Raises InputError."""
        fit: dict[str, object] | None = None
        if self.parameter_covariance is not None:
            side = 4 * self.gauges
            fit = {"parameter_covariance_microstrain2": (self.parameter_covariance * 1e12).reshape(side, side).tolist()}
        write_calibration(path, self, fit)

    def check(self) -> None:
        """Raise InputError for a calibration that no sensor can have; the text names the field and what is allowed."""
        self._check_numbers()
        _check_matrix(self.C)
        S = self.covariance_strain2
        if not np.allclose(S, S.T, rtol=1e-9, atol=0.0):
            raise InputError("calibration covariance: not symmetric")
        if not (np.diagonal(S) > 0.0).all():
            raise InputError(
                f"calibration covariance: a gauge's variance is {np.diagonal(S).min():g}: allowed is above 0, "
                "because a reading without noise would count as exactly known"
            )
        deviation = np.sqrt(np.diagonal(S))
        with np.errstate(over="ignore"):
            correlation = S / deviation / deviation[:, np.newaxis]
        if not np.isfinite(correlation).all() or np.linalg.eigvalsh(correlation)[0] < -1e-9:
            raise InputError("calibration covariance: not positive semi-definite; no correlation may be over 1")
        if self.parameter_covariance is not None:
            from tipforce.host.configuration.calibration_file import check_parameters

            check_parameters(self.parameter_covariance)
        drift = self.tare_drift_strain_per_s
        if not 0.0 <= drift < np.inf:
            drift_text = f"{1e6 * drift:g} microstrain/s, allowed is 0 (not stated) or above"
            raise InputError(f"calibration tare_drift: {drift_text}")
        self.record()  # each value fits its field

    def _check_numbers(self) -> None:
        names = {}
        for of in RECORD:
            index, sub = of.metadata["place"]
            names[place := index << 8 | sub] = of.name
            values = np.atleast_1d(getattr(self, of.name))
            if of.type != "int" and not np.isfinite(values).all():
                raise InputError(f"calibration {_label(of)}: {values[~np.isfinite(values)][0]} is not finite")
            if place in table.NOT_NEGATIVE and (values < 0.0).any():
                raise InputError(f"calibration {of.name}: {values.min():g}, allowed is 0 (not known) and above")
        for low, high in ((names[a], names[b]) for a, b in table.IN_ORDER):
            if getattr(self, low) > getattr(self, high):
                raise InputError(f"calibration {low}: {getattr(self, low):g} is above {high} {getattr(self, high):g}")

    @property
    def gauges(self) -> int:
        """Number of gauges n."""
        return int(self.C.shape[1])

    @property
    def covariance_F(self) -> FloatArray:
        """Covariance of F from gauge noise, C Sigma C^T, (3, 3), N^2."""
        return self.C @ self.covariance_strain2 @ self.C.T

    def numbers(self) -> list[float]:
        """The numbers of a record in its order, in double precision."""
        values: list[float] = []
        for of in RECORD:
            value = getattr(self, of.name)
            triangle = of.metadata["shape"] == ("n", "n")
            values += (value[np.triu_indices(self.gauges)] if triangle else np.ravel(value)).tolist()
        return values

    def record(self) -> bytes:
        """The record of the node (docs/objects.md). Raises InputError for a value that its field cannot hold."""
        content = bytearray()
        for (index, sub, kind), number in zip(table_objects.staged(self.gauges), self.numbers(), strict=True):
            with placed(f"calibration 0x{index:04X}:{sub:02X}"):
                content += types.encode(kind, number)
        return bytes(content)

    def crc32(self) -> int:
        """CRC-32 (IEEE) of the record: what 2103h:3 shows once it is active."""
        return binascii.crc32(self.record())

    @classmethod
    def from_record(cls, record: bytes) -> Calibration:
        """The calibration in a record that a node gave. Raises InputError for a length that no n has."""
        for n in range(table.MIN_GAUGES, table.MAX_GAUGES + 1):
            if len(record) == struct.calcsize(_packing(n)):
                numbers = iter(struct.unpack(_packing(n), record))
                return cls(**{of.name: _from_numbers(of, numbers, n) for of in RECORD})
            if len(record) == struct.calcsize(_packing(n, indices.CALIBRATION_VALIDITY)):
                raise InputError(f"a calibration record of {len(record)} bytes is of version 1: allowed is version 2")
        raise InputError(f"a calibration record of {len(record)} bytes: with 3 gauges it has 158")


RECORD = tuple(
    sorted((of for of in fields(Calibration) if of.metadata["place"][0]), key=lambda of: of.metadata["place"])
)
"""The fields that a node holds, in the order of its record."""


def read_calibration(path: str | Path, with_fit: bool = False) -> Calibration:
    """A calibration file, ``with_fit`` with the ``parameter_covariance`` of its [fit]. Raises InputError naming the
    place and what is allowed, also where a ``crc32`` is not the record's: the file was edited; take that line out."""
    from tipforce.host.configuration.calibration_file import read_file

    values, crc32, fit = read_file(path, fields(Calibration))
    try:
        calibration = Calibration(**values)
        record = calibration.record()
        if max(of.metadata["place"] for of in RECORD if of.name in values) < (indices.CALIBRATION_VALIDITY, 0):
            record = record[: struct.calcsize(_packing(calibration.gauges, indices.CALIBRATION_VALIDITY))]  # version 1
        crc = binascii.crc32(record)
        if crc32 is not None and crc32.lower() != f"0x{crc:08x}":
            raise InputError(
                f"crc32 is {crc32}, but the numbers give 0x{crc:08X}; "
                "the file was changed: restore it, or take out the crc32 line to accept the change"
            )
        calibration.check()
        if with_fit and fit is not None:
            calibration = replace(calibration, parameter_covariance=fit.parameter_covariance(calibration.gauges))
            calibration.check()
    except InputError as error:
        raise InputError(f"calibration {path}: {str(error).removeprefix('calibration ')}") from None
    return calibration


def write_calibration(path: str | Path, calibration: Calibration, fit: dict[str, object] | None = None) -> None:
    """Write a calibration file that reads back to the same record, with its table [fit]. Raises InputError for a layout
    code or a date that the file has no words for, and when the disk refuses."""
    from tipforce.host.configuration.calibration_file import write_file

    write_file(path, fields(calibration), calibration, calibration.crc32(), fit)


def difference(expected: bytes, held: bytes) -> list[str]:
    """What differs between two records, one line a field, with both values; empty when they are equal byte for byte."""
    if expected == held:
        return []
    if len(expected) != len(held):
        return [f"length: expected {len(expected)} bytes, the node has {len(held)}"]
    n = Calibration.from_record(expected).gauges
    pairs = zip(table_objects.staged(n), *(struct.unpack(_packing(n), data) for data in (expected, held)), strict=True)
    return [
        f"0x{index:04X}:{sub:02X}: expected {ours!r}, the node has {theirs!r}"
        for (index, sub, kind), ours, theirs in pairs
        if struct.pack("<" + kind, ours) != struct.pack("<" + kind, theirs)
    ]


def _label(of: Field[Any]) -> str:
    required = of.default is MISSING and of.default_factory is MISSING
    return "matrix" if of.name == "C" else of.name.partition("_")[0] if required else of.name


def _from_numbers(of: Field[Any], numbers: Iterator[int | float], n: int) -> Any:
    shape = [n if side == "n" else int(side) for side in of.metadata["shape"]]
    if not shape:
        return bool(next(numbers)) if of.type == "bool" else next(numbers)
    if of.metadata["shape"] != ("n", "n"):
        return np.reshape(list(islice(numbers, math.prod(shape))), shape)
    array, (rows, columns) = np.zeros(shape), np.triu_indices(n)
    array[rows, columns] = array[columns, rows] = list(islice(numbers, len(rows)))
    return array


def _packing(n: int, before: int = indices.SIMULATED_FAULT) -> str:
    """The form of a record; ``before`` 2112h: of version 1, which ends there."""
    return "<" + "".join(kind for index, _, kind in table_objects.staged(n) if index < before)


def _array(name: str, values: npt.ArrayLike) -> FloatArray:
    return floats(f"calibration {name}", values)


def _number(name: str, value: Any, kind: object) -> int | float:
    if kind == "int" and isinstance(value, int | np.integer) and not isinstance(value, bool):
        return int(value)
    number = _array(name, value)
    if number.shape != () or kind == "int":
        raise InputError(f"calibration {name}: {value!r}, allowed is one {'integer' if kind == 'int' else 'number'}")
    return float(number)


def _check_matrix(C: FloatArray) -> None:
    singular = np.linalg.svd(C, compute_uv=False)
    if not singular[-1] > singular[0] * _LEAST_RANK:
        raise InputError(
            f"calibration matrix: rank below 3 (singular values {', '.join(f'{s:.3g}' for s in singular)} N per "
            "unit strain): it cannot tell three force components"
        )
    # The response to a newton, not the norm of C: an ill-conditioned layout does not change it.
    ratio = float(singular[-1]) / TYPICAL_NEWTONS_PER_STRAIN
    factor = min(_SUSPECTS, key=lambda suspect: abs(np.log(suspect / ratio)))
    if not 1.0 / ALLOWED <= ratio <= ALLOWED and 1.0 / _NEAR <= factor / ratio <= _NEAR:
        raise InputError(
            f"calibration matrix: {ratio:.3g} times the size that beam theory gives (allowed {1.0 / ALLOWED:.2g} to "
            f"{ALLOWED:g}): {_SUSPECTS[factor]}"
        )
    if not table.NORM_MIN <= singular[0] <= table.NORM_MAX:
        raise InputError(
            f"calibration matrix: 2-norm {singular[0]:.3g} N per unit strain: allowed is {table.NORM_MIN:g} to "
            f"{table.NORM_MAX:g}"
        )
