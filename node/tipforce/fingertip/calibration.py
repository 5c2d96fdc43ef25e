"""The calibration of a node (docs/objects.md): one staged record that SDO fills, one active that a commit replaces."""

import struct
from binascii import crc32

from canopen_device.core import codes, communication
from tipforce.dictionary import indices, table, table_objects
from tipforce.sensor.contact.scalar_condition import condition_number, singular_range, square

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.core.object_dictionary import ObjectDictionary, Value

    Force = tuple[float, float, float]
    Covariance = tuple[float, float, float, float, float, float]
    Solver = tuple[list[list[float]], Covariance]
    # rows and columns of scalar_redundancy, what chi-square must exceed for an alarm, and what excludes a gauge
    Check = tuple[list[list[float]], list[list[float] | None], float, float]


_MOST_LEFT = 12  # kept for gauges left out: memory stays bounded whatever gauges do


class Active:
    """One calibration: ``C`` (rows in N per strain), ``noise``, ``forces``, ``range_degC``, ``model`` (2112h), 2113h to
    2116h (the first two None where all zero). ``checked``: a sample has something to be judged by."""

    def __init__(self, record: bytes, values: "list[float]", n: int) -> None:
        self.record = record
        self.C = [values[row * n : row * n + n] for row in range(3)]
        parts, first = [], 3 * n
        for count in (n, 4, n * (n + 1) // 2, 6, 5, n, n, 2):  # 2101h, 2102h, 2106h, 2110h, 2112h to 2114h, the rest
            parts.append(values[first : first + count])
            first += count
        self.offsets, facts, self.noise, contact, validity, converter, per_kelvin, coefficients = parts
        self.reference_degC = facts[2]
        _radius, theta_min, theta_max, on, off, sense = contact
        self.limits = (on, off, theta_min, theta_max)
        self.pull = bool(sense)
        self.forces, self.range_degC, self.model = (validity[0], validity[1]), (validity[2], validity[3]), validity[4]
        self.converter = converter if any(converter) else None
        self.per_kelvin = per_kelvin if any(per_kelvin) else None
        self.gain_per_kelvin, self.redundancy = coefficients
        self.compensated = self.per_kelvin is not None or self.gain_per_kelvin != 0.0  # by temperature
        known = any(self.forces) or any(self.range_degC) or self.compensated
        self.checked = known or self.model > 0.0 or (n > 3 and self.redundancy > 0.0)
        self.left: "dict[int, tuple[Solver | None, Check | None]]" = {}  # of ``without``

    def without(self, lost: int) -> "tuple[Solver | None, Check | None]":
        """What solves, (matrix, covariance of F in N^2), and what judges the gauges without those of mask ``lost``, or
        None. 2116h is for n - 3 degrees of freedom: with fewer gauges the limit of the same false-alarm rate holds."""
        if lost not in self.left:
            if len(self.left) >= _MOST_LEFT:
                self.left.clear()
            n = len(self.offsets)
            solver = None if lost else (self.C, _propagate(self.C, self.noise, n))
            if lost and n > 3:
                from tipforce.sensor.contact import scalar_redundancy  # a node with three gauges does without

                solver = scalar_redundancy.leave_out(self.C, self.noise, [k for k in range(n) if lost >> k & 1])
            self.left[lost] = solver, self._check([k for k in range(n) if not lost >> k & 1], n)
        return self.left[lost]

    def _check(self, kept: "list[int]", n: int) -> "Check | None":
        if not self.redundancy > 0.0 or len(kept) < 4:
            return None
        from tipforce.sensor.contact import scalar_redundancy  # a node with three gauges does without

        W = scalar_redundancy.directions(self.C, self.noise, kept)
        if W is None:
            return None
        alarm = self.redundancy if len(kept) == n else scalar_redundancy.same_rate(self.redundancy, n - 3, len(W))
        exclusion = scalar_redundancy.same_rate(self.redundancy, n - 3, len(W) - 1)
        return W, scalar_redundancy.columns(W, self.noise), alarm, exclusion

    def strains(self, microstrains: "list[float]", kelvin: float) -> "list[float]":
        """Gauge strain with the offset taken off, and what so many kelvin from the reference add to it."""
        free = [1e-6 * m - o for m, o in zip(microstrains, self.offsets)]  # noqa: B905 (not in MicroPython)
        if self.per_kelvin is not None and kelvin != 0.0:
            free = [v - kelvin * c for v, c in zip(free, self.per_kelvin)]  # noqa: B905
        return free

    def force(self, matrix: "list[list[float]]", microstrains: "list[float]", kelvin: float = 0.0) -> "Force":
        """F1, F2, F3 in newtons before any tare: F = C (V - offset), V the gauge strain, compensated for ``kelvin``."""
        if len(microstrains) == 3 and kelvin == 0.0:  # the same sums, in half the time
            (a1, a2, a3), (b1, b2, b3), (c1, c2, c3) = matrix
            o1, o2, o3 = self.offsets
            v1, v2, v3 = 1e-6 * microstrains[0] - o1, 1e-6 * microstrains[1] - o2, 1e-6 * microstrains[2] - o3
            F1, F2 = 0.0 + a1 * v1 + a2 * v2 + a3 * v3, 0.0 + b1 * v1 + b2 * v2 + b3 * v3
            return F1, F2, 0.0 + c1 * v1 + c2 * v2 + c3 * v3
        F1 = F2 = F3 = 0.0
        V, (row1, row2, row3) = self.strains(microstrains, kelvin), matrix
        for v, c1, c2, c3 in zip(V, row1, row2, row3):  # noqa: B905
            F1 += c1 * v
            F2 += c2 * v
            F3 += c3 * v
        gain = 1.0 + self.gain_per_kelvin * kelvin
        return F1 / gain, F2 / gain, F3 / gain


def _propagate(C: "list[list[float]]", noise: "list[float]", n: int) -> "Covariance":
    full = square(noise, n)

    def product(a: "list[float]", b: "list[float]") -> float:
        return sum([a[i] * full[i][j] * b[j] for i in range(n) for j in range(n)])

    c1, c2, c3 = C
    return product(c1, c1), product(c1, c2), product(c1, c3), product(c2, c2), product(c2, c3), product(c3, c3)


CALIBRATION_GROUP = 4  # sub-index of 1010h and 1011h
_ROUNDING = 1e-5  # of variances: that of REAL32, with room for a node that works in single precision
_STORED_TAIL = "<fI"  # condition limit 2105h:1, generation 2103h:4
_HEALTH_MAPPING = communication.TPDO_MAPPING + 3  # of TPDO4
_LOAD_SENSE = indices.CONTACT_SETTINGS << 8 | 6
_CONDITION_LIMIT, _EXPECTED_CRC = indices.CALIBRATION_GUARD << 8 | 1, indices.CALIBRATION_CHECK << 8 | 1


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

    def __init__(self, od: "ObjectDictionary", n: int) -> None:
        self._od = od
        self._n = n
        self.active: "Active | None" = None
        self.refused = False  # what is stored is no record of this version (or of another number of gauges)
        self._generation = 0
        self._locked = False
        fields, guard = table_objects.staged(n), indices.CALIBRATION_GUARD
        self._keys = [index << 8 | sub for index, sub, _kind in fields]
        self.packing = "<" + "".join([kind for _index, _sub, kind in fields])
        for index, _sub, _kind in fields:
            od.writers[index] = lambda _sub, _value: codes.DEVICE_STATE if self._locked else 0
        od.sizes[indices.CALIBRATION_STAGED_RECORD] = struct.calcsize(self.packing)
        first = indices.CALIBRATION_FACTS << 8
        od.readers[indices.CALIBRATION_FACTS] = lambda sub: (
            condition_number(self._staged_matrix()) if sub == 5 else od.values[first | sub]
        )
        od.readers[indices.CALIBRATION_CHECK] = self._read_check
        od.readers[guard] = lambda sub: int(self._locked) if sub == 2 else od.values[guard << 8 | sub]
        od.readers[indices.CALIBRATION_ACTIVE_RECORD] = lambda _sub: self.active_record()
        od.readers[indices.CALIBRATION_STAGED_RECORD] = lambda _sub: self.staged_record()
        od.writers[guard] = self._write_guard
        od.writers[indices.CALIBRATION_STAGED_RECORD] = self._write_record

    def staged_record(self) -> bytes:
        """The staged record as one byte string (2141h)."""
        return struct.pack(self.packing, *[self._od.values[key] for key in self._keys])

    def active_record(self) -> bytes:
        """The active record (2140h); zeros on a node that was never calibrated."""
        return bytes(struct.calcsize(self.packing)) if self.active is None else self.active.record

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
                self._activate(data[tail:])
        self._stage(self.active_record())
        self.drop_old_mapping()

    def drop_old_mapping(self) -> None:
        """What was stored with a record of version 1 maps into TPDO4 what it carried then: its default holds."""
        if self.refused:
            self._od.restore_defaults(_HEALTH_MAPPING, _HEALTH_MAPPING)

    def _activate(self, record: bytes) -> None:
        self.active = Active(record, list(struct.unpack(self.packing, record)), self._n)

    def _stage(self, record: bytes) -> None:
        for key, value in zip(self._keys, struct.unpack(self.packing, record)):  # noqa: B905
            self._od.values[key] = value

    def _staged_matrix(self) -> "list[list[float]]":
        n = self._n
        values, first = self._od.values, indices.CALIBRATION_MATRIX << 8 | 1
        rows: "list[list[float]]" = [[values[first + row * n + k] for k in range(n)] for row in range(3)]  # type: ignore[misc]
        return rows

    def _read_check(self, sub: int) -> "Value":
        if sub == 2:
            return crc32(self.staged_record())
        if sub == 3:
            return 0 if self.active is None else crc32(self.active.record)
        return self._generation if sub == 4 else self._od.values[indices.CALIBRATION_CHECK << 8 | sub]

    def _write_record(self, _sub: int, value: "Value") -> int:
        if self._locked:
            return codes.DEVICE_STATE
        fields = struct.unpack(self.packing, value)  # type: ignore[arg-type]
        if fields[self._keys.index(_LOAD_SENSE)] > 1:
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
        candidate = struct.unpack(self.packing, record)
        if not self._is_allowed(candidate):
            return codes.INVALID_VALUE
        largest, smallest = singular_range(self._staged_matrix())
        if smallest == 0.0 or not largest / smallest <= self._od.values[_CONDITION_LIMIT]:  # type: ignore[operator]
            return codes.TOO_HIGH
        if not table.NORM_MIN <= largest <= table.NORM_MAX:
            return codes.TOO_HIGH if largest > table.NORM_MAX else codes.TOO_LOW
        self._activate(record)
        self._od.edited = True
        self._generation = (self._generation + 1) & 0xFFFFFFFF
        return 0

    def _is_allowed(self, candidate: "tuple[float, ...]") -> bool:
        """Finite, a covariance (a negative variance would pass for no uncertainty at all), of the table's order."""
        of = dict(zip(self._keys, candidate))  # noqa: B905 (not in MicroPython)
        for key, field in of.items():
            if field - field != 0:
                return False
            if field < 0.0 and (key in table.NOT_NEGATIVE or key & ~0xFF in table.NOT_NEGATIVE):
                return False
        for key, greatest in table.IN_ORDER:
            if of[key] > of[greatest]:
                return False
        noise = [of[key] for key in self._keys if key >> 8 == indices.CALIBRATION_NOISE]
        return _is_covariance(square(noise, self._n))
