"""What the frame fuzzer throws at a node: whole conversations, broken ones, and noise.

All of it follows from the ``Random`` that is handed in and from what the node answered: a seed repeats a round."""

import binascii
import struct
from collections import deque
from collections.abc import Callable, Sequence
from random import Random
from typing import Protocol, TypeVar

from canopen_device.core import codes
from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, NEVER_US, REMOTE_FLAG
from canopen_device.core.node import Device
from canopen_device.core.object_dictionary import SIZES
from canopen_device.core.sdo_block import crc16
from tipforce.dictionary import table

Item = TypeVar("Item")
Frame = tuple[int, bytes]
Step = tuple[int, tuple[Frame, ...]]

SIGNATURES = (0x65766173, 0x64616F6C, 0x6F72657A, 0x61726174, 0x74696D63, 0x6E65706F)
INTERESTING = (0, 1, 2, 3, 4, 5, 0x7F, 0x80, 0xF0, 0xFC, 0xFE, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000)
REALS = (0.0, -0.0, 1.0, -1.0, 1e-3, 5e-3, 10.0, 180.0, 1e4, 1e-45, 1.2e-38, 3.4028234e38, -3.4028234e38)
NOT_FINITE = (float("nan"), float("inf"), float("-inf"))
# Written more often than their share of the dictionary, because whole services depend on them.
HOT = (
    0x1003, 0x1005, 0x1007, 0x100C, 0x100D, 0x1012, 0x1013, 0x1014, 0x1015, 0x1016, 0x1017, 0x1019, 0x1029, 0x1F80,
    0x1400, 0x6040, 0x6060,
)  # fmt: skip
ACTIONS = (
    *[(0x1010, sub, 0x65766173) for sub in (1, 2, 3, 4)], *[(0x1011, sub, 0x64616F6C) for sub in (1, 2, 3, 4)],
    *[(0x6125, sub, table.SIGNATURE_ZERO) for sub in (1, 2, 3)], (0x6139, 4, table.SIGNATURE_TARA),
    (0x2105, 3, table.SIGNATURE_OPEN), (0x2105, 3, table.SIGNATURE_OPEN), (0x2104, 0, table.SIGNATURE_COMMIT),
)  # fmt: skip
PDO_OBJECTS = (0x1400, 0x1600, *range(0x1800, 0x1804), *range(0x1A00, 0x1A04))
MAPPED = {
    0x2130: (16, 0), 0x7100: (16, 3), 0x6100: (32, 3), 0x6150: (8, 9), 0x2107: (32, 3), 0x2120: (8, 0), 0x2121: (8, 0),
    0x2122: (16, 0), 0x2123: (16, 0), 0x2124: (16, 0), 0x1013: (32, 0),
}  # fmt: skip
"""By object: bits of an entry, and its highest sub-index, where they do not follow from the index."""
MAPPABLE = (0x7130, 0x6130, 0x9130, 0x7100, 0x6100, 0x2107, 0x6150, 0x2120, 0x2121, 0x2122, 0x2123, 0x2124, 0x1013)


def good_record(rng: Random) -> bytes:
    """A calibration record of three gauges that a commit takes: C well conditioned, limits in order."""
    C = [rng.uniform(-2e3, 2e3) + (2e4 if k % 4 == 0 else 0.0) for k in range(9)]
    offsets = [rng.uniform(-1e-4, 1e-4) for _ in range(3)]
    noise = [1e-13 if k in (0, 3, 5) else 0.0 for k in range(6)]
    contact = (8e-3, -60, 60, 0.05, 0.03, 0)
    # Of half the records all that is judged is known: forces, temperatures, model, converter, coefficients.
    validity = (2.0, 6.0, 5.0, 40.0, 0.01, *[2e-3] * 3, *[1e-6] * 3, -3e-4, 0.0) if rng.random() < 0.5 else (0.0,) * 13
    return struct.pack("<9f3fIIfB6f5fB13f", *C, *offsets, 7, 20260101, 23.0, 1, *noise, *contact, *validity)


class Target(Protocol):
    """What the frames are thrown at."""

    device: Device
    now_us: int
    due_us: int  # when it asked to be stepped
    sdo_answers: int  # in its last step


