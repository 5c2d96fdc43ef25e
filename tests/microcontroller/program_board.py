"""A board with two program slots whose flash loses power after a number of bytes, and its node."""

import contextlib
import io
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import can

from canopen_device.core.node import Device
from canopen_device.core.sdo_client import BlockDownload, Download, Transfer
from canopen_device.running import loop
from canopen_device.running.loop import Port
from canopen_device.running.open_bus import PythonCanPort
from canopen_device.testing import Conversation, Fault, intact
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource
from tipforce_loader import build
from tipforce_loader.flash import FlashStore
from tipforce_loader.programs import Programs

KEY = b"a key of the bench"
NODE_ID = 5
INSTALLED_VERSION = "0.1.0"


class PowerOffError(Exception):
    pass


class Flash:
    """Two slots for programs and two for the record. Power goes after ``left`` bytes; opening erases."""

    size = 1 << 17

    def __init__(self) -> None:
        self.programs = [bytearray(), bytearray()]
        self.records = [bytearray(), bytearray()]
        self.left = 1 << 60
        self.written = 0

    def add(self, content: bytearray, data: bytes) -> None:
        """Append as much as there is power for."""
        part = data[: self.left]
        self.left -= len(part)
        self.written += len(part)
        content += part
        if len(part) < len(data):
            raise PowerOffError

    def open(self, slot: int, mode: str) -> Any:
        if mode == "rb":
            return io.BytesIO(bytes(self.programs[slot]))
        self.add(bytearray(), b"\xff")
        self.programs[slot] = bytearray()
        return Writer(self, self.programs[slot])

    def read(self, slot: int) -> bytes:
        return bytes(self.records[slot])

    def write(self, slot: int, data: bytes) -> None:
        self.records[slot] = bytearray()
        self.add(self.records[slot], data)


class Writer:
    def __init__(self, flash: Flash, content: bytearray) -> None:
        self.write = partial(flash.add, content)

    def close(self) -> None:
        pass


class Board:
    """The node of a board; ``power_on`` starts what the loader chooses."""

    def __init__(self, flash: Flash | None = None) -> None:
        self.flash = flash or Flash()
        self.now_us = 0
        self.healthy = True
        self.power_on()

    def power_on(self) -> None:
        self.programs = Programs(self.flash, FlashStore(self.flash), KEY, table.PRODUCT, INSTALLED_VERSION)
        self.slot = self.programs.choose()
        self.device: Device = fingertip_node(NODE_ID, SimulatedSource([[0.0] * 3] * 3), programs=self.programs)
        self.device.step(self.now_us)

    def exchange(self, transfer: Transfer, fault: Fault = intact) -> Transfer:
        """Lead a transfer to its end; ``fault`` changes the requests on their way."""
        talk = Conversation(self.device, self.now_us, emcy=True)
        try:
            return talk.transfer(transfer, fault)
        finally:
            self.now_us = talk.now_us

    def download(self, image: bytes, fault: Fault = intact) -> Transfer:
        entry = od.PROGRAM_DATA[1]
        return self.exchange(BlockDownload(entry.index, entry.sub, 500000, 1 << 50, image), fault)

    def control(self, command: int) -> int | None:
        """Write 1F51h:1; return the abort code, None if it was accepted."""
        entry = od.PROGRAM_CONTROL[1]
        return self.exchange(Download(entry.index, entry.sub, 500000, 1 << 50, bytes((command,)))).abort_code


def image(
    version: tuple[int, int, int] = (0, 2, 0), size: int = 3000, product: int = table.PRODUCT, key: bytes = KEY
) -> bytes:
    content = bytes((k * 37 + version[1]) & 0xFF for k in range(size))
    return build.image(version, product, {"canopen_device/core/node.mpy": content}, key)


class _Port:
    """The port of a board: a restart builds its node again, a frame during a trial confirms a healthy program."""

    def __init__(self, board: Board, devices: list[Device], port: Port) -> None:
        self._board, self._devices, self._port = board, devices, port

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        frame = self._port.receive(timeout_s)
        programs = self._board.programs
        if frame is not None and programs.on_trial:
            if self._board.healthy:
                programs.confirm()
            else:
                self.request("restart", 0, 0)
        return frame

    def send(self, frames: Iterable[tuple[int, bytes]]) -> None:
        self._port.send(frames)

    def request(self, what: str, _value: int, _delay_ms: int) -> None:
        if what == "restart":
            self._board.power_on()
            self._devices[0] = self._board.device


@contextlib.contextmanager
def running(board: Board, bus: can.BusABC) -> Iterator[None]:
    """A thread that runs the node of a board on ``bus``; an exception in it fails the test."""
    devices = [board.device]
    with loop.running(devices, _Port(board, devices, PythonCanPort(bus))):
        yield
