"""A simulated node with a fake clock, its calibration and its SYNC, for the extreme cases.

Simple gauges: 100 microstrain per newton, so one count is 1 mN; gauges 1, 2, 3 respond to F1, F2, F3.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

from canopen_device.core import codes, communication
from canopen_device.core.node import Device
from canopen_device.testing import Conversation, MemoryStore
from tipforce.dictionary import indices, table, table_objects
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Source
from tipforce.sources.simulated import SimulatedSource

NODE_ID = 5
OPERATIONAL = bytes((codes.NMT_START, NODE_ID))
UNKNOWN = table.UNKNOWN_I16
PUSH = (1.0, 175.0, 10.0)
"""P, phi, theta: inside the friction cone of a push, theta in the middle of the pad."""
PERIOD_US = 500
_PDOS = tuple(base + NODE_ID for base in codes.TPDO_BASES[:2])

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
    packing = "<" + "".join(kind for _index, _sub, kind in table_objects.staged(n))
    return struct.pack(packing, *values, 1, 20240131, 23.0, 255, *noise, *tip[:5], int(tip[5]), *[0.0] * (7 + 2 * n))


class Talk(Conversation):
    """One device, OPERATIONAL, that sends only on SYNC. ``keep``: ``sent`` also has the frames of the start."""

    def __init__(self, device: Device, now_us: int = 1_000_000, keep: bool = False) -> None:
        super().__init__(device, now_us, emcy=True)
        self.put("H", communication.PRODUCER_HEARTBEAT, 0, 0)
        self.nmt(codes.NMT_START)
        if not keep:
            self.take()

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
        self.sent = [frame for frame in self.sent if frame[0] not in _PDOS]
        return Sync(one[:3], two[:3], one[3], one[4])

    def emcy(self) -> list[int]:
        """Return the codes of the EMCY messages sent since the last call."""
        found = [frame for frame in self.sent if frame[0] == codes.EMCY_BASE + NODE_ID]
        self.sent = [frame for frame in self.sent if frame[0] != codes.EMCY_BASE + NODE_ID]
        return [struct.unpack_from("<H", data)[0] for _, data in found]

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
    memory: MemoryStore | None = None,
) -> SimulatedTalk:
    """Return a calibrated simulated node; ``calibration`` is the record to commit, the matching one if None."""
    source = SimulatedSource(strain_per_newton(n), noise_microstrain, seed=7)
    source.load = load
    hooks = {} if memory is None else {"save": memory.save, "load": memory.load}
    talk = SimulatedTalk(fingertip_node(NODE_ID, source, n, serial=4711, **hooks), source)  # type: ignore[arg-type]
    abort = talk.stage(record(n) if calibration is None else calibration) or talk.commit()
    if abort:
        raise InputError(f"the calibration was refused: {abort:08X}")
    talk.take()
    return talk


def with_source(source: Source, n: int = 3) -> Talk:
    """Return a calibrated node with the given source."""
    talk = Talk(fingertip_node(NODE_ID, source, n))
    abort = talk.stage(record(n)) or talk.commit()
    if abort:
        raise InputError(f"the calibration was refused: {abort:08X}")
    talk.take()
    return talk


def forces(load: Load) -> tuple[float, float, float]:
    """Return F1, F2, F3 of a load P, phi, theta (degrees)."""
    P, phi, delta = load[0], math.radians(load[1]), math.radians(load[1] - load[2])
    return P * math.sin(phi), P * math.sin(delta), P * math.cos(phi)
