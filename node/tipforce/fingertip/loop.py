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
_INTERFACE_LOST = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)  # down, removed, and what a send says after a removal


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
        for what, value, delay_ms in device.requests:
            _LOG.info("node %d: %s", device.node_id, what)
            port.request(what, value, delay_ms)
        device.requests.clear()
    return due_us


class SocketCanPort:
    """A raw SocketCAN socket on ``interface``: the shortest way on Linux. Raises OSError if there is none.

    An interface that goes down (ENETDOWN) or away (ENODEV: an adapter is unplugged) is waited for; what a node sends
    meanwhile is lost. That is logged once, and once more when a frame passes again.
    """

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._lost = False  # frames do not pass at present
        self._bound = True  # to an interface that exists
        self._socket = _bound_socket(interface)

    def receive(self, timeout_s: float) -> Frame | None:
        """The next classic frame, or None."""
        if not self._bound:
            self._bind_again(timeout_s)
            return None
        ready, _, _ = select.select([self._socket], [], [], timeout_s)
        if not ready:
            return None
        try:
            can_id, length, data = CAN_FRAME.unpack(self._socket.recv(CAN_FRAME.size))
        except OSError as error:
            # The kernel reports it once per change, so this does not spin.
            self._lose(error)
            return None
        self._find()
        return can_id, data[:length]

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames; a full transmit queue is waited for shortly, then the frame is given up and logged."""
        for can_id, data in frames:
            self._send(CAN_FRAME.pack(can_id, len(data), data))

    def _send(self, frame: bytes) -> None:
        for attempt in (1, 2):
            try:
                self._socket.send(frame)
            except OSError as error:
                if error.errno in _INTERFACE_LOST:
                    self._lose(error)
                    return
                if error.errno != errno.ENOBUFS or attempt == 2:
                    _LOG.warning("a frame was not sent: %s", error.strerror)
                    return
                # ENOBUFS is not cleared by poll() on CAN sockets: give the queue time to drain.
                time.sleep(_FULL_QUEUE_WAIT_S)
            else:
                self._find()
                return

    def _lose(self, error: OSError) -> None:
        if error.errno in (errno.ENODEV, errno.ENXIO):
            self._bound = False
        if not self._lost:
            self._lost = True
            _LOG.warning("%s: %s; the node goes on when it is up again", self._interface, error.strerror)

    def _find(self) -> None:
        if self._lost:
            self._lost = False
            _LOG.warning("%s: up again", self._interface)

    def _bind_again(self, timeout_s: float) -> None:
        """The interface was removed and one of its name may have come: a new socket, the old one lost its filter."""
        try:
            found = _bound_socket(self._interface)
        except OSError:
            time.sleep(timeout_s)
            return
        self._socket.close()
        self._socket = found
        self._bound = True

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


def _bound_socket(interface: str) -> socket.socket:
    found = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        found.bind((interface,))
    except OSError:
        found.close()
        raise
    return found


class PythonCanPort:
    """Any python-can bus. One that fails is tried again; that is logged once, until a frame passes again."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._failing = False

    def receive(self, timeout_s: float) -> Frame | None:
        """The next classic frame, or None."""
        import can  # python-can is slow to import and not needed where SocketCanPort serves

        try:
            message = self._bus.recv(timeout_s)
        except can.CanError as error:
            self._fail("receive failed", error)
            time.sleep(_FULL_QUEUE_WAIT_S)
            return None
        if message is None or message.is_fd:
            return None
        self._failing = False
        return raw_can_id(message), bytes(message.data)

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames; one that the bus refuses is given up."""
        import can

        for can_id, data in frames:
            try:
                self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
                self._failing = False
            except can.CanError as error:
                self._fail("a frame was not sent", error)

    def _fail(self, what: str, error: can.CanError) -> None:
        if not self._failing:
            self._failing = True
            _LOG.warning("%s: %s; the node goes on when the bus works again", what, error)
