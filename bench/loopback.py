"""Loopback sockets that carry struct can_frame: a bus for the receive path where the kernel has no CAN."""

import multiprocessing
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection as Pipe
from multiprocessing.context import SpawnProcess
from typing import Any

import can
import canopen
import numpy as np
from bench.measure import ROOT
from can.interfaces.socketcan.socketcan import SocketcanBus

from canopen_device.can_frame import CAN_FRAME
from canopen_device.core.codes import SYNC_COB_ID
from canopen_device.running.loop import Frame
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.link import KEPT_FRAMES, SERVICE_FILTERS, Link, ThreadSync
from tipforce.host.live.receive import SocketReceiver, prepare_socket
from tipforce.host.network.bus import Bus

Address = tuple[str, int]
NODES = 5
TICK_S = 0.001
_spawn = multiprocessing.get_context("spawn")
_CONTACT = struct.Struct("<hhhBB")
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


def contact_frames(first: int, until: int) -> list[bytes]:
    """Contact PDOs of five nodes in turn; the first four data bytes are a running number."""
    return [
        _FRAME.pack(0x281 + number % NODES, 8, number, 1000 + number % 7000, 3, number // NODES % 256)
        for number in range(first, until)
    ]


def running_numbers(frames: np.ndarray[Any, np.dtype[np.void]]) -> np.ndarray[Any, np.dtype[np.uint32]]:
    """The running number of each frame, (n,)."""
    return np.ascontiguousarray(frames["data"][:, :4]).view(np.uint32)[:, 0]


FramesOf = Callable[[int, int], list[bytes]]  # the frames from one number up to another


def send_at_rate(address: tuple[str, int], frames_of: FramesOf, rate_hz: int, seconds: float) -> None:
    """Send frames in ticks of a millisecond; what a late tick missed follows in the next."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(address)
        send, number, total = sender.send, 0, round(rate_hz * seconds)
        start_s = time.monotonic()
        while number < total:
            due = max(min(int((time.monotonic() - start_s) * rate_hz), total), number)
            for frame in frames_of(number, due):
                send(frame)
            number = due
            time.sleep(TICK_S)


@contextmanager
def sending(
    receiver: socket.socket, rate_hz: int, seconds: float, frames_of: FramesOf = contact_frames, wait_s: float = 10.0
) -> Iterator[None]:
    """A process that sends to ``receiver`` while the block runs; after it the rest has ``wait_s``."""
    arguments = receiver.getsockname(), frames_of, rate_hz, seconds
    process = _spawn.Process(target=send_at_rate, args=arguments, daemon=True)
    process.start()
    try:
        yield
    finally:
        _end(process, wait_s)


def _end(process: SpawnProcess, wait_s: float) -> None:
    process.join(wait_s)
    if process.is_alive():
        process.terminate()
        process.join()
    process.close()


def python_can_bus(receiver: socket.socket) -> SocketcanBus:
    """python-can's SocketCAN bus on a socket that is given: the code that receives is all its own."""
    bus = SocketcanBus.__new__(SocketcanBus)
    bus.socket = receiver
    bus.channel = bus.channel_info = "loopback"
    bus._filters, bus._is_filtered, bus._is_shutdown = None, True, True
    return bus


class CanopenHost:
    """canopen's way of a PDO: a Network's listener, a PdoMap and a callback that reads its three values."""

    def __init__(self) -> None:
        self.network, self.values, self.frames = canopen.Network(), 0.0, 0
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


def struct_contact(message: can.Message) -> tuple[float, float, float, int, int]:
    """A Contact PDO decoded by hand: P in N, phi and theta in degrees, status, counter."""
    P, phi, theta, status, counter = _CONTACT.unpack(message.data)
    return P / 1000, phi / 100, theta / 100, status, counter


class LoopbackPort:
    """The fingers' door: what comes from the host goes on to its receiver, what they send goes to both of its ends."""

    def __init__(self, fingers: socket.socket, receiver: Address, services: Address) -> None:
        self._socket, self._receiver, self._services = fingers, receiver, services
        self._poll = select.poll()
        self._poll.register(fingers, select.POLLIN)

    def receive(self, timeout_s: float) -> Frame | None:
        if not self._poll.poll(timeout_s * 1e3):
            return None
        packed = self._socket.recv(CAN_FRAME.size)
        can_id, length, data = CAN_FRAME.unpack(packed)
        if can_id != SYNC_COB_ID:  # who sends the SYNC sends it to the receiver, too
            self._socket.sendto(packed, self._receiver)
        return can_id, data[:length]

    def send(self, frames: Iterable[Frame]) -> None:
        for can_id, data in frames:
            packed = CAN_FRAME.pack(can_id, len(data), data)
            self._socket.sendto(packed, self._receiver)
            if any(can_id & rule["can_mask"] == rule["can_id"] for rule in SERVICE_FILTERS):  # as the kernel filters
                self._socket.sendto(packed, self._services)

    def request(self, what: str, value: int, delay_ms: int) -> None:
        """Nothing to do here."""


def run_fingers(count: int, receiver: Address, services: Address, realtime: bool, pipe: Pipe) -> None:
    """A process: fingers 1 to ``count``, until it is ended."""
    from canopen_device.running import loop
    from tipforce.fingertip.node import fingertip_node
    from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
    from tipforce.sources.simulated import SimulatedSource

    rows = strain_matrix(FABRICATED, "I").tolist()
    devices = []
    for n in range(1, count + 1):
        source = SimulatedSource(rows, 0.5, seed=n)
        source.load = (1.0 + 0.1 * n, 10.0, 30.0)
        devices.append(fingertip_node(n, source, serial=n))
    _hurry(realtime)
    with bound_receiver() as bus:
        pipe.send(bus.getsockname())
        loop.run(devices, LoopbackPort(bus, receiver, services))


def run_sync(
    period_s: float, data: Sequence[bytes], receiver: Address, fingers: Address, realtime: bool, pipe: Pipe
) -> None:
    """A process: the SYNC, until the pipe is closed."""
    _hurry(realtime)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        producer = ThreadSync(partial(_send_sync, sender, (receiver, fingers)), period_s, data)
        pipe.poll(None)
        producer.stop()


def _send_sync(sender: socket.socket, addresses: tuple[Address, Address], number: bytes) -> None:
    frame = CAN_FRAME.pack(SYNC_COB_ID, len(number), number)
    for address in addresses:
        sender.sendto(frame, address)


def _hurry(realtime: bool) -> None:
    """Fingers and SYNC stand for hardware of their own: with ``realtime`` other work on this machine does not wait."""
    if realtime:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def may_hurry() -> bool:
    """Whether this process may have the scheduling class SCHED_FIFO; it does not keep it."""
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        _hurry(True)
    except PermissionError:
        return False
    os.sched_setscheduler(0, policy, param)
    return True


def _child(work: Callable[..., None], *args: Any) -> tuple[SpawnProcess, Pipe]:
    """A process and our end of its pipe."""
    ours, theirs = _spawn.Pipe()
    process = _spawn.Process(target=work, args=(*args, theirs), daemon=True)
    process.start()
    theirs.close()
    return process, ours


class LoopbackLink(Link):
    """A link with ``count`` fingers at its other end, and SYNCs from a process of their own."""

    def __init__(self, count: int, realtime: bool = False) -> None:
        self._realtime = realtime
        receiver, services = bound_receiver(), bound_receiver()
        self._receiver_address = receiver.getsockname()
        addresses = self._receiver_address, services.getsockname()
        self._fingers, pipe = _child(run_fingers, count, *addresses, realtime)
        if not pipe.poll(30.0):
            raise RuntimeError("the fingers' process did not start")
        self._fingers_address: Address = pipe.recv()
        services.connect(self._fingers_address)
        self._receiver = SocketReceiver(receiver, "loopback")
        bus = python_can_bus(services)
        bus._periodic_tasks, bus._bcm_sockets = [], {}
        self.connection = Bus(bus)
        self.connection.buffer.limit = KEPT_FRAMES

    def receive(self, timeout_s: float) -> FrameArray:
        return self._receiver.receive(timeout_s)

    def start_sync(self, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
        addresses = self._receiver_address, self._fingers_address
        process, pipe = _child(run_sync, period_s, data, *addresses, self._realtime)

        def stop() -> None:
            if not pipe.closed:
                pipe.close()
                _end(process, 10.0)

        return stop

    @property
    def dropped(self) -> int:
        return self._receiver.dropped

    def close(self) -> None:
        """See Link; ends the fingers, too."""
        _end(self._fingers, 0.0)
        self.connection.close()
        self._receiver.close()
