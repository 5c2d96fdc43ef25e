"""Loopback sockets that carry struct can_frame: a bus for the receive path where the kernel has no CAN."""

from __future__ import annotations

import multiprocessing
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
from can.interfaces.socketcan.socketcan import SocketcanBus

from tipforce.host.live.receive import prepare_socket

ROOT = Path(__file__).parents[1]
NODES = 5
TICK_S = 0.001
_FRAME = struct.Struct("=IB3xIHBB")  # the running number, then theta, status and counter of a Contact PDO


def bound_receiver() -> socket.socket:
    """A UDP socket on 127.0.0.1 with the options of the live path."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    prepare_socket(receiver)
    return receiver


def connected_pair() -> tuple[socket.socket, socket.socket]:
    """Such a receiver, and a sender; each is connected to the other."""
    receiver = bound_receiver()
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(receiver.getsockname())
    receiver.connect(sender.getsockname())
    return receiver, sender


def contact_frames(count: int, first: int = 0) -> list[bytes]:
    """``count`` Contact PDOs of five nodes in turn; the first four data bytes are a running number."""
    return [
        _FRAME.pack(0x281 + number % NODES, 8, number, 1000 + number % 7000, 3, number // NODES % 256)
        for number in range(first, first + count)
    ]


def running_numbers(frames: np.ndarray[Any, np.dtype[np.void]]) -> np.ndarray[Any, np.dtype[np.uint32]]:
    """The running number of each frame, (n,)."""
    return np.ascontiguousarray(frames["data"][:, :4]).view(np.uint32)[:, 0]


def send_at_rate(address: tuple[str, int], rate_hz: int, seconds: float) -> None:
    """Send frames in ticks of a millisecond; what a late tick missed follows in the next."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.connect(address)
        send, number = one.send, 0
        total = round(rate_hz * seconds)
        start_s = time.monotonic()
        while number < total:
            due = min(int((time.monotonic() - start_s) * rate_hz), total)
            for frame in contact_frames(due - number, number):
                send(frame)
            number = due
            time.sleep(TICK_S)


@contextmanager
def sending(receiver: socket.socket, rate_hz: int, seconds: float) -> Iterator[None]:
    """A process that sends to ``receiver`` while the block runs."""
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=send_at_rate, args=(receiver.getsockname(), rate_hz, seconds), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.join(10)
        if process.is_alive():
            process.terminate()
            process.join()
        process.close()


def python_can_bus(one: socket.socket) -> SocketcanBus:
    """python-can's SocketCAN bus on a socket that is given: the code that receives is all its own."""
    bus = SocketcanBus.__new__(SocketcanBus)
    bus.socket = one
    bus.channel = bus.channel_info = "loopback"
    bus._filters, bus._is_filtered, bus._is_shutdown = None, True, True
    return bus


class CanopenHost:
    """canopen's way of a PDO: a Network's listener, a PdoMap and a callback that reads its three values."""

    def __init__(self) -> None:
        self.network = canopen.Network()
        self.values = 0.0
        self.frames = 0
        for node_id in range(1, NODES + 1):
            node = self.network.add_node(node_id, str(ROOT / "eds" / "tipforce-3.eds"))
            node.tpdo.read(from_od=True)
            node.tpdo[2].add_callback(self._on_pdo)

    def _on_pdo(self, pdo: Any) -> None:
        self.frames += 1
        self.values += pdo[0].raw + pdo[1].raw + pdo[2].raw

    def take(self, message: can.Message) -> None:
        """What canopen's own listener does with a message."""
        self.network.notify(message.arbitration_id, message.data, message.timestamp)


_CONTACT = struct.Struct("<hhhBB")


def struct_contact(message: can.Message) -> tuple[float, float, float, int, int]:
    """A Contact PDO decoded by hand: P in N, phi and theta in degrees, status, counter."""
    P, phi, theta, status, counter = _CONTACT.unpack(message.data)
    return P / 1000, phi / 100, theta / 100, status, counter
