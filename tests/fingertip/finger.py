"""A fingertip node with a simulated source whose numbers are easy: 100 microstrain per newton, so one count is 1 mN."""

import binascii
import math
import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from canopen_device.core.node import Device
from canopen_device.testing import Conversation, Frame
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Source
from tipforce.sources.simulated import SimulatedSource

NODE_ID = 5
COMMIT, OPEN, ZERO, TARA = 0x74696D63, 0x6E65706F, 0x6F72657A, 0x61726174
SAVE, LOAD = 0x65766173, 0x64616F6C
UNKNOWN = -0x8000
HUSHED = (UNKNOWN,) * 3
CONTACT, CALIBRATED, SATURATED, STALE, UNRESOLVED, MISSES, OUTSIDE, FAULT = (1 << bit for bit in range(8))
PUSH = (1.0, 175.0, 10.0)  # P, phi, theta: within the friction cone of a push, theta in the middle of the pad
PERIOD_US = 500
_PDOS = (0x180 + NODE_ID, 0x280 + NODE_ID)

Matrix = Sequence[Sequence[float]]
Load = tuple[float, float, float]


def strain_per_newton(n: int = 3) -> list[list[float]]:
    """Gauges 1, 2, 3 see F1, F2, F3; 4, 5, 6 the same compressed; 7, 8 are again like 1, 2."""
    return [[(1e-4, -1e-4)[k // 3 % 2] if column == k % 3 else 0.0 for column in range(3)] for k in range(n)]


def matrix(n: int = 3) -> list[list[float]]:
    """C, N per strain: the mean over the gauges that see the same force."""
    C = [[row[column] * 1e8 for row in strain_per_newton(n)] for column in range(3)]
    return [[value / sum(map(bool, row)) for value in row] for row in C]


def forces(load: Load) -> Load:
    P, phi, delta = load[0], math.radians(load[1]), math.radians(load[1] - load[2])
    return P * math.sin(phi), P * math.sin(delta), P * math.cos(phi)


def packing(n: int = 3) -> str:
    """The calibration record as docs/objects.md gives it, written a second time."""
    return f"<{3 * n}f{n}fIIfB{n * (n + 1) // 2}f5fB5f{n}f{n}f2f"


def record(
    n: int = 3, C: Matrix | None = None, offsets: Sequence[float] | None = None, serial: int = 1,
    noise_strain: float = 9e-8, variance: Sequence[float] | None = None,
    tip: Sequence[float] = (0.015, -60.0, 60.0, 0.05, 0.02, 0), validity: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    converter_limit: float = 0.0, offset_per_K: float = 0.0, gain_per_K: float = 0.0, redundancy_limit: float = 0.0,
) -> bytes:  # fmt: skip
    """A complete record; ``tip`` is 2110h, ``validity`` 2112h. Noise below one count: a source without is not frozen.

    ``variance`` is the upper triangle of the gauges' covariance, in place of ``noise_strain``. The fields of version 2
    are those of a calibration that does not know them."""
    rows = C if C is not None else matrix(n)
    variance = variance or [noise_strain**2 if i == k else 0.0 for i in range(n) for k in range(i, n)]
    values = [value for row in rows for value in row] + list(offsets or [0.0] * n)
    values += [serial, 20240131, 23.0, 255, *variance, *tip[:5], int(tip[5]), *validity]
    values += [converter_limit] * n + [offset_per_K] * n + [gain_per_K, redundancy_limit]
    return struct.pack(packing(n), *values)


def flipped(data: bytes, bit: int) -> bytes:
    """Data with one wrong bit."""
    return data[: bit // 8] + bytes((data[bit // 8] ^ 1 << bit % 8,)) + data[bit // 8 + 1 :]


class Pdos(NamedTuple):
    """TPDO1 and TPDO2 of one SYNC."""

    gauges: tuple[int, ...]
    """SG1, SG2, SG3, 0.1 microstrain."""
    contact: tuple[int, ...]
    """P in mN, phi and theta in 0.01 degree."""
    status: int
    counter: int


def pdos_of(frames: Iterable[Frame]) -> Pdos:
    """What a node's TPDO1 and TPDO2 among frames carry; both must have the same status and counter."""
    found = dict(frames)
    one, two = (struct.unpack("<hhhBB", found[can_id]) for can_id in _PDOS)
    assert one[3:] == two[3:]
    return Pdos(one[:3], two[:3], one[3], one[4])


class Finger(Conversation):
    """A conversation with a fingertip in OPERATIONAL that sends no heartbeat."""

    def __init__(self, device: Device, source: Any = None, emcy: bool = False) -> None:
        super().__init__(device, now_us=1_000_000, emcy=emcy)
        self.source = source
        assert self.sent.pop(0) == (0x700 + NODE_ID, b"\0")
        assert self.put("H", 0x1017, 0, 0) == 0
        self.nmt(1)

    def frames(self, after_us: int = 1000, data: bytes = b"") -> dict[int, bytes]:
        """What a SYNC after some time brings, by COB-ID."""
        self.now_us += after_us
        self.step([(0x80, data)])
        return dict(self.take())

    def sync(self, after_us: int = 1000) -> Pdos:
        """What a SYNC after some time brings in TPDO1 and TPDO2."""
        self.now_us += after_us
        sent = self.step([(0x80, b"")])
        self.sent = [frame for frame in self.sent if frame[0] not in _PDOS]
        return pdos_of(sent)

    def emcy(self) -> list[int]:
        """The codes of the EMCY messages since the last call, of a conversation that shows them."""
        found = [data for can_id, data in self.sent if can_id == 0x80 + NODE_ID]
        self.sent = [frame for frame in self.sent if frame[0] != 0x80 + NODE_ID]
        return [struct.unpack_from("<H", data)[0] for data in found]

    def break_gauge(self, fault: int, gauge: int = 1, magnitude: float = 0.0) -> None:
        """A fault of 2200h, without the object."""
        self.source.set_fault(fault, gauge, magnitude, self.now_us)

    def stage(self, data: bytes, crc: int | None = None) -> int:
        """Write the staged record and its expected CRC: 0 or the abort code."""
        expected = binascii.crc32(data) if crc is None else crc
        return self.download(0x2141, 0, data) or self.put("I", 0x2103, 1, expected)

    def commit(self, signature: int = COMMIT) -> int:
        return self.put("I", 0x2104, 0, signature)

    def calibration(self) -> tuple[bytes | int, int, int]:
        """Active record, its CRC, generation."""
        return self.upload(0x2140), int(self.get("I", 0x2103, 3)), int(self.get("I", 0x2103, 4))

    def channels(self, n: int = 3) -> list[float]:
        return [self.get("f", 0x6130, sub) for sub in range(1, n + 7)]


def finger(
    n: int = 3, calibrated: bool | bytes = True, load: Load = (0.0, 0.0, 0.0), noise_microstrain: float = 0.0,
    store: Any = None, offset_microstrain: Sequence[float] | None = None, source: Source | None = None,
    emcy: bool = False,
) -> Finger:  # fmt: skip
    """A simulated fingertip, or one with a source; ``calibrated`` may be the record to commit."""
    if source is None:
        source = SimulatedSource(strain_per_newton(n), noise_microstrain, offset_microstrain, seed=7)
        source.load = load
    hooks = {} if store is None else {"save": store.save, "load": store.load}
    talk = Finger(fingertip_node(NODE_ID, source, n, serial=4711, **hooks), source, emcy)
    if calibrated:
        assert talk.stage(calibrated if isinstance(calibrated, bytes) else record(n)) == 0
        assert talk.commit() == 0
    return talk


def filtered(kind: int, constant: int, **options: Any) -> Finger:
    """A finger with one filter for all gauges."""
    talk = finger(**options)
    assert talk.put("H", 0x61A1, 1, constant) == talk.put("B", 0x61A0, 1, kind) == 0
    return talk
