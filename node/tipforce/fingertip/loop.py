"""The loops that feed devices: bytes from a bus in, bytes to it out, and the clock. One thread serves many nodes."""

from __future__ import annotations

import errno
import logging
import select
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Protocol

from tipforce.device.node import Device
from tipforce.socketcan import CAN_FRAME, raw_can_id

if TYPE_CHECKING:
    import can

Frame = tuple[int, bytes]

_LOG = logging.getLogger(__name__)
_IDLE_S = 0.2  # the longest wait: how soon a loop sees that it is asked to stop
_FULL_QUEUE_WAIT_S = 0.05


class Port(Protocol):
    """One connection to a bus: frames as (SocketCAN can_id, data)."""

    def receive(self, timeout_s: float) -> Frame | None:
        """The next frame, or None when none came in time."""

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames in order."""


def now_us() -> int:
    """Microseconds of the monotonic clock."""
    return time.monotonic_ns() // 1000


def run(devices: Sequence[Device], port: Port, stop: Callable[[], bool] = lambda: False) -> None:
    """Step ``devices`` on one bus until ``stop()`` is true. Each frame goes to every device."""
    frames: list[Frame] = []
    while not stop():
        due_us = _step(devices, port, frames)
        frame = port.receive(min(max(0.0, (due_us - now_us()) * 1e-6), _IDLE_S))
        frames = [] if frame is None else [frame]


def _step(devices: Sequence[Device], port: Port, frames: list[Frame]) -> int:
    due_us = now_us() + 1_000_000
    for device in devices:
        sent, device_due_us = device.step(now_us(), frames)
        due_us = min(due_us, device_due_us)
        if sent:
            port.send(sent)
        for request in device.requests:
            _LOG.info("node %d: %s", device.node_id, request)
        device.requests.clear()
    return due_us


class SocketCanPort:
    """A raw SocketCAN socket on ``interface``: the shortest way on Linux. Raises OSError if there is none."""

    def __init__(self, interface: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            self._socket.bind((interface,))
        except OSError:
            self._socket.close()
            raise

    def receive(self, timeout_s: float) -> Frame | None:
        """The next classic frame, or None."""
        ready, _, _ = select.select([self._socket], [], [], timeout_s)
        if not ready:
            return None
        can_id, length, data = CAN_FRAME.unpack(self._socket.recv(CAN_FRAME.size))
        return can_id, data[:length]

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames; a full transmit queue is waited for shortly, then the frame is given up and logged."""
        for can_id, data in frames:
            self._send(CAN_FRAME.pack(can_id, len(data), data))

    def _send(self, frame: bytes) -> None:
        for attempt in (1, 2):
            try:
                self._socket.send(frame)
                return
            except OSError as error:
                if error.errno != errno.ENOBUFS or attempt == 2:
                    _LOG.warning("a frame was not sent: %s", error.strerror)
                    return
                # ENOBUFS is not cleared by poll() on CAN sockets: give the queue time to drain.
                time.sleep(_FULL_QUEUE_WAIT_S)

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


class PythonCanPort:
    """Any python-can bus."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def receive(self, timeout_s: float) -> Frame | None:
        """The next classic frame, or None."""
        import can  # python-can is slow to import and not needed where SocketCanPort serves

        try:
            message = self._bus.recv(timeout_s)
        except can.CanError as error:
            _LOG.warning("receive failed: %s", error)
            time.sleep(_FULL_QUEUE_WAIT_S)
            return None
        if message is None or message.is_fd:
            return None
        return raw_can_id(message), bytes(message.data)

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames; one that the bus refuses is given up and logged."""
        import can

        for can_id, data in frames:
            try:
                self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            except can.CanError as error:
                _LOG.warning("a frame was not sent: %s", error)
