"""Talk to a device without a bus: a fake clock, conversations as candump shows them, SDO, NMT, and a store in memory.

    talk = Conversation(device_from_eds("drive.eds", 5))
    talk.say('''
        < 705#00                   this frame, and no other before it, is sent
        > 605#4000100000000000     this frame comes from the bus
        < 585#4300100092010200
        + 1000                     so many microseconds pass; the device is stepped whenever it asked to be
        ~ 1000                     the same, but its process sleeps until the end
    ''')
    assert talk.download(0x1017, 0, b"\\x64\\0") == 0       # any SDO transfer: 0 or the abort code

Before each line that begins with ``>``, ``+`` or ``~``, and at the end, all that was sent must have been named."""

import itertools
import re
import struct
from collections.abc import Callable, Iterable
from typing import Any

from canopen_device.core.codes import EMCY_BASE, NEVER_US, SDO_REQUEST_BASE, SDO_RESPONSE_BASE
from canopen_device.core.sdo_client import Download, Transfer, Upload
from canopen_device.running.loop import MemoryStore

__all__ = ["Conversation", "Fault", "Frame", "MemoryStore", "losing", "parse", "text"]

Frame = tuple[int, bytes]
Fault = Callable[[bytes], bytes | None]

_TIMEOUT_US, _DEADLINE_US = 1_000_000, 60_000_000


def intact(data: bytes) -> bytes:
    """Return the frame as it is: no fault."""
    return data


def losing(number: int) -> Fault:
    """Return a fault that loses one frame, the ``number``-th that it sees."""
    numbers = itertools.count(1)
    return lambda data: None if next(numbers) == number else data


def text(frame: Frame) -> str:
    """Return a frame as candump writes it."""
    return f"{frame[0]:03X}#{frame[1].hex().upper()}"


def parse(line: str) -> Frame:
    """Return the frame of a text; dots may separate bytes."""
    can_id, data = line.strip().split("#")
    return int(can_id, 16), bytes.fromhex(data.replace(".", ""))


class Conversation:
    """All frames to and from one device, which is a ``Device``, or has its ``node_id`` and ``step``. ``sent`` has its
    frames that no line has named yet; ``emcy`` False hides EMCY: "nothing else was sent" then speaks of the rest."""

    def __init__(self, device: Any, now_us: int = 0, emcy: bool = False) -> None:
        self.device = device
        self.now_us = now_us
        self.due_us = NEVER_US
        self.sent: list[Frame] = []
        self._hidden = None if emcy else EMCY_BASE + device.node_id
        self.step()

    def step(self, frames: Iterable[Frame] = ()) -> list[Frame]:
        """Step the device now; return what it sends, which is also kept for the lines that follow."""
        sent, self.due_us = self.device.step(self.now_us, frames)
        sent = [frame for frame in sent if frame[0] != self._hidden]
        self.sent += sent
        return sent

    def send(self, line: str) -> list[Frame]:
        """Step the device with a frame as candump writes it."""
        return self.step([parse(line)])

    def nmt(self, command: int) -> list[Frame]:
        """Step the device with an NMT command to it."""
        return self.step([(0, bytes((command, self.device.node_id)))])

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
        """Hold a conversation. Raises AssertionError for a line that differs, and for a frame that no line names."""
        for line in filter(None, (re.sub(r"  .*", "", raw.strip()) for raw in script.splitlines())):
            if line[0] == "<":
                assert self.sent, f"expected {line}, but nothing was sent"
                assert text(self.sent.pop(0)) == text(parse(line[1:])), line
                continue
            self.quiet(line)
            if line[0] == ">":
                self.send(line[1:])
            elif line[0] == "+":
                self.advance(int(line[1:]))
            elif line[0] == "~":
                self.sleep(int(line[1:]))
            else:
                raise ValueError(line)
        self.quiet("the end")

    def quiet(self, before: str = "now") -> None:
        """Raise AssertionError if a frame was sent that no line has named."""
        assert not self.sent, f"before {before}: {[text(frame) for frame in self.sent]}"

    def take(self) -> list[Frame]:
        """Return the frames that no line has named, and count them as named."""
        taken, self.sent = self.sent, []
        return taken

    def transfer(self, transfer: Transfer, request_fault: Fault = intact, response_fault: Fault = intact) -> Transfer:
        """Lead a transfer of the SDO client to its end; a fault returns a frame as it arrives, None: it is lost."""
        node_id, begun_us = self.device.node_id, self.now_us
        requests, due_us = transfer.step(0)
        while requests or not transfer.ended:
            before = len(self.sent)
            for request in filter(None, map(request_fault, requests)):
                self.step([(SDO_REQUEST_BASE + node_id, request)])
            if len(self.sent) == before and not transfer.ended:
                self.advance(max(begun_us + due_us - self.now_us, 0))
            frames, self.sent[before:] = self.sent[before:], []
            requests, is_silent = [], True
            for frame in frames:
                if frame[0] != SDO_RESPONSE_BASE + node_id:
                    self.sent.append(frame)
                elif (response := response_fault(frame[1])) is not None:
                    answer, due_us = transfer.step(self.now_us - begun_us, response)
                    requests, is_silent = requests + answer, False
            if is_silent and not transfer.ended:
                requests, due_us = transfer.step(self.now_us - begun_us)
        return transfer

    def upload(self, index: int, sub: int = 0, kind: type[Upload] = Upload, fault: Fault = intact) -> bytes | int:
        """Return what an SDO upload reads, or the abort code; ``kind``: segmented, or a ``BlockUpload``. ``fault``
        changes responses. Raises AssertionError with the reason if the client gives up."""
        done = self.transfer(kind(index, sub, _TIMEOUT_US, _DEADLINE_US), response_fault=fault)
        assert done.failure is None, done.failure or "no response"
        return done.data if done.abort_code is None else done.abort_code

    def download(
        self, index: int, sub: int, data: bytes, kind: type[Download] = Download, fault: Fault = intact
    ) -> int:
        """Write by SDO: 0, or the abort code; arguments and errors as of ``upload``; ``fault`` changes requests."""
        done = self.transfer(kind(index, sub, _TIMEOUT_US, _DEADLINE_US, data), fault)
        assert done.failure is None, done.failure or "no response"
        return done.abort_code or 0

    def get(self, kind: str, index: int, sub: int = 0) -> float:
        """Return a number by SDO; ``kind`` is struct's letter. Raises AssertionError for an abort."""
        data = self.upload(index, sub)
        assert isinstance(data, bytes), f"{index:04X}h:{sub} abort {data:08X}"
        value: float = struct.unpack("<" + kind, data)[0]
        return value

    def put(self, kind: str, index: int, sub: int, value: float) -> int:
        """Write a number by SDO: 0, or the abort code."""
        return self.download(index, sub, struct.pack("<" + kind, value))
