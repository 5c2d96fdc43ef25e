"""The calibration a node holds: one staged record that SDO writes fill, one active record that a commit replaces.

docs/objects.md, manufacturer area: 2100h-2106h, 2110h, 2140h, 2141h.
"""

import binascii
import struct

from tipforce.device import codes, communication
from tipforce.dictionary import indices, table
from tipforce.sensor.contact.scalar_condition import condition_number, singular_range

from .active_calibration import Active, square

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.device.object_dictionary import ObjectDictionary, Value


NORM_MIN, NORM_MAX = 10.0, 1e7  # of C, 2-norm, N per unit strain: beyond, some unit is mistaken
CALIBRATION_GROUP = 4  # sub-index of 1010h and 1011h
_ROUNDING = 1e-5  # of variances: that of REAL32, with room for a node that works in single precision
_STORED_TAIL = "<fI"  # condition limit 2105h:1, generation 2103h:4
_HEALTH_MAPPING = communication.TPDO_MAPPING + 3  # of TPDO4
_CONDITION_LIMIT, _EXPECTED_CRC = indices.CALIBRATION_GUARD << 8 | 1, indices.CALIBRATION_CHECK << 8 | 1


def crc32(data: bytes) -> int:
    """CRC-32 (IEEE 802.3, as zlib computes it)."""
    return binascii.crc32(data) & 0xFFFFFFFF


def _is_covariance(full: "list[list[float]]") -> bool:
    """No combination of gauges has a variance below zero, but for rounding to REAL32. Changes ``full``."""
    n = len(full)
    for k in range(n):
        full[k][k] *= 1.0 + _ROUNDING
    # Gauss elimination: symmetric and no pivot below zero is what makes a covariance.
    for k in range(n):
        pivot = full[k][k]
        if not pivot > 0.0:
            if pivot < 0.0 or any(full[k][k + 1 :]):
                return False
            continue
        for i in range(k + 1, n):
            factor = full[k][i] / pivot
            for j in range(i, n):
                full[i][j] -= factor * full[k][j]
    return True


