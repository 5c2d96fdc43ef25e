"""Logs from raw bytes, seeded and independent of the product: fingertips and other devices, with faults."""

from __future__ import annotations

import gzip
import random
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
import numpy.typing as npt
import zstandard

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
MICROSTRAIN_PER_NEWTON = (
    (68.6, -137.2, -0.61), (68.6, 137.2, 0.61), (0.75, 103.0, -104.3), (0.75, -103.0, 104.3), (-68.6, 68.6, -0.61),
    (-68.6, -68.6, 0.61), (0.75, -103.0, 1.37), (0.75, 103.0, -1.37),
)  # fmt: skip
"""Of F1, F2, F3 at eight places of gauges."""

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """One frame of a log. ``flags`` of CAN FD; None: classic."""

    t_ns: int
    can_id: int
    data: bytes
    channel: str = "can0"
    flags: int | None = None
    remote: bool = False

    def line(self) -> str:
        """The frame as candump -L writes it; identifiers over 11 bits have 8 digits."""
        name = f"{self.can_id:08X}" if self.can_id > 0x7FF else f"{self.can_id:03X}"
        text = "#R" if self.remote else f"#{self.data.hex().upper()}"
        text = f"##{self.flags:X}{self.data.hex().upper()}" if self.flags is not None else text
        return f"({self.t_ns // 10**9}.{self.t_ns // 1000 % 10**6:06d}) {self.channel} {name}{text}\n"


