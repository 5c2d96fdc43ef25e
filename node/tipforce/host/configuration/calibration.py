"""A calibration on the host: its numbers, and its record of bytes as the node holds it (2140h, 2141h)."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.dictionary import indices, table, types
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.sensor.calibration.result import Fit

_PER_GAUGE = ("converter_limit_strain", "offset_temperature_strain_per_K")


def _not_known() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Calibration:
    """F = C (V - offset), with what the node needs to judge it. V is gauge strain (not microstrain), n gauges."""

    C: FloatArray
    """Calibration matrix, (3, n), newtons per unit strain."""
    offset_strain: FloatArray
    """What each gauge reads unloaded, (n,)."""
    covariance_strain2: FloatArray
    """Covariance of the gauges' noise, (n, n), symmetric."""
    serial: int = 0
    date: int = 0
    """YYYYMMDD."""
    reference_temperature_degC: float = 20.0
    layout_code: int = table.CUSTOM_LAYOUT
    """1, 2, 3 for cases I, II, III; 255 for any other layout (2102h:4)."""
    tip_radius_m: float = 0.015
    theta_min_deg: float = 0.0
    theta_max_deg: float = 180.0
    contact_on_newtons: float = 0.05
    contact_off_newtons: float = 0.03
    pull: bool = False
    """Load sense: True where the load pulls at the surface (rope in a groove), False where it pushes (contact)."""
    calibrated_force_newtons: float = 0.0
    """Largest force of the calibration (2112h:1); beyond it the estimate is extrapolated. 0: not known."""
    overload_force_newtons: float = 0.0
    """Force beyond which the structure is not linear: slit closed, yield (2112h:2). 0: not known."""
    temperature_min_degC: float = 0.0
    temperature_max_degC: float = 0.0
    """Range of temperatures of the calibration (2112h:3, 4). Both 0: not known."""
    model_uncertainty: float = 0.0
    """Relative standard uncertainty of the force from nonlinearity and misfit (2112h:5). 0: not known."""
    converter_limit_strain: FloatArray = field(default_factory=_not_known)
    """Symmetric limit of the converter per gauge (2113h), (n,). 0: not known, the span 6148h/6149h alone holds."""
    offset_temperature_strain_per_K: FloatArray = field(default_factory=_not_known)
    """Offset of each gauge against ``reference_temperature_degC`` (2114h), (n,). 0: not known, or none."""
    gain_temperature_per_K: float = 0.0
    """Relative change of the gauges' response per kelvin (2115h): F = C V / (1 + this (T - reference))."""
    redundancy_limit: float = 0.0
    """Limit of the redundancy check, chi-square of n - 3 degrees of freedom (2116h). 0: off."""
    tare_drift_strain_per_s: float = 0.0
    """Standard deviation of the rate at which each gauge's offset drifts after a tare. 0: not stated. A node does not
    hold it: the uncertainty that the host computes grows with the age of the tare, the node's own does not."""
    parameter_covariance: FloatArray | None = None
    """Covariance of the fitted strain per newton and offset, (n, 4, n, 4), strain^2: what the calibration itself
    contributes to the uncertainty (``covariance_of_estimate``). A node does not hold it."""

    def __post_init__(self) -> None:
        """Arrays of float64, of shapes that belong together. Raises InputError naming the shape and what is allowed."""
        for name in ("C", "offset_strain", "covariance_strain2"):
            object.__setattr__(self, name, _array(name, getattr(self, name)))
        if not isinstance(self.pull, (bool, np.bool_)):
            raise InputError(f"calibration pull: {self.pull!r}, allowed are True and False")
        n = self.C.shape[1] if self.C.ndim == 2 else 0
        if self.C.ndim != 2 or self.C.shape[0] != 3 or not table.MIN_GAUGES <= n <= table.MAX_GAUGES:
            raise InputError(f"calibration matrix: shape {self.C.shape}, allowed (3, 3) to (3, 8)")
        if self.offset_strain.shape != (n,):
            raise InputError(f"calibration offset: shape {self.offset_strain.shape}, allowed is ({n},)")
        if self.covariance_strain2.shape != (n, n):
            raise InputError(f"calibration covariance: shape {self.covariance_strain2.shape}, allowed is ({n}, {n})")
        for name in _PER_GAUGE:
            values = _array(name, getattr(self, name))
            object.__setattr__(self, name, values if values.size else np.zeros(n))
            if values.size and values.shape != (n,):
                raise InputError(f"calibration {name}: shape {values.shape}, allowed is ({n},)")
        self._check_numbers()

    def _check_numbers(self) -> None:
        for field_ in fields(self):
            if field_.type in ("int", "float"):
                object.__setattr__(self, field_.name, _number(field_.name, getattr(self, field_.name), field_.type))
        if self.parameter_covariance is not None:
            n = self.gauges
            blocks = _array("parameter_covariance", self.parameter_covariance)
            object.__setattr__(self, "parameter_covariance", blocks)
            if blocks.shape != (n, 4, n, 4):
                raise InputError(f"calibration parameter_covariance: shape {blocks.shape}, allowed is {(n, 4, n, 4)}")

    @classmethod
    def from_microstrain(
        cls,
        matrix: npt.ArrayLike,
        offset: npt.ArrayLike | None = None,
        covariance: npt.ArrayLike | None = None,
        *,
        noise: npt.ArrayLike | None = None,
        pull: bool = False,
        **facts: Any,
    ) -> Calibration:
        """A calibration from numbers in microstrain: F = matrix (microstrain - offset).

        matrix: (3, n), newtons per microstrain; offset: (n,), microstrain, None for zero; covariance: (n, n),
        microstrain^2, of the gauges' noise; or noise: its standard deviation, (n,) or one number for all gauges.
        ``facts``: other fields by name (serial, date, layout_code, tip_radius_m, ...). Raises InputError for what no
        calibration can be: shapes, numbers that are not finite, a matrix without rank 3, a covariance that is no
        covariance, or none at all.
        """
        with np.errstate(over="ignore"):  # check() refuses the infinity
            C = _array("matrix", matrix) * 1e6
        n = C.shape[-1] if C.ndim else 0
        if covariance is None:
            if noise is None:
                raise InputError("calibration: give covariance, (n, n) microstrain^2, or noise, microstrain: 1 sigma")
            deviation = _array("noise", noise)
            if deviation.shape not in {(), (n,)}:
                raise InputError(f"calibration noise: shape {deviation.shape}, allowed are one number and ({n},)")
            if not ((deviation > 0.0) & (deviation < np.inf)).all():
                raise InputError(f"calibration noise: {deviation.min():g} microstrain, allowed is above 0, finite")
            covariance = np.diag(np.broadcast_to(deviation**2, n))
        zero = np.zeros(n) if offset is None else _array("offset", offset) * 1e-6
        found = cls(C, zero, _array("covariance", covariance) * 1e-12, pull=pull, **facts)
        found.check()
        return found

    @staticmethod
    def read(path: str | Path) -> Calibration:
        """A calibration file (TOML), with the uncertainty of its fit. Raises InputError naming what is allowed."""
        from tipforce.host.configuration.calibration_file import read_calibration

        return read_calibration(path, with_fit=True)

    @classmethod
    def from_fit(cls, fit: Fit, *, pull: bool, **facts: Any) -> Calibration:
        """The calibration that a fit found, with its uncertainty. ``facts`` as in ``from_microstrain``."""
        noise, facts["parameter_covariance"] = fit.record_covariances
        found = cls(fit.C, fit.offset_strain, noise, pull=pull, **facts)
        found.check()
        return found

    def write(self, path: str | Path) -> None:
        """Write a calibration file that reads back to the same record. Raises InputError."""
        from tipforce.host.configuration.calibration_file import write_calibration

        fit: dict[str, object] | None = None
        if self.parameter_covariance is not None:
            side = 4 * self.gauges
            matrix = (self.parameter_covariance * 1e12).reshape(side, side)
            fit = {"parameter_covariance_microstrain2": matrix.tolist()}
        write_calibration(path, self, fit)

    def check(self) -> None:
        """Raise InputError for a calibration that no sensor can have; the text names the field and what is allowed."""
        from tipforce.host.configuration.calibration_check import check

        check(self)

    @property
    def not_known(self) -> tuple[str, ...]:
        """What the calibration does not state of its validity, in words; all of it for files of version 1."""
        missing = {
            "calibrated force": self.calibrated_force_newtons,
            "overload force": self.overload_force_newtons,
            "temperature range": self.temperature_min_degC or self.temperature_max_degC,
            "model uncertainty": self.model_uncertainty,
            "converter limit": self.converter_limit_strain.all(),
        }
        if self.gauges > 3:
            missing["redundancy limit"] = self.redundancy_limit
        return tuple(name for name, value in missing.items() if not value)

    @property
    def gauges(self) -> int:
        """Number of gauges n."""
        return int(self.C.shape[1])

    @property
    def covariance_F(self) -> FloatArray:
        """Covariance of F from gauge noise, C Sigma C^T, (3, 3), N^2."""
        return self.C @ self.covariance_strain2 @ self.C.T

    def record(self) -> bytes:
        """The record of the node (docs/objects.md). Raises InputError for a value that its field cannot hold."""
        upper = self.covariance_strain2[np.triu_indices(self.gauges)]
        facts = (self.serial, self.date, self.reference_temperature_degC, self.layout_code)
        pad = (self.tip_radius_m, self.theta_min_deg, self.theta_max_deg)
        thresholds = (self.contact_on_newtons, self.contact_off_newtons)
        contact = (*pad, *thresholds, int(self.pull))
        forces = (self.calibrated_force_newtons, self.overload_force_newtons)
        range_degC = (self.temperature_min_degC, self.temperature_max_degC)
        validity = (*forces, *range_degC, self.model_uncertainty, *self.converter_limit_strain)
        tail = (*self.offset_temperature_strain_per_K, self.gain_temperature_per_K, self.redundancy_limit)
        values = (*self.C.ravel(), *self.offset_strain, *facts, *upper, *contact, *validity, *tail)
        fields = bytearray()
        for (index, sub, kind), value in zip(table.staged(self.gauges), values, strict=True):
            try:
                fields += types.encode(kind, value)
            except InputError as error:
                raise InputError(f"calibration 0x{index:04X}:{sub:02X}: {error}") from None
        return bytes(fields)

    def crc32(self) -> int:
        """CRC-32 (IEEE) of the record: what 2103h:3 shows once it is active."""
        return binascii.crc32(self.record())

    @classmethod
    def from_record(cls, record: bytes) -> Calibration:
        """The calibration in a record that a node gave. Raises InputError for a length that no n has."""
        for n in range(table.MIN_GAUGES, table.MAX_GAUGES + 1):
            size = struct.calcsize(_packing(n))
            if size == len(record):
                return _from_values(n, struct.unpack(_packing(n), record))
            if len(record) == size - version_2_bytes(n):
                raise InputError(f"a calibration record of {len(record)} bytes is of version 1: allowed is version 2")
        raise InputError(f"a calibration record of {len(record)} bytes: with 3 gauges it has 158")