class Calibration:
    """Staged and active record of one node, and the objects that show them."""

    __slots__ = ("_generation", "_keys", "_letters", "_locked", "_n", "_od", "active", "packing", "refused")

    def __init__(self, od: "ObjectDictionary", n: int) -> None:
        self._od = od
        self._n = n
        self.active: "Active | None" = None
        self.refused = False  # what is stored is no record of this version (or of another number of gauges)
        self._generation = 0
        self._locked = False
        fields = table.staged(n)
        self._keys = [index << 8 | sub for index, sub, _kind in fields]
        self.packing = "<" + "".join([kind for _index, _sub, kind in fields])
        for index, _sub, _kind in fields:
            od.writers[index] = self._write_staged
        od.sizes[indices.CALIBRATION_STAGED_RECORD] = struct.calcsize(self.packing)
        od.readers[indices.CALIBRATION_FACTS] = self._read_facts
        od.readers[indices.CALIBRATION_CHECK] = self._read_check
        od.readers[indices.CALIBRATION_GUARD] = self._read_guard
        od.readers[indices.CALIBRATION_ACTIVE_RECORD] = lambda _sub: self.active_record()
        od.readers[indices.CALIBRATION_STAGED_RECORD] = lambda _sub: self.staged_record()
        od.writers[indices.CALIBRATION_GUARD] = self._write_guard
        od.writers[indices.CALIBRATION_STAGED_RECORD] = self._write_record

    def _pad(self) -> int:
        """Where 2110h:1 is among the fields."""
        return 4 * self._n + 4 + self._n * (self._n + 1) // 2

    def staged_record(self) -> bytes:
        """The staged record as one byte string (2141h)."""
        return struct.pack(self.packing, *[self._od.values[key] for key in self._keys])

    def active_record(self) -> bytes:
        """The active record (2140h); zeros on a node that was never calibrated."""
        return bytes(struct.calcsize(self.packing)) if self.active is None else self.active.record

    # --- storage --------------------------------------------------------------------------------------------

    def dump(self) -> bytes:
        """What 1010h:4 stores: the active record (nothing if there is none), the condition limit, the generation."""
        tail = struct.pack(_STORED_TAIL, self._od.values[_CONDITION_LIMIT], self._generation)
        return tail + (b"" if self.active is None else self.active.record)

    def restore(self, data: "bytes | None") -> None:
        """Take what was stored; None leaves the node uncalibrated, and so does another length: ``refused`` says so."""
        self.active = None
        self._generation = 0
        self._od.values[_EXPECTED_CRC] = 0
        self._od.values[_CONDITION_LIMIT] = self._od.default(indices.CALIBRATION_GUARD, 1)
        tail = struct.calcsize(_STORED_TAIL)
        self.refused = data is not None and len(data) not in (tail, tail + struct.calcsize(self.packing))
        if data is not None and not self.refused:
            self._od.values[_CONDITION_LIMIT], self._generation = struct.unpack(_STORED_TAIL, data[:tail])
            if len(data) > tail:
                self.active = self._unpack(data[tail:])
        self._stage(self.active_record())
        self.drop_old_mapping()

    def drop_old_mapping(self) -> None:
        """What was stored with a record of version 1 maps into TPDO4 what it carried then: its default holds."""
        if self.refused:
            self._od.restore_defaults(_HEALTH_MAPPING, _HEALTH_MAPPING)

    def _unpack(self, record: bytes) -> Active:
        return Active(record, list(struct.unpack(self.packing, record)), self._n)

    def _stage(self, record: bytes) -> None:
        for key, value in zip(self._keys, struct.unpack(self.packing, record)):  # noqa: B905
            self._od.values[key] = value

    # --- objects --------------------------------------------------------------------------------------------

    def _staged_matrix(self) -> "list[list[float]]":
        n = self._n
        values, first = self._od.values, indices.CALIBRATION_MATRIX << 8 | 1
        rows: "list[list[float]]" = [[values[first + row * n + k] for k in range(n)] for row in range(3)]  # type: ignore[misc]
        return rows

    def _read_facts(self, sub: int) -> "Value":
        return (
            condition_number(self._staged_matrix())
            if sub == 5
            else self._od.values[indices.CALIBRATION_FACTS << 8 | sub]
        )

    def _read_check(self, sub: int) -> "Value":
        if sub == 2:
            return crc32(self.staged_record())
        if sub == 3:
            return 0 if self.active is None else crc32(self.active.record)
        return self._generation if sub == 4 else self._od.values[indices.CALIBRATION_CHECK << 8 | sub]

    def _read_guard(self, sub: int) -> "Value":
        return int(self._locked) if sub == 2 else self._od.values[indices.CALIBRATION_GUARD << 8 | sub]

    def _write_staged(self, _sub: int, _value: "Value") -> int:
        return codes.DEVICE_STATE if self._locked else 0

    def _write_record(self, _sub: int, value: "Value") -> int:
        if self._locked:
            return codes.DEVICE_STATE
        fields = struct.unpack(self.packing, value)  # type: ignore[arg-type]
        if fields[self._pad() + 5] > 1:
            return codes.INVALID_VALUE  # 2110h:6 load sense, the one field with limits of its own
        self._stage(value)  # type: ignore[arg-type]
        return 0

    def _write_guard(self, sub: int, value: "Value") -> int:
        if sub == 3:
            if value != table.SIGNATURE_OPEN:
                return codes.NOT_TRANSFERRED
            self._locked = False
        elif self._locked and not (sub == 2 and value == 1):
            return codes.DEVICE_STATE
        elif sub == 2:
            self._locked = bool(value)
        return 0

    def commit(self, value: "Value") -> int:
        """2104h: activate the staged record, or refuse and change nothing."""
        if value != table.SIGNATURE_COMMIT:
            return codes.NOT_TRANSFERRED
        if self._locked:
            return codes.DEVICE_STATE
        record = self.staged_record()
        if self._od.values[_EXPECTED_CRC] != crc32(record):
            return codes.INCOMPATIBLE
        candidate, pad = struct.unpack(self.packing, record), self._pad()
        theta_min, theta_max, on, off = candidate[pad + 1 : pad + 5]
        if any(field - field != 0 for field in candidate) or theta_min > theta_max or off > on:
            return codes.INVALID_VALUE
        n = self._n
        if not _is_covariance(square(candidate[4 * n + 4 : pad], n)):
            return codes.INVALID_VALUE  # a negative variance would pass for no uncertainty at all
        calibrated, overload, coldest, hottest, model = candidate[pad + 6 : pad + 11]
        never_negative = (calibrated, overload, model, candidate[-1]) + candidate[pad + 11 : pad + 11 + n]
        if min(never_negative) < 0.0 or coldest > hottest:
            return codes.INVALID_VALUE
        largest, smallest = singular_range(self._staged_matrix())
        if smallest == 0.0 or not largest / smallest <= self._od.values[_CONDITION_LIMIT]:  # type: ignore[operator]
            return codes.TOO_HIGH
        if not NORM_MIN <= largest <= NORM_MAX:
            return codes.TOO_HIGH if largest > NORM_MAX else codes.TOO_LOW
        self.active = self._unpack(record)
        self._od.edited = True
        self._generation = (self._generation + 1) & 0xFFFFFFFF
        return 0
