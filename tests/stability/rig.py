"""A simulated node with a fake clock, and minimal SDO and SYNC clients for the extreme cases.

Simple gauges: 100 microstrain per newton, so one count is 1 mN; gauges 1, 2, 3 respond to F1, F2, F3.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from tipforce.device import codes, communication
from tipforce.device.node import Device
from tipforce.dictionary import indices, table
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Source
from tipforce.sources.simulated import SimulatedSource

NODE_ID = 5
UNKNOWN = table.UNKNOWN_I16
PUSH = (1.0, 175.0, 10.0)
"""P, phi, theta: inside the friction cone of a push, theta in the middle of the pad."""
PERIOD_US = 500
OPERATIONAL = bytes((codes.NMT_START, NODE_ID))
_PDOS = tuple(base + NODE_ID for base in codes.TPDO_BASES[:2])

Frame = tuple[int, bytes]
Matrix = Sequence[Sequence[float]]
Load = tuple[float, float, float]


class Sync(NamedTuple):
    """Values of TPDO1 and TPDO2 of one SYNC."""

    gauges: tuple[int, ...]
    """SG1, SG2, SG3, 0.1 microstrain."""
    contact: tuple[int, ...]
    """P in mN, phi and theta in 0.01 degree."""
    status: int
    counter: int


class Memory:
    """Store of a node; its bytes can be corrupted."""

    def __init__(self) -> None:
        self.blobs: dict[str, bytes] = {}

    def save(self, group: str, data: bytes) -> bool:
        """Store one group."""
        self.blobs[group] = data
        return True

    def load(self, group: str) -> bytes | None:
        """Return the stored groups."""
        return self.blobs.get(group)


def strain_per_newton(n: int = 3) -> list[list[float]]:
    """Return A: gauges 1, 2, 3 respond to F1, F2, F3; 4, 5, 6 to the same with opposite sign; 7, 8 equal 1, 2."""
    return [[(1e-4, -1e-4)[k // 3 % 2] if column == k % 3 else 0.0 for column in range(3)] for k in range(n)]


def matrix(n: int = 3) -> list[list[float]]:
    """Return C, N per unit strain: the mean over the gauges that respond to the same force."""
    rows = [[one[column] * 1e8 for one in strain_per_newton(n)] for column in range(3)]
    return [[value / sum(map(bool, row)) for value in row] for row in rows]


def record(
    n: int = 3,
    C: Matrix | None = None,
    offsets: Sequence[float] | None = None,
    variance: Sequence[float] | None = None,
    tip: Sequence[float] = (0.015, -60.0, 60.0, 0.05, 0.02, 0),
) -> bytes:
    """Return a complete record. ``variance``: upper triangle of the gauges' covariance; below one count if None.

    Its validity (2112h to 2116h) is not known, so no sample is judged by it.
    """
    rows = C if C is not None else matrix(n)
    noise = variance or [8.1e-15 if i == k else 0.0 for i in range(n) for k in range(i, n)]
    values = [value for row in rows for value in row] + list(offsets or [0.0] * n)
    packing = "<" + "".join(kind for _index, _sub, kind in table.staged(n))
    return struct.pack(packing, *values, 1, 20240131, 23.0, 255, *noise, *tip[:5], int(tip[5]), *[0.0] * (7 + 2 * n))


class Talk:
    """One device, OPERATIONAL, that sends only on SYNC. ``others`` holds frames that no call returned.

    ``keep``: also the frames sent at the start.
    """

    def __init__(self, device: Device, now_us: int = 1_000_000, keep: bool = False) -> None:
        self.device = device
        self.now_us = now_us
        self.due_us = 0
        self.others: list[Frame] = []
        self.step()
        self.put("H", communication.PRODUCER_HEARTBEAT, 0, 0)
        self.step([(codes.NMT_COB_ID, OPERATIONAL)])
        if not keep:
            self.others.clear()

    def step(self, frames: Iterable[Frame] = ()) -> list[Frame]:
        """Run one step; return the frames sent, which ``others`` also holds."""
        sent, self.due_us = self.device.step(self.now_us, frames)
        self.others += sent
        return sent

    def sync(self, after_us: int = 1000) -> Sync:
        """Send a SYNC after some time. Raises InputError if the two PDOs are missing, or of two samples."""
        self.now_us += after_us
        sent = dict(self.step([(codes.SYNC_COB_ID, b"")]))
        try:
            one, two = (struct.unpack("<hhhBB", sent.pop(can_id)) for can_id in _PDOS)
        except (KeyError, struct.error) as error:
            raise InputError(f"no pair of PDOs on SYNC: {error}") from None
        if one[3:] != two[3:]:
            raise InputError(f"two PDOs of one SYNC differ: {one[3:]}, {two[3:]}")
        self.others = [frame for frame in self.others if frame[0] not in _PDOS]
        return Sync(one[:3], two[:3], one[3], one[4])

    def emcy(self) -> list[int]:
        """Return the codes of the EMCY messages sent since the last call."""
        found = [frame for frame in self.others if frame[0] == codes.EMCY_BASE + NODE_ID]
        self.others = [frame for frame in self.others if frame[0] != codes.EMCY_BASE + NODE_ID]
        return [struct.unpack_from("<H", data)[0] for _, data in found]

    def _request(self, data: bytes) -> bytes:
        sent = self.step([(codes.SDO_REQUEST_BASE + NODE_ID, data)])
        answers = [data for can_id, data in sent if can_id == codes.SDO_RESPONSE_BASE + NODE_ID]
        self.others = [frame for frame in self.others if frame[0] != codes.SDO_RESPONSE_BASE + NODE_ID]
        if len(answers) != 1:
            raise InputError(f"{len(answers)} responses to one SDO request")
        return answers[0]

    def upload(self, index: int, sub: int = 0) -> bytes | int:
        """Upload at most four bytes by SDO; return the data or the abort code."""
        answer = self._request(struct.pack("<BHB4x", 0x40, index, sub))
        if answer[0] == 0x80:
            return int.from_bytes(answer[4:], "little")
        return answer[4 : 8 - (answer[0] >> 2 & 3)]

    def download(self, index: int, sub: int, data: bytes) -> int:
        """Write by SDO; return 0, or the abort code."""
        if 0 < len(data) <= 4:
            head = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub)
            return _abort(self._request(head + data + bytes(4 - len(data))))
        answer = self._request(struct.pack("<BHBI", 0x21, index, sub, len(data)))
        for offset in range(0, len(data), 7):
            if answer[0] == 0x80:
                break
            part = data[offset : offset + 7]
            command = (offset // 7 & 1) << 4 | (7 - len(part)) << 1 | (offset + 7 >= len(data))
            answer = self._request(bytes((command,)) + part + bytes(7 - len(part)))
        return _abort(answer)

    def get(self, kind: str, index: int, sub: int = 0) -> float:
        """Read a number by SDO; ``kind`` is struct's letter. Raises InputError for an abort."""
        data = self.upload(index, sub)
        if isinstance(data, int):
            raise InputError(f"{index:04X}h:{sub}: abort {data:08X}")
        value: float = struct.unpack("<" + kind, data)[0]
        return value

    def put(self, kind: str, index: int, sub: int, value: float) -> int:
        """Write a number by SDO; return 0, or the abort code."""
        return self.download(index, sub, struct.pack("<" + kind, value))

    def stage(self, data: bytes, crc: int | None = None) -> int:
        """Write the staged record and its CRC; return 0 or the abort code of the first refused write."""
        expected = binascii.crc32(data) if crc is None else crc
        refused = self.download(indices.CALIBRATION_STAGED_RECORD, 0, data)
        return refused or self.put("I", indices.CALIBRATION_CHECK, 1, expected)

    def commit(self) -> int:
        """Commit by 2104h; return 0 or the abort code."""
        return self.put("I", indices.CALIBRATION_COMMIT, 0, table.SIGNATURE_COMMIT)

    def active(self) -> tuple[int, int]:
        """Return CRC-32 and generation of the active calibration."""
        return int(self.get("I", indices.CALIBRATION_CHECK, 3)), int(self.get("I", indices.CALIBRATION_CHECK, 4))