def _array(name: str, values: npt.ArrayLike) -> FloatArray:
    return floats(f"calibration {name}", values)


def _number(name: str, value: Any, kind: object) -> int | float:
    if kind == "int" and isinstance(value, int | np.integer) and not isinstance(value, bool):
        return int(value)
    number = _array(name, value)
    if number.shape != () or kind == "int":
        raise InputError(f"calibration {name}: {value!r}, allowed is one {'integer' if kind == 'int' else 'number'}")
    return float(number)


def _packing(n: int) -> str:
    return "<" + "".join(kind for _, _, kind in table.staged(n))


def version_2_bytes(n: int) -> int:
    """How much longer the record is than that of version 1, which ends with 2110h:6."""
    kinds = "".join(kind for index, _, kind in table.staged(n) if index >= indices.CALIBRATION_VALIDITY)
    return struct.calcsize("<" + kinds)


def _from_values(n: int, values: Sequence[float]) -> Calibration:
    left = iter(values)

    def take(count: int) -> list[float]:
        return list(islice(left, count))

    matrix, offsets = np.array(take(3 * n)).reshape(3, n), np.array(take(n))
    serial, date, temperature, layout = take(4)
    covariance = np.zeros((n, n))
    rows, columns = np.triu_indices(n)
    covariance[rows, columns] = covariance[columns, rows] = take(len(rows))
    radius, theta_min, theta_max, on, off, sense = take(6)
    calibrated, overload, low, high, model = take(5)
    limits, offsets_per_K = np.array(take(n)), np.array(take(n))
    gain_per_K, redundancy_limit = left
    return Calibration(
        matrix, offsets, covariance, int(serial), int(date), temperature, int(layout), radius, theta_min, theta_max,
        on, off, bool(sense), calibrated, overload, low, high, model, limits, offsets_per_K, gain_per_K,
        redundancy_limit,
    )  # fmt: skip


def difference(expected: bytes, found: bytes) -> list[str]:
    """What differs between two records, one line a field, with both values; empty when they are equal byte for byte."""
    if expected == found:
        return []
    if len(expected) != len(found):
        return [f"length: expected {len(expected)} bytes, the node has {len(found)}"]
    n = Calibration.from_record(expected).gauges
    lines, offset = [], 0
    for index, sub, kind in table.staged(n):
        size = struct.calcsize("<" + kind)
        ours, theirs = expected[offset : offset + size], found[offset : offset + size]
        offset += size
        if ours != theirs:
            a, b = struct.unpack("<" + kind, ours)[0], struct.unpack("<" + kind, theirs)[0]
            lines.append(f"0x{index:04X}:{sub:02X}: expected {a!r}, the node has {b!r}")
    return lines
