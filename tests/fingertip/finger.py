"""A fingertip node with a simulated source whose numbers are easy: 100 microstrain per newton, so one count is 1 mN."""

import binascii
import struct
from collections.abc import Sequence
from typing import NamedTuple

from canopen_device.core.node import Device
from canopen_device.testing import Conversation, MemoryStore
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

COMMIT, OPEN, ZERO, TARA = 0x74696D63, 0x6E65706F, 0x6F72657A, 0x61726174
SAVE, LOAD = 0x65766173, 0x64616F6C
UNKNOWN = -0x8000
CONTACT, CALIBRATED, SATURATED, STALE, UNRESOLVED, MISSES, OUTSIDE, FAULT = (1 << bit for bit in range(8))
PUSH = (1.0, 175.0, 10.0)  # P, phi, theta: within the friction cone of a push, theta in the middle of the pad
PERIOD_US = 500

Matrix = Sequence[Sequence[float]]


def strain_per_newton(n: int = 3) -> list[list[float]]:
    """Gauges 1, 2, 3 see F1, F2, F3; 4, 5, 6 the same compressed; 7, 8 are again like 1, 2."""
    return [[(1e-4, -1e-4)[k // 3 % 2] if column == k % 3 else 0.0 for column in range(3)] for k in range(n)]


def matrix(n: int = 3) -> list[list[float]]:
    """C, N per strain: the mean over the gauges that see the same force."""
    C = [[row[column] * 1e8 for row in strain_per_newton(n)] for column in range(3)]
    return [[value / sum(map(bool, row)) for value in row] for row in C]


def packing(n: int = 3) -> str:
    """The calibration record as docs/objects.md gives it, written a second time."""
    return f"<{3 * n}f{n}fIIfB{n * (n + 1) // 2}f5fB5f{n}f{n}f2f"


def record(
    n: int = 3,
    C: Matrix | None = None,
    offsets: Sequence[float] | None = None,
    serial: int = 1,
    noise_strain: float = 9e-8,
    tip: Sequence[float] = (0.015, -60.0, 60.0, 0.05, 0.02, 0),
    validity: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    converter_limit: float = 0.0,
    offset_per_K: float = 0.0,
    gain_per_K: float = 0.0,
    redundancy_limit: float = 0.0,
) -> bytes:
    """A complete record; ``tip`` is 2110h, ``validity`` 2112h. Noise below one count: a source without is not frozen.

    The fields of version 2 are those of a calibration that does not know them.
    """
    rows = C if C is not None else matrix(n)
    variance = [noise_strain**2 if i == k else 0.0 for i in range(n) for k in range(i, n)]
    values = [value for row in rows for value in row] + list(offsets or [0.0] * n)
    values += [serial, 20240131, 23.0, 255, *variance, *tip[:5], int(tip[5]), *validity]
    values += [converter_limit] * n + [offset_per_K] * n + [gain_per_K, redundancy_limit]
    return struct.pack(packing(n), *values)


class Pdos(NamedTuple):
    """TPDO1 and TPDO2 of one SYNC."""

    gauges: tuple[int, ...]
    contact: tuple[int, ...]
    status: int
    counter: int


class Finger(Conversation):
    """A conversation with a fingertip in OPERATIONAL that sends no heartbeat."""

    def __init__(self, device: Device, source: SimulatedSource) -> None:
        super().__init__(device, now_us=1_000_000)
        self.source = source
        self.say("< 705#00")
        assert self.put("H", 0x1017, 0, 0) == 0
        self.say("> 000#0105")

    def frames(self, after_us: int = 1000, data: bytes = b"") -> dict[int, bytes]:
        """What a SYNC after some time brings, by COB-ID."""
        self.now_us += after_us
        self.step([(0x80, data)])
        return dict(self.take())

    def sync(self, after_us: int = 1000) -> Pdos:
        """A SYNC after some time; both TPDOs must carry the same status and counter."""
        sent = self.frames(after_us)
        assert sorted(sent) == [0x185, 0x285]
        one, two = (struct.unpack("<hhhBB", sent[can_id]) for can_id in (0x185, 0x285))
        assert one[3:] == two[3:]
        return Pdos(one[:3], two[:3], one[3], one[4])

    def stage(self, data: bytes, crc: int | None = None) -> None:
        """Write the staged record and its expected CRC."""
        assert self.download(0x2141, 0, data) == 0
        assert self.put("I", 0x2103, 1, binascii.crc32(data) if crc is None else crc) == 0

    def commit(self, signature: int = COMMIT) -> int:
        """2104h: 0 or the abort code."""
        return self.put("I", 0x2104, 0, signature)

    def calibration(self) -> tuple[bytes | int, float, float]:
        """Active record, its CRC, generation."""
        return self.upload(0x2140), self.get("I", 0x2103, 3), self.get("I", 0x2103, 4)

    def channels(self, n: int = 3) -> list[float]:
        """6130h of all channels."""
        return [self.get("f", 0x6130, sub) for sub in range(1, n + 7)]


def finger(
    n: int = 3,
    calibrated: bool | bytes = True,
    load: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise_microstrain: float = 0.0,
    store: MemoryStore | None = None,
    offset_microstrain: Sequence[float] | None = None,
) -> Finger:
    """A simulated fingertip; ``calibrated`` may be the record to commit."""
    source = SimulatedSource(strain_per_newton(n), noise_microstrain, offset_microstrain, seed=7)
    source.load = load
    hooks = {} if store is None else {"save": store.save, "load": store.load}
    talk = Finger(fingertip_node(5, source, n, serial=4711, **hooks), source)  # type: ignore[arg-type]
    if calibrated:
        talk.stage(calibrated if isinstance(calibrated, bytes) else record(n))
        assert talk.commit() == 0
    return talk