@dataclass
class Hand:
    """Traffic of fingertips: ``modulus`` numbers the SYNC, 0 does not, None sends none (event-driven PDOs)."""

    seed: int
    nodes: tuple[int, ...] = (5,)
    gauges: int = 3
    pdos: tuple[str, ...] = ("gauges", "contact")
    modulus: int | None = 0
    syncs: int = 400
    period_ms: float = 2.0
    lost: float = 0.02
    doubled: float = 0.01
    late: float = 0.02
    stale: float = 0.02
    restart_at: tuple[int, ...] = ()
    services: bool = True
    channel: str = "can0"
    start_ns: int = START_NS

    def frames(self) -> list[Frame]:
        """All frames in the order of the bus."""
        pick = self._pick = random.Random(self.seed)
        number, found = 0, []
        counters = dict.fromkeys(self.nodes, 250)
        self._faults = dict.fromkeys(self.nodes, 0)
        for k in range(self.syncs):
            t_ns = self.start_ns + round(k * self.period_ms * MS) + pick.randrange(2000) * 1000
            number = 1 if k in self.restart_at else number % (self.modulus or 256) + 1
            unheard = pick.random() < self.lost / 4
            if self.modulus is not None and not unheard:
                found.append(self._frame(t_ns, 0x80, bytes((number,)) if self.modulus else b""))
            for node in self.nodes:
                if self.modulus is None and node == self.nodes[-1] and 100 <= k < 160:
                    continue  # silent for longer than a value is shown
                stale = pick.random() < self.stale
                counters[node] += not stale
                counter = number if self.modulus else counters[node] % 256
                found += self._answers(t_ns + 100_000, node, counter, stale)
            if self.services:
                found += self._services(t_ns + 900_000, k)
        found.sort(key=lambda frame: frame.t_ns)
        return found

    def _frame(self, t_ns: int, can_id: int, data: bytes) -> Frame:
        return Frame(t_ns // 1000 * 1000, can_id, data, self.channel)

    def _words(self, node: int, counter: int, stale: bool) -> dict[str, tuple[int, bytes]]:
        """The PDOs of one latch by name: COB-ID without the node-id, and data."""
        pick = self._pick
        P, phi, theta = pick.uniform(0, 8), pick.uniform(-180, 180), pick.uniform(0, 180)
        if pick.random() < 0.3:
            P = 0.0
        turn = np.radians((phi, phi - theta))
        force = (P * np.sin(turn[0]), P * np.sin(turn[1]), P * np.cos(turn[0]))
        strains = [round(10 * sum(a * f for a, f in zip(row, force, strict=True))) for row in MICROSTRAIN_PER_NEWTON]
        strains = [value + 10 * (12 - 3 * n) + pick.randint(-8, 8) for n, value in enumerate(strains)]
        if self.gauges > 3 and pick.random() < 0.1:
            strains[pick.randrange(self.gauges)] += pick.randint(-100, 100)  # around what contradicts the other gauges
        status = 0x02 | (P > 0.05) | (0x08 if stale else 0) | (0x80 if self._faults[node] & 0xFFF else 0)
        if P and pick.random() < 0.05:
            status |= pick.choice((0x10, 0x20, 0x40))
        if pick.random() < 0.03:
            status, strains[0] = status | 0x04, pick.choice((32767, -32767))
        unknown = status & 0x8C or not status & 2
        values = [round(1000 * P), round(100 * phi), round(100 * theta)]
        values = [
            -32768 if unknown or (at and not status & 1) or (at == 2 and status & 0x30) else value
            for at, value in enumerate(values)
        ]
        newtons = [-32768 if unknown else round(1000 * value) for value in force]
        if status & 0x88:
            strains = [-32768] * 8
        tail = bytes((status, counter))
        u_P = 0xFFFF if unknown else pick.randint(3, 40)
        return {
            "gauges": (0x180, struct.pack("<3h", *strains[:3]) + tail),
            "contact": (0x280, struct.pack("<3h", *values) + tail),
            "force": (0x380, struct.pack("<3h", *newtons) + tail),
            "gauges46": (0x1C0, struct.pack(f"<{min(self.gauges, 6) - 3}h", *strains[3 : min(self.gauges, 6)]) + tail),
            "gauges78": (0x240, struct.pack(f"<{max(self.gauges - 6, 0)}h", *strains[6 : max(self.gauges, 6)]) + tail),
            "health": (0x480, struct.pack("<hHHBB", pick.randint(2000, 2600), u_P, self._faults[node], 7, 0)),
            "remapped": (0x280, struct.pack("<iBB", -(2**31) if unknown else values[0], status, counter)),
        }

    def _answers(self, t_ns: int, node: int, counter: int, stale: bool) -> Iterator[Frame]:
        """The PDOs of one latch: some are lost, doubled, or later than the next SYNC."""
        pick = self._pick
        late_ns = round(self.period_ms * MS) if pick.random() < self.late else 0
        words = self._words(node, counter, stale)
        for at, name in enumerate(self.pdos):
            if name == "health" and counter % 25:
                continue
            base, data = words[name]
            if pick.random() < self.lost:
                continue
            if at and name in ("contact", "force") and pick.random() < 0.01:
                data = data[:6] + bytes((data[6] ^ 0x40, data[7]))  # not as the PDO before says
            if self.modulus is None and pick.random() < 0.05:
                late_ns += pick.choice((150, 190, 210, 400)) * MS  # around the longest gap within a sample
            yield self._frame(t_ns + late_ns + 120_000 * at + node * 1000, base + node, data)
            if pick.random() < self.doubled:
                yield self._frame(t_ns + 300_000 + 120_000 * at, base + node, data)

    def _services(self, t_ns: int, k: int) -> Iterator[Frame]:
        """Heartbeats, and now and then EMCY, NMT, boot-up, SDO, LSS, a frame of nobody, and one that is too short."""
        pick, node = self._pick, self._pick.choice(self.nodes)
        if k % 50 == 0:
            for at in self.nodes:
                yield self._frame(t_ns, 0x700 + at, bytes((0x05,)))
        if pick.random() < 0.02:
            code, bit = pick.choice(((0x5030, 12), (0x4210, 14), (0x5020, 15), (0x5010, 1), (0x5030, 8), (0, 0)))
            self._faults[node] = 1 << bit if code else 0
            detail = bytes((2, bit, 0, 0, 0)) if code else bytes(5)
            yield self._frame(t_ns, 0x80 + node, struct.pack("<HB", code, 0x81 if code else 0) + detail)
        if pick.random() < 0.006:
            yield self._frame(t_ns, 0x700 + node, b"\x00")
            yield self._frame(t_ns + 1000, 0, bytes((1, node)))
            yield self._frame(t_ns + 2000, 0x700 + node, b"\x05")
        requests = (
            "4018100200000000",
            "2304210063 6D6974",
            "2B17100064000000",
            "4003210300000000",
            "80402100 00000805",
        )
        answers = ("4318100203015054", "6004210000000000", "6017100000000000", "43032103 78563412", "8040210004000006")
        if pick.random() < 0.02:
            at = pick.randrange(len(requests))
            yield self._frame(t_ns + 3000, 0x600 + node, bytes.fromhex(requests[at]))
            yield self._frame(t_ns + 4000, 0x580 + node, bytes.fromhex(answers[at]))
        if pick.random() < 0.02:
            strange = (
                (0x7E5, "4B00000000000000"),
                (0x123, "0102"),
                (0x280 + node, "0102030405"),
                (0x100, "00112233"),
                (0x280 + 99, "0011223344556677"),
            )
            can_id, text = pick.choice(strange)
            yield self._frame(t_ns + 5000, can_id, bytes.fromhex(text))


def other_devices(seed: int) -> list[Frame]:
    """A device of ``lamp.eds`` (node 7), a drive of CiA 402 (node 6), and a remapping of TPDO1 of node 7 by SDO."""
    pick, found = random.Random(seed), []
    for k in range(200):
        t_ns = START_NS + k * 5 * MS
        found.append(Frame(t_ns, 0x80, b""))
        remapped = 100 <= k < 150
        data = struct.pack("<fBb", pick.uniform(-2, 2), pick.randrange(256), pick.randrange(-128, 128))
        found.append(Frame(t_ns + 100_000, 0x187, struct.pack("<H", pick.randrange(1000)) if remapped else data))
        found.append(Frame(t_ns + 200_000, 0x186, struct.pack("<Hb", pick.choice((0x250, 0x237, 0x1637)), 1)))
        found.append(Frame(t_ns + 300_000, 0x286, struct.pack("<ii", k * 100, pick.randrange(-500, 500))))
        if k == 100:
            writes = (
                "23001801870100C0",
                "2F001A0000000000",
                "23001A0110000120",
                "2F001A0001000000",
                "2300180187010040",
            )
            for at, text in enumerate(writes):
                found.append(Frame(t_ns + 400_000 + at * 20_000, 0x607, bytes.fromhex(text)))
                found.append(Frame(t_ns + 410_000 + at * 20_000, 0x587, bytes.fromhex("60" + text[2:8] + "00000000")))
        if k == 150:
            found.append(Frame(t_ns - 100_000, 0x707, b"\x00"))
    return found


def strange_frames(seed: int) -> list[Frame]:
    """Two interfaces, 29-bit identifiers, CAN FD, remote and error frames around the PDOs of the same node-id."""
    found = Hand(seed, (5, 6), channel="can0", syncs=150).frames()
    found += Hand(seed + 1, (5,), channel="vcan1", modulus=240, pdos=("contact", "health"), syncs=150).frames()
    pick = random.Random(seed)
    for k in range(60):
        t_ns, channel = START_NS + k * 5 * MS + 7000, pick.choice(("can0", "vcan1"))
        kind = k % 4
        if kind == 0:
            found.append(Frame(t_ns, 0x18FF0285, pick.randbytes(8), channel))
        elif kind == 1:
            found.append(
                Frame(t_ns, 0x285, pick.randbytes(pick.choice((8, 12, 64))), channel, flags=pick.choice((0, 1, 3)))
            )
        elif kind == 2:
            found.append(Frame(t_ns, 0x285, b"", channel, remote=True))
        else:
            found.append(Frame(t_ns, 0x20000000 | 1 << pick.randrange(9), pick.randbytes(8), channel))
    return sorted(found, key=lambda frame: frame.t_ns)


def text(frames: Iterable[Frame]) -> str:
    """The frames as candump -L writes them."""
    return "".join(frame.line() for frame in frames)


def spoiled(lines: str, seed: int) -> bytes:
    """Lines of which one in twenty is cut, changed, doubled, or has bytes that are no text."""
    pick, found = random.Random(seed), []
    for line in lines.encode().splitlines():
        if pick.random() < 0.05:
            at = pick.randrange(len(line))
            begin, end = line[:at], line[at:]
            ways = (begin, begin + b"\xff\x00" + end, begin + b"?" + end[1:], b"", line + line, b"# a remark")
            found.append(pick.choice(ways))
        else:
            found.append(line)
        found.append(pick.choice((b"\n",) * 20 + (b"\r\n",)))
    return b"".join(found)


def screen(frames: Iterable[Frame]) -> str:
    """The frames as candump prints them with -ta."""
    return "".join(
        f" ({frame.t_ns // 10**9}.{frame.t_ns // 1000 % 10**6:06d})  {frame.channel}  {frame.can_id:03X}"
        f"   [{len(frame.data)}]  {' '.join(f'{byte:02X}' for byte in frame.data)}\n"
        for frame in frames
    )


def pcap(frames: Iterable[Frame]) -> bytes:
    """LINKTYPE_CAN_SOCKETCAN (227), nanoseconds."""
    found = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 227)
    for frame in frames:
        can_id = frame.can_id | (0x80000000 if 0x7FF < frame.can_id < 0x20000000 else 0)
        body = struct.pack(">IBBBB", can_id, len(frame.data), 0, 0, 0) + frame.data
        found += struct.pack("<IIII", frame.t_ns // 10**9, frame.t_ns % 10**9, len(body), len(body)) + body
    return found


def by_library(path: Path, frames: Iterable[Frame]) -> None:
    """Write a log with python-can, in the format of the suffix."""
    with can.Logger(path) as writer:
        for frame in frames:
            message = can.Message(
                frame.t_ns / 1e9, frame.can_id, is_extended_id=frame.can_id > 0x7FF, data=frame.data, channel="can0",
                is_rx=True,
            )  # fmt: skip
            writer.on_message_received(message)


def write_logs(folder: Path) -> None:
    """All logs of the golden outputs."""
    every = ("gauges", "contact", "force", "health")
    hands = {
        "one": Hand(1, syncs=1500, pdos=("gauges", "contact", "health")),
        "contact": Hand(2, (1, 2, 3, 4, 5), pdos=("contact",)),
        "unnumbered": Hand(3, (1, 2, 3, 4, 5), pdos=every, lost=0.05, late=0.05),
        "numbered": Hand(4, (1, 2, 3, 4, 5), pdos=every, modulus=240, lost=0.05, late=0.05),
        "restarted": Hand(5, (1, 2, 3), pdos=("gauges", "contact"), modulus=20, restart_at=(130, 137, 255), lost=0.08),
        "events": Hand(6, (9, 127), pdos=("contact", "health"), modulus=None, period_ms=13.7, lost=0.1),
        "remapped": Hand(7, (5,), pdos=("gauges", "remapped")),
        "quiet": Hand(8, (3,), lost=0, doubled=0, late=0, stale=0, services=False),
        "midnight": Hand(9, (1, 2), start_ns=START_NS + 5_999_500 * MS, period_ms=5.0, syncs=300),
    }
    for gauges in range(4, 9):
        more = ("gauges46", "gauges78")[: 1 + (gauges > 6)]
        pdos = ("gauges", *more, "contact", "health") if gauges == 7 else ("gauges", "contact", *more, "health")
        hands[f"gauges{gauges}"] = Hand(20 + gauges, (5, 6), gauges, pdos, 240 * (gauges % 2))
    frames = {name: hand.frames() for name, hand in hands.items()}
    frames["devices"], frames["strange"] = other_devices(10), strange_frames(11)
    for name, found in frames.items():
        (folder / f"{name}.log").write_text(text(found))
    one, lines = frames["one"], text(frames["one"])
    (folder / "one.log.gz").write_bytes(gzip.compress(lines.encode(), mtime=0))
    (folder / "one.log.zst").write_bytes(zstandard.compress(lines.encode()))
    (folder / "bad.log").write_bytes(spoiled(lines, 12))
    (folder / "screen.log").write_text(screen(one))
    (folder / "numbered.pcap").write_bytes(pcap(frames["numbered"]))
    (folder / "part-1.log").write_text("".join(lines.splitlines(True)[:1234]))
    (folder / "part-2.log").write_text("".join(lines.splitlines(True)[1234:]))
    (folder / "back.log").write_text(lines + text(frames["quiet"]))
    (folder / "cut.log.gz").write_bytes((folder / "one.log.gz").read_bytes()[:-2000])
    (folder / "foreign.log").write_text(text(f for f in frames["strange"] if f.can_id > 0x7FF))
    for suffix in ("asc", "blf", "csv", "trc", "db"):
        by_library(folder / f"one.{suffix}", one)
    write_large(folder / "large.log", 300_000, 5)


def write_large(path: Path, count: int, nodes: int, modulus: int = 0) -> None:
    """A log of ``count`` frames: SYNC, TPDO1, TPDO2 of nodes and a foreign frame in each cycle, made in blocks.

    ``modulus``: of the numbers of SYNC; 0: it has none.
    """
    cycle = np.array(
        [0x80, *(base + k for k in range(1, nodes + 1) for base in (0x180, 0x280)), 0x5C0], dtype=np.uint32
    )
    with path.open("wb") as file:
        for start in range(0, count, 200_000):
            file.write(_block(np.arange(start, min(start + 200_000, count)), cycle, modulus))


def _block(number: npt.NDArray[np.int64], cycle: npt.NDArray[np.uint32], modulus: int) -> bytes:
    pick, count = np.random.default_rng(int(number[0])), len(number)
    can_id = cycle[number % len(cycle)]
    t_us = START_NS // 1000 + number // len(cycle) * 2000 + number % len(cycle) * (2000 // (len(cycle) + 1))
    values = pick.integers(-32767, 32768, (count, 3), dtype=np.int16)
    special = pick.random((count, 3)) < 0.05
    values[special] = pick.choice(np.array([-32768, 32767, -32767, 0], dtype=np.int16), int(special.sum()))
    data: Bytes = np.zeros((count, 8), dtype=np.uint8)
    data[:, :6] = values.view(np.uint8)
    data[:, 6] = pick.choice(np.array([3, 2, 0, 11, 0x83], dtype=np.uint8), count)
    data[:, 7] = number // len(cycle) % (modulus or 256) + (modulus > 0)
    if modulus:
        data[can_id == 0x80, 0] = data[can_id == 0x80, 7]
    length = np.where(can_id == 0x80, int(modulus > 0), np.where(can_id == 0x5C0, pick.integers(0, 9, count), 8))
    digits = np.frombuffer(b"0123456789ABCDEF", dtype=np.uint8)
    text: Bytes = np.empty((count, 46), dtype=np.uint8)
    text[:] = np.frombuffer(b"(0000000000.000000) can0 000#".ljust(46, b"\n"), dtype=np.uint8)
    for at, power in [(k + 1, 15 - k) for k in range(10)] + [(k + 12, 5 - k) for k in range(6)]:
        text[:, at] = ord("0") + t_us // 10**power % 10
    for at, shift in ((25, 8), (26, 4), (27, 0)):
        text[:, at] = digits[can_id >> shift & 15]
    text[:, 29:45:2], text[:, 30:45:2] = digits[data >> 4], digits[data & 15]
    ends = 29 + 2 * length
    text[np.arange(count), ends] = ord("\n")
    return text[np.arange(46) <= ends[:, None]].tobytes()