class Frames:
    """The steps of one round against ``rig``; what waits of a conversation is in ``_waiting``."""

    def __init__(self, rng: Random, rig: Target) -> None:
        self._rng, self._rig = rng, rig
        od = rig.device.od
        self._entries = [(i, s) for i in od.indices(0, 0xFFFF) for s in od.subs(i)]
        self._hot = [index for index in HOT if od.subs(index)]
        self._waiting: deque[bytes | Callable[[], bytes]] = deque()
        self._makers = (
            [self._upload] * 8 + [self._download] * 14 + [self._block_download] * 4
            + [self._block_upload] * 4 + [self._commit] * 2 + [self._remap] * 4 + [self._stray_sdo] * 3
            + [self._act] * 5
        )  # fmt: skip
        device, pick, random = rig.device, self._pick, rng
        self._singles: Sequence[Callable[[], Frame]] = (
            *[self._sync] * 6, *[self._nmt] * 3, *[self._lss] * 4, *[self._error] * 2, *[self._noise] * 2,
            lambda: (0x100, struct.pack("<IH", random.getrandbits(28), random.getrandbits(16))),  # time
            lambda: (0x700 + pick((1, 2, 3, 4, 127)), bytes((pick((0, 4, 5, 127)),))),  # heartbeats of others
            lambda: (0x200 + device.node_id & 0x7FF, bytes((self._byte() % 5, 0))),  # a command
            lambda: (0x700 + device.node_id & 0x7FF | REMOTE_FLAG, b""),
            # another node with this node's identifiers
            lambda: (pick((0x580, 0x700, 0x180, 0x280, 0x80)) + device.node_id & 0x7FF, random.randbytes(8)),
        )  # fmt: skip

    def next(self) -> Step:
        """The next step, (microseconds to pass, frames): mostly one frame, sometimes none or several."""
        r = self._rng.random()
        if r < 0.03:
            return self._pause(), ()
        if r < 0.08:
            return self._pause(), tuple(self._frame() for _ in range(2 + self._below(3)))
        return self._pause(), (self._frame(),)

    def _pause(self) -> int:
        r = self._rng.random()
        if r < 0.5:
            return int(r * 400)
        if r < 0.9:
            return self._below(2000)
        if r < 0.97:
            return int(self._rng.random() * 200_000)
        if r < 0.99:
            due_us = self._rig.due_us  # exactly when the node asked to be stepped, or one microsecond before
            return max(0, due_us - self._rig.now_us - (r < 0.98)) if due_us < NEVER_US else 5_000_000
        return int(self._rng.random() ** 8 * 1e12)

    def _frame(self) -> Frame:
        if self._waiting and self._rng.random() < 0.85:
            return self._mutated(self._next_request())
        if self._rng.random() < 0.5:
            self._pick(self._makers)()
            return self._mutated(self._next_request())
        return self._mutated(self._pick(self._singles)())

    def _next_request(self) -> Frame:
        waiting = self._waiting.popleft()
        return 0x600 + self._rig.device.node_id & 0x7FF, waiting if isinstance(waiting, bytes) else waiting()

    def _mutated(self, frame: Frame) -> Frame:
        """The frame, or now and then one with a flipped bit, another length or another identifier."""
        r = self._rng.random()
        if r > 0.06:
            return frame
        can_id, data = frame
        if r < 0.03 and data:
            at = self._below(len(data))
            return can_id, data[:at] + bytes((data[at] ^ 1 << (self._byte() & 7),)) + data[at + 1 :]
        if r < 0.045:
            return can_id, (data + self._rng.randbytes(8))[: self._below(9)]
        if r < 0.05:
            return can_id ^ 1 << self._below(32), data
        if r < 0.055:
            self._waiting.clear()
        elif self._waiting:
            self._waiting.rotate(1)
        return frame

    # --- SDO

    def _target(self) -> tuple[int, int]:
        r = self._rng.random()
        if r < 0.25:
            index = self._pick(self._hot)
            return index, self._pick(self._rig.device.od.subs(index))
        if r < 0.9:
            return self._pick(self._entries)
        if r < 0.95:
            return self._pick(self._entries)[0], self._byte()
        return self._rng.getrandbits(16), self._byte()

    def _value(self, index: int, sub: int) -> bytes:
        """Bytes to write: of the object's own length and with a meaning more often than not."""
        entry = self._rig.device.od.find(index, sub)
        kind = "I" if isinstance(entry, int) else entry[0]
        if kind in "sD":
            return good_record(self._rng) if self._rng.random() < 0.5 else self._rng.randbytes(self._byte())
        if kind == "f":
            r = self._rng.random()
            value = REALS[int(r * 29) % len(REALS)] if r < 0.9 else NOT_FINITE[int(r * 30) % 3]
            return struct.pack("<f", value)
        return (self._number(index, sub) & 0xFFFFFFFF).to_bytes(4, "little")[: SIZES[kind]]

    def _number(self, index: int, sub: int) -> int:
        r = self._rng.random()
        if r < 0.15:
            return self._rng.getrandbits(32)
        if r < 0.3:
            return self._pick(SIGNATURES)
        if index in PDO_OBJECTS and r < 0.9:
            return self._pdo_number(index, sub)
        if index in (0x1005, 0x1012, 0x1014) and r < 0.8:
            return self._cob_id()
        if index == 0x1016 and r < 0.9:
            return self._pick((1, 2, 3, 4, 127, 128)) << 16 | self._pick((0, 1, 5, 100))
        return self._pick(INTERESTING)

    def _cob_id(self) -> int:
        flags = self._pick((0, 0x80000000, 0x40000000, 0x40000000, 0xC0000000, 0x20000000))
        ids = (0x80, 0x85, 0x100, 0x185, 0x205, 0x285, 0x385, 0x485, 0x580, 0x585, 0x600, 0x680, 0x700, 0x705, 0x7E5)
        return flags | (self._pick(ids) if self._rng.random() < 0.7 else self._rng.getrandbits(11))

    def _pdo_number(self, index: int, sub: int) -> int:
        if index & 0x200:
            if not sub:
                return self._below(9)
            target = self._pick(MAPPABLE) if self._rng.random() < 0.8 else self._target()[0]
            return target << 16 | self._below(10) << 8 | self._pick((8, 16, 32))
        if sub == 1:
            return self._cob_id()
        return self._pick((0, 1, 2, 3, 10, 240, 252, 254, 255)) if sub == 2 else self._pick((0, 0, 1, 5, 100, 1000))

    def _upload(self) -> None:
        index, sub = self._target()
        self._waiting.append(struct.pack("<BHB4x", 0x40, index, sub))
        if self._rng.random() < 0.2:
            for k in range(self._below(12)):
                self._waiting.append(bytes((0x60 | k % 2 << 4, 0, 0, 0, 0, 0, 0, 0)))

    def _write(self, index: int, sub: int, data: bytes) -> None:
        """Any download of ``data`` that fits: expedited if it can be, segmented otherwise."""
        if 0 < len(data) <= 4:
            head = struct.pack("<BHB", 0x23 | 4 - len(data) << 2, index, sub)
            self._waiting.append(head + data + bytes(4 - len(data)))
            return
        self._waiting.append(struct.pack("<BHBI", 0x21, index, sub, len(data)))
        for offset in range(0, len(data), 7):
            part = data[offset : offset + 7]
            command = offset // 7 % 2 << 4 | 7 - len(part) << 1 | (offset + 7 >= len(data))
            self._waiting.append(bytes((command,)) + part + bytes(7 - len(part)))

    def _download(self) -> None:
        """Expedited, or in segments."""
        if self._rng.random() < 0.7:
            index, sub = self._target()
            self._write(index, sub, self._value(index, sub)[:4])
        else:
            index, sub = self._target() if self._rng.random() < 0.5 else (0x2141, 0)
            data = self._value(index, sub)
            self._write(index, sub, data if len(data) > 4 else data + bytes(5))

    def _block_download(self) -> None:
        index, sub = self._target() if self._rng.random() < 0.4 else (0x2141, 0)
        data = self._value(index, sub) or b"\0"
        self._waiting.append(struct.pack("<BHBI", 0xC0 | self._pick((0, 2, 4, 6, 6, 6)), index, sub, len(data)))
        parts = [data[k : k + 7] for k in range(0, len(data), 7)]
        for k, part in enumerate(parts):
            last = k + 1 == len(parts)
            self._waiting.append(bytes(((k % 127 + 1) | last << 7,)) + part + bytes(7 - len(part)))
        self._waiting.append(struct.pack("<BH5x", 0xC1 | 7 - len(parts[-1]) << 2, crc16(data)))

    def _block_upload(self) -> None:
        index, sub = self._target() if self._rng.random() < 0.5 else (self._pick((0x1021, 0x2140, 0x2141, 0x1008)), 0)
        size, switch = self._pick((0, 1, 2, 127, 127, 128)), self._pick((0, 0, 21, 255))
        self._waiting.append(struct.pack("<BHBBB2x", 0xA4, index, sub, size, switch))
        self._waiting.append(bytes((0xA3, 0, 0, 0, 0, 0, 0, 0)))
        for _ in range(self._below(8)):
            self._waiting.append(self._acknowledge)
        self._waiting.append(bytes((0xA1, 0, 0, 0, 0, 0, 0, 0)))

    def _acknowledge(self) -> bytes:
        received = self._rig.sdo_answers if self._rng.random() < 0.8 else self._below(130)
        return bytes((0xA2, received & 0xFF, self._pick((1, 5, 127, 127, 127, 0, 128)), 0, 0, 0, 0, 0))

    def _commit(self) -> None:
        """Stage a record, state its CRC, commit; one part of it may be wrong."""
        record = good_record(self._rng)
        if self._rng.random() < 0.2:
            at = 4 * self._below(26)
            record = record[:at] + self._value(0x2100, 1) + record[at + 4 :]
        self._write(0x2141, 0, record)
        self._write(0x2103, 1, struct.pack("<I", binascii.crc32(record) ^ (self._rng.random() < 0.1)))
        self._write(0x2104, 0, struct.pack("<I", table.SIGNATURE_COMMIT))
        if self._rng.random() < 0.3:
            self._write(0x1010, self._pick((1, 2, 3, 4)), struct.pack("<I", codes.SIGNATURE_SAVE))

    def _remap(self) -> None:
        """Change a PDO by the book: invalid, count 0, entries, count, parameters, valid."""
        number = self._pick((0x1400, 0x1800, 0x1801, 0x1802, 0x1803))
        mapping, count = number + 0x200, 1 + self._below(5)
        cob_id = (0 if number == 0x1400 else 0x40000000) | self._pick((0x181, 0x205, 0x285, 0x3FF))
        self._write(number, 1, struct.pack("<I", cob_id | 0x80000000))
        self._write(mapping, 0, b"\0")
        for sub in range(1, count + 1):
            index = 0x2130 if number == 0x1400 else self._pick(MAPPABLE)
            bits, highest = MAPPED.get(index, ({0x7: 16, 0x6: 32, 0x9: 32}.get(index >> 12, 8), 9))
            word = index << 16 | (1 + self._below(highest) if highest else 0) << 8 | bits
            self._write(mapping, sub, struct.pack("<I", word))
        self._write(mapping, 0, bytes((count,)))
        for sub in (2, 3, 5, 6):
            if self._rng.random() < 0.5:
                width = "<H" if sub in (3, 5) else "<B"
                self._write(number, sub, struct.pack(width, self._pdo_number(number, sub) & 0xFF))
        self._write(number, 1, struct.pack("<I", cob_id))

    def _act(self) -> None:
        """An action, a simulated load of a likely size, or a fault, or its end."""
        kind = self._below(10)
        if kind < 6:
            index, sub, value = self._pick(ACTIONS)
            self._write(index, sub, struct.pack("<I", value))
        elif kind == 6:
            self._write(0x2200, 1, struct.pack("<H", self._pick((0, 0, 0, 1, 2, 3, 4, 5))))
        else:
            sub = 1 + self._below(3)
            self._write(0x2201, sub, struct.pack("<f", self._rng.uniform(*((0, 5) if sub == 1 else (-180, 180)))))

    def _stray_sdo(self) -> None:
        """A command out of place: any first byte, an abort, a segment of no transfer."""
        command = self._byte() if self._rng.random() < 0.7 else 0x80
        self._waiting.append(bytes((command,)) + struct.pack("<HB", *self._target()) + self._rng.randbytes(4))

    # --- every service but SDO

    def _pick(self, items: Sequence[Item]) -> Item:
        return items[self._below(len(items))]

    def _below(self, limit: int) -> int:
        return int(self._rng.random() * limit)

    def _byte(self) -> int:
        return self._rng.getrandbits(8)

    def _sync(self) -> Frame:
        data = b"" if self._rng.random() < 0.7 else bytes((self._byte() % 11,))
        return (self._rig.device.sync.cob_id if self._rng.random() < 0.9 else 0x80), data

    def _nmt(self) -> Frame:
        command = self._pick((1, 1, 1, 1, 1, 2, 128, 128, 129, 130, 0, 3))
        node_id = self._pick((0, self._rig.device.node_id, self._rig.device.node_id, 9))
        return 0, bytes((command, node_id))

    def _lss(self) -> Frame:
        identity = [self._rig.device.od.integer(0x1018, sub) for sub in (1, 2, 3, 4)]
        service = self._pick((0x04, 0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x46, 0x4C, 0x51, 0x51, 0x5A, 0x5E))
        if service in (0x40, 0x46):
            part = self._below(4 if service == 0x40 else 6)
            number = identity[part if service == 0x40 else (0, 1, 2, 2, 3, 3)[part]]
            return 0x7E5, struct.pack("<BIxxx", service + part, number)
        if service == 0x51:
            part = self._below(4)
            bit = self._pick((0, 0, 1, 5, 31, 32, 0x80))
            following = self._pick((0, part, (part + 1) % 4))
            return 0x7E5, struct.pack("<BIBBB", service, identity[part], bit, part, following)
        value = self._pick((0, 1, 5, 127, 128, 255, 0))
        return 0x7E5, bytes((service, value, self._pick((0, 1, 5, 8, 9)), 0, 0, 0, 0, 0))

    def _error(self) -> Frame:
        kind = self._pick((0x004, 0x004, 0x004, 0x040, 0x100, 0x044, 0x008))
        detail = self._pick((0, 1, 2, 4, 8, 0x10, 0x20, 0x30, 0x40, 0xFF))
        return ERROR_FLAG | kind, bytes((0, detail, 0, 0, 0, 0, 0, 0))

    def _noise(self) -> Frame:
        can_id = self._rng.getrandbits(11)
        if self._rng.random() < 0.3:
            can_id = self._rng.getrandbits(29) | self._pick((0, EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG))
        return can_id, self._rng.randbytes(self._below(9))
