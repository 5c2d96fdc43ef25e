"""A CANopen device that has only what CiA 301 makes mandatory; written apart from canopen_device.core on purpose."""

import struct

NEVER_US = 1 << 62

Sent = list[tuple[int, bytes]]
NODE_ID = 5


class MinimalDevice:
    """NMT, boot-up, heartbeat, expedited SDO; objects 1000h, 1001h, 1017h, 1018h:0-1. No PDO, EMCY, LSS, segments."""

    def __init__(self, constant_ms: int = 0) -> None:
        """``constant_ms``: of 1017h, which is not written then (CiA 301, 7.5.2.20)."""
        self._state = 0
        self._constant_ms = self._period_ms = constant_ms
        self._due_us = NEVER_US

    def step(self, now_us: int, frames: Sent = ()) -> tuple[Sent, int]:  # type: ignore[assignment]
        sent: Sent = []
        if self._state == 0:
            self._boot(sent, now_us)
        for can_id, data in frames:
            if can_id == 0 and len(data) == 2 and data[1] in (0, NODE_ID):
                self._nmt(data[0], sent, now_us)
            elif can_id == 0x600 + NODE_ID and len(data) == 8 and self._state != 4:
                self._sdo(data, now_us, sent)
        if self._due_us <= now_us:
            sent.append((0x700 + NODE_ID, bytes((self._state,))))
            self._due_us += 1000 * self._period_ms
        return sent, self._due_us

    def _boot(self, sent: Sent, now_us: int) -> None:
        self._state = 127
        self._beat(self._constant_ms, now_us)
        sent.append((0x700 + NODE_ID, b"\0"))

    def _beat(self, period_ms: int, now_us: int) -> None:
        self._period_ms, self._due_us = period_ms, now_us + 1000 * period_ms if period_ms else NEVER_US

    def _nmt(self, command: int, sent: Sent, now_us: int) -> None:
        if command in (129, 130):
            self._boot(sent, now_us)
        else:
            self._state = {1: 5, 2: 4, 128: 127}.get(command, self._state)

    def _sdo(self, data: bytes, now_us: int, sent: Sent) -> None:
        index, sub = struct.unpack("<HB", data[1:4])
        objects = {
            (0x1000, 0): struct.pack("<I", 0), (0x1001, 0): b"\0", (0x1017, 0): struct.pack("<H", self._period_ms),
            (0x1018, 0): b"\1", (0x1018, 1): struct.pack("<I", 0x1234),
        }  # fmt: skip
        content = objects.get((index, sub))
        if data[0] == 0x80:
            return
        if data[0] >> 5 not in (1, 2):
            answer = self._abort(data, 0x05040001)
        elif content is None:
            answer = self._abort(data, 0x06090011 if any(index == key[0] for key in objects) else 0x06020000)
        elif data[0] >> 5 == 2:
            answer = bytes((0x43 | 4 - len(content) << 2,)) + data[1:4] + content
        else:
            answer = self._download(data, index, now_us)
        sent.append((0x580 + NODE_ID, answer + bytes(8 - len(answer))))

    def _download(self, data: bytes, index: int, now_us: int) -> bytes:
        if index != 0x1017 or self._constant_ms:
            return self._abort(data, 0x06010002)
        size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 2
        if not data[0] & 2:
            return self._abort(data, 0x05040001)
        if size != 2:
            return self._abort(data, 0x06070012 if size > 2 else 0x06070013)
        self._beat(struct.unpack("<H", data[4:6])[0], now_us)
        return b"\x60" + data[1:4]

    def _abort(self, data: bytes, code: int) -> bytes:
        return b"\x80" + data[1:4] + struct.pack("<I", code)
