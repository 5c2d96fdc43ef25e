"""A bus for `bench.hand`: loopback datagram sockets that carry struct can_frame between fingers, SYNC and a Hand.

Three processes, as on a real bus: the fingers (they also distribute what the host sends), the SYNC (in place of the
kernel's broadcast manager) and the host. A SYNC goes to the host's receiver first, so no answer can stand before it.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import Connection as Pipe
from multiprocessing.context import SpawnProcess
from typing import Any

from bench.live_loopback import bound_receiver, python_can_bus

from tipforce.device.codes import SYNC_COB_ID
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.link import SERVICE_FILTERS, Link, keep_few
from tipforce.host.hand.sync_producer import ThreadSync
from tipforce.host.live.receive import SocketReceiver
from tipforce.host.network.bus import Bus
from tipforce.running.loop import Frame
from tipforce.socketcan import CAN_FRAME

Address = tuple[str, int]
_spawn = multiprocessing.get_context("spawn")


class LoopbackPort:
    """The fingers' door: what comes from the host goes on to its receiver, what they send goes to both of its ends."""

    def __init__(self, one: socket.socket, receiver: Address, services: Address) -> None:
        self._socket, self._receiver, self._services = one, receiver, services
        self._poll = select.poll()
        self._poll.register(one, select.POLLIN)

    def receive(self, timeout_s: float) -> Frame | None:
        """See fingertip.loop.Port."""
        if not self._poll.poll(timeout_s * 1e3):
            return None
        packed = self._socket.recv(CAN_FRAME.size)
        can_id, length, data = CAN_FRAME.unpack(packed)
        if can_id != SYNC_COB_ID:  # who sends the SYNC sends it to the receiver, too
            self._socket.sendto(packed, self._receiver)
        return can_id, data[:length]

    def send(self, frames: Iterable[Frame]) -> None:
        """See fingertip.loop.Port."""
        for can_id, data in frames:
            packed = CAN_FRAME.pack(can_id, len(data), data)
            self._socket.sendto(packed, self._receiver)
            if any(can_id & rule["can_mask"] == rule["can_id"] for rule in SERVICE_FILTERS):  # as the kernel filters
                self._socket.sendto(packed, self._services)

    def request(self, what: str, value: int, delay_ms: int) -> None:
        """Nothing to do here."""


def run_fingers(count: int, receiver: Address, services: Address, pipe: Pipe, realtime: bool) -> None:
    """A process: fingers 1 to ``count`` until the pipe says stop; then their CPU time."""
    from tipforce.fingertip.node import fingertip_node
    from tipforce.running import loop
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce.sensor.structure.strain import strain_matrix
    from tipforce.sources.simulated import SimulatedSource

    rows = strain_matrix(FABRICATED, "I").tolist()
    devices = []
    for n in range(1, count + 1):
        source = SimulatedSource(rows, 0.5, seed=n)
        source.load = (1.0 + 0.1 * n, 10.0, 30.0)
        devices.append(fingertip_node(n, source, serial=n))
    _hurry(realtime)
    with bound_receiver() as one:
        pipe.send(one.getsockname())
        port = LoopbackPort(one, receiver, services)
        loop.run(devices, port, _asked_to_stop(pipe))
        pipe.send(time.process_time())


def run_sync(
    period_s: float, data: Sequence[bytes], receiver: Address, fingers: Address, pipe: Pipe, realtime: bool
) -> None:
    """A process: the SYNC, until the pipe says stop; then how many were left out, and CPU time."""
    _hurry(realtime)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:

        def send(number: bytes) -> None:
            _send_sync(one, number, receiver, fingers)

        producer = ThreadSync(send, period_s, data)
        pipe.recv()
        producer.stop()
        pipe.send((producer.skipped, time.process_time()))


def _send_sync(one: socket.socket, number: bytes, *addresses: Address) -> None:
    frame = CAN_FRAME.pack(SYNC_COB_ID, len(number), number)
    for address in addresses:
        one.sendto(frame, address)


def _asked_to_stop(pipe: Pipe) -> Callable[[], bool]:
    """Looks into the pipe at most a few times a second: that is a system call."""
    next_s = 0.0

    def asked() -> bool:
        nonlocal next_s
        now_s = time.monotonic()
        if now_s < next_s:
            return False
        next_s = now_s + 0.2
        return pipe.poll()

    return asked


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


class Child:
    """A process with a pipe."""

    def __init__(self, work: Callable[..., None], *args: Any, realtime: bool) -> None:
        self.pipe, theirs = _spawn.Pipe()
        self._process: SpawnProcess = _spawn.Process(target=work, args=(*args, theirs, realtime), daemon=True)
        self._process.start()
        theirs.close()

    def stop(self) -> Any:
        """Ask it to end; what it tells at its end."""
        self.pipe.send(None)
        told = self.pipe.recv() if self.pipe.poll(10.0) else None
        self._process.join(10)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
        return told


class ChildSync:
    """SYNCs from a process of their own."""

    def __init__(
        self, period_s: float, data: Sequence[bytes], receiver: Address, fingers: Address, realtime: bool
    ) -> None:
        self._child: Child | None = Child(run_sync, period_s, data, receiver, fingers, realtime=realtime)
        self.skipped, self.cpu_s = 0, 0.0

    def stop(self) -> None:
        """See ThreadSync."""
        if self._child is not None:
            told, self._child = self._child.stop(), None
            if told is not None:
                self.skipped, self.cpu_s = told


class LoopbackLink(Link):
    """A link with ``count`` fingers at its other end; ``sync`` is "process" or "thread"."""

    def __init__(self, count: int, sync: str = "process", realtime: bool = False) -> None:
        self._sender, self._realtime = sync, realtime
        self._sync_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        receiver, services = bound_receiver(), bound_receiver()
        self._receiver_address = receiver.getsockname()
        addresses = self._receiver_address, services.getsockname()
        self._fingers = Child(run_fingers, count, *addresses, realtime=realtime)
        if not self._fingers.pipe.poll(30.0):
            raise RuntimeError("the fingers' process did not start")
        self._fingers_address: Address = self._fingers.pipe.recv()
        services.connect(self._fingers_address)
        self._receiver = SocketReceiver(receiver, "loopback")
        bus = python_can_bus(services)
        bus._periodic_tasks, bus._bcm_sockets = [], {}
        self.connection = Bus(bus)
        keep_few(self.connection)
        self.producer: ThreadSync | ChildSync | None = None
        self.fingers_cpu_s = 0.0

    def receive(self, timeout_s: float) -> FrameArray:
        """See Link."""
        return self._receiver.receive(timeout_s)

    def start_sync(self, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
        """See Link."""
        if self._sender == "thread":
            self.producer = ThreadSync(self._send_sync, period_s, data)
        else:
            self.producer = ChildSync(period_s, data, self._receiver_address, self._fingers_address, self._realtime)
        return self.producer.stop

    def _send_sync(self, number: bytes) -> None:
        _send_sync(self._sync_socket, number, self._receiver_address, self._fingers_address)

    @property
    def dropped(self) -> int:
        """See Link."""
        return self._receiver.dropped

    def close(self) -> None:
        """See Link; ends the fingers, too."""
        told = self._fingers.stop()
        self.fingers_cpu_s = told or 0.0
        self.connection.close()
        self._receiver.close()
        self._sync_socket.close()