class SimulatedTalk(Talk):
    """A rig with access to its simulated source."""

    def __init__(self, device: Device, source: SimulatedSource) -> None:
        super().__init__(device)
        self.source = source

    def break_gauge(self, fault: int, gauge: int = 1, magnitude: float = 0.0) -> None:
        """Inject a fault of 2200h."""
        self.source.set_fault(fault, gauge, magnitude, self.now_us)


def simulated(
    n: int = 3,
    load: Load = (0.0, 0.0, 0.0),
    calibration: bytes | None = None,
    noise_microstrain: float = 0.0,
    memory: Memory | None = None,
) -> SimulatedTalk:
    """Return a calibrated simulated node; ``calibration`` is the record to commit, the matching one if None."""
    source = SimulatedSource(strain_per_newton(n), noise_microstrain, seed=7)
    source.load = load
    hooks = {} if memory is None else {"save": memory.save, "load": memory.load}
    talk = SimulatedTalk(fingertip_node(NODE_ID, source, n, serial=4711, **hooks), source)  # type: ignore[arg-type]
    abort = talk.stage(record(n) if calibration is None else calibration) or talk.commit()
    if abort:
        raise InputError(f"the calibration was refused: {abort:08X}")
    talk.others.clear()
    return talk


def with_source(source: Source, n: int = 3) -> Talk:
    """Return a calibrated node with the given source."""
    talk = Talk(fingertip_node(NODE_ID, source, n))
    abort = talk.stage(record(n)) or talk.commit()
    if abort:
        raise InputError(f"the calibration was refused: {abort:08X}")
    talk.others.clear()
    return talk


def forces(load: Load) -> tuple[float, float, float]:
    """Return F1, F2, F3 of a load P, phi, theta (degrees)."""
    P, phi, delta = load[0], math.radians(load[1]), math.radians(load[1] - load[2])
    return P * math.sin(phi), P * math.sin(delta), P * math.cos(phi)


def _abort(answer: bytes) -> int:
    return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0
