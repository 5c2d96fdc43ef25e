"""A device with a fake clock, and conversations with it written as candump shows them.

> 605#4000100000000000   this frame comes from the bus
< 585#4300100094010200   this frame, and no other before it, is sent
+ 1000                   so many microseconds pass; the device is stepped whenever it asked to be
~ 1000                   the same, but its process sleeps until the end

Before each line that begins with ``>``, ``+`` or ``~``, and at the end, all that was sent must have been named.
"""

import re
import struct
from collections.abc import Iterable

from tipforce.device.codes import NEVER_US
from tipforce.device.node import Device

Frame = tuple[int, bytes]


def text(frame: Frame) -> str:
    """A frame as candump writes it."""
    return f"{frame[0]:03X}#{frame[1].hex().upper()}"


def parse(line: str) -> Frame:
    """The inverse of ``text``; dots between bytes may stand for the eye."""
    can_id, data = line.strip().split("#")
    return int(can_id, 16), bytes.fromhex(data.replace(".", ""))


class Conversation:
    """Everything that is said to and by one device. ``sent`` holds what it said and no line has named yet."""

    def __init__(self, device: Device, now_us: int = 0, emcy: bool = False) -> None:
        self.device = device
        self.now_us = now_us
        self.due_us = NEVER_US
        self.sent: list[Frame] = []
        # EMCY has tests of its own: elsewhere "nothing else was sent" speaks of all other services.
        self._hidden = None if emcy else 0x80 + device.node_id
        self.step()

    def step(self, frames: Iterable[Frame] = ()) -> list[Frame]:
        """One step of the device now; what it sends is also kept for the lines that follow."""
        sent, self.due_us = self.device.step(self.now_us, frames)
        sent = [frame for frame in sent if frame[0] != self._hidden]
        self.sent += sent
        return sent

    def advance(self, microseconds: int) -> None:
        """Let time pass as a bus loop does: wake at each due time."""
        end_us = self.now_us + microseconds
        while self.due_us <= end_us:
            self.now_us = max(self.due_us, self.now_us)
            self.step()
        self.now_us = end_us
        self.step()

    def sleep(self, microseconds: int) -> None:
        """Let time pass with the process asleep."""
        self.now_us += microseconds
        self.step()

    def say(self, script: str) -> None:
        """Hold a conversation; each line is checked, and that nothing was sent besides."""
        for line in filter(None, (re.sub(r"  .*", "", raw.strip()) for raw in script.splitlines())):
            if line[0] == "<":
                assert self.sent, f"expected {line}, but nothing was sent"
                assert text(self.sent.pop(0)) == text(parse(line[1:])), line
                continue
            self.quiet(line)
            if line[0] == ">":
                self.step([parse(line[1:])])
            elif line[0] == "+":
                self.advance(int(line[1:]))
            elif line[0] == "~":
                self.sleep(int(line[1:]))
            else:
                raise ValueError(line)
        self.quiet("the end")

    def quiet(self, before: str = "now") -> None:
        """All that was sent has been named."""
        assert not self.sent, f"before {before}: {[text(frame) for frame in self.sent]}"

    def take(self) -> list[Frame]:
        """What was sent and not named yet, which is then taken as named."""
        taken, self.sent = self.sent, []
        return taken

    # --- an SDO client of its own, so that tests of objects need no bytes -----------------------------------

    def _request(self, data: bytes) -> bytes:
        assert len(data) == 8
        node_id = self.device.node_id
        answer = [data for can_id, data in self.step([(0x600 + node_id, data)]) if can_id == 0x580 + node_id]
        assert len(answer) == 1, answer
        self.sent.remove((0x580 + node_id, answer[0]))
        return answer[0]

    def upload(self, index: int, sub: int = 0) -> bytes | int:
        """What an SDO upload reads, or the abort code."""
        first = self._request(struct.pack("<BHB4x", 0x40, index, sub))
        if first[0] == 0x80:
            return int.from_bytes(first[4:], "little")
        assert first[1:4] == struct.pack("<HB", index, sub)
        if first[0] & 2:
            return first[4 : 8 - (first[0] >> 2 & 3)]
        size, data, toggle = int.from_bytes(first[4:], "little"), b"", 0
        while True:
            part = self._request(bytes((0x60 | toggle,)) + bytes(7))
            assert part[0] & 0xF0 == toggle
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            if part[0] & 1:
                assert len(data) == size
                return data
            toggle ^= 0x10

    def download(self, index: int, sub: int, data: bytes) -> int:
        """Write by SDO: 0, or the abort code."""
        if 0 < len(data) <= 4:
            head = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub)
            return self._abort_code(self._request(head + data + bytes(4 - len(data))))
        answer = self._request(struct.pack("<BHBI", 0x21, index, sub, len(data)))
        for offset in range(0, max(len(data), 1), 7):
            if answer[0] == 0x80:
                break
            part = data[offset : offset + 7]
            command = (offset // 7 & 1) << 4 | (7 - len(part)) << 1 | (offset + 7 >= len(data))
            answer = self._request(bytes((command,)) + part + bytes(7 - len(part)))
        return self._abort_code(answer)

    def _abort_code(self, answer: bytes) -> int:
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    def get(self, kind: str, index: int, sub: int = 0) -> float:
        """A number by SDO; ``kind`` is struct's letter."""
        data = self.upload(index, sub)
        assert isinstance(data, bytes), f"{index:04X}h:{sub} abort {data:08X}"
        value: float = struct.unpack("<" + kind, data)[0]
        return value

    def put(self, kind: str, index: int, sub: int, value: float) -> int:
        """Write a number by SDO: 0, or the abort code."""
        return self.download(index, sub, struct.pack("<" + kind, value))
