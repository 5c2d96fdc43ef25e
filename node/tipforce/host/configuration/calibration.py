"""A calibration on the host: its numbers, and its record of bytes as the node holds it (2140h, 2141h)."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.dictionary import table, types
from tipforce.errors import InputError

FloatArray = npt.NDArray[np.float64]


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

    @property
    def gauges(self) -> int:
        """Number of gauges n."""
        return int(self.C.shape[1])

    @property
    def covariance_F(self) -> FloatArray:
        """Covariance of F from gauge noise, C Sigma C^T, (3, 3), N^2."""
        return self.C @ self.covariance_strain2 @ self.C.T

    def record(self) -> bytes:
        """The calibration record as the node holds it (OBJECTS.md). Raises InputError for what a field cannot hold."""
        upper = self.covariance_strain2[np.triu_indices(self.gauges)]
        facts = (self.serial, self.date, self.reference_temperature_degC, self.layout_code)
        pad = (self.tip_radius_m, self.theta_min_deg, self.theta_max_deg)
        thresholds = (self.contact_on_newtons, self.contact_off_newtons)
        values = (*self.C.ravel(), *self.offset_strain, *facts, *upper, *pad, *thresholds, int(self.pull))
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
            if struct.calcsize(_packing(n)) == len(record):
                return _from_values(n, struct.unpack(_packing(n), record))
        raise InputError(f"a calibration record of {len(record)} bytes: with 3 gauges it has 106")


def _packing(n: int) -> str:
    return "<" + "".join(kind for _, _, kind in table.staged(n))


def _from_values(n: int, values: Sequence[float]) -> Calibration:
    matrix, offsets = np.array(values[: 3 * n]).reshape(3, n), np.array(values[3 * n : 4 * n])
    serial, date, temperature, layout = values[4 * n : 4 * n + 4]
    upper = values[4 * n + 4 : -6]
    covariance = np.zeros((n, n))
    rows, columns = np.triu_indices(n)
    covariance[rows, columns] = covariance[columns, rows] = upper
    radius, theta_min, theta_max, on, off, sense = values[-6:]
    return Calibration(
        matrix, offsets, covariance, int(serial), int(date), temperature, int(layout),
        radius, theta_min, theta_max, on, off, bool(sense),
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
