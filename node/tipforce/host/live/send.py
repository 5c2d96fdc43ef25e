"""Send frames of every kind that a bus carries: raw SocketCAN, and python-can for every other interface."""

import errno
import socket
import struct
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from canopen_device.can_frame import CAN_FRAME
from tipforce.errors import EnvironmentLackError
from tipforce.host.live.receive import open_socket
from tipforce.host.live.receiver import Filter, Selection

_FD_FRAME = struct.Struct("=IBB2x64s")  # struct canfd_frame
_FULL_QUEUE_WAIT_S = 0.001
_GIVE_UP_S = 5.0


class NotCarriedError(Exception):
    """The bus does not carry frames of this kind."""


class SocketCanSender(AbstractContextManager["SocketCanSender"]):
    """Sender on a raw CAN socket."""

    def __init__(self, channel: str) -> None:
        """Open the socket. Raises EnvironmentLackError if the interface does not exist."""
        self._channel = channel
        self._socket = open_socket(channel, Selection((Filter(0, 0, inverse=True),)))  # it receives nothing

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, can_id: int, length: int, data: bytes, fd_flags: int | None = None) -> None:
        """Send a frame, ``can_id`` with SocketCAN's flags; ``fd_flags``: of CAN FD, None for a classic frame. Raises
        EnvironmentLackError if the bus fails, NotCarriedError where it carries no CAN FD."""
        is_fd = fd_flags is not None
        frame = _FD_FRAME.pack(can_id, length, fd_flags, data) if is_fd else CAN_FRAME.pack(can_id, length, data)
        give_up_s = 0.0
        while True:
            try:
                self._socket.send(frame)
                return
            except OSError as error:
                if is_fd and error.errno == errno.EINVAL:
                    raise NotCarriedError(f"{self._channel} carries no CAN FD frames") from None
                now = time.monotonic()
                give_up_s = give_up_s or now + _GIVE_UP_S
                if error.errno != errno.ENOBUFS or now > give_up_s:
                    raise self._failed(error) from error
            time.sleep(_FULL_QUEUE_WAIT_S)  # poll() does not report free space in the queue

    def _failed(self, error: OSError) -> EnvironmentLackError:
        hint = "`ip -details link` shows its state"
        if error.errno == errno.ENOBUFS:
            hint = "the transmit queue stays full: check that another node on the bus acknowledges frames"
        elif error.errno == errno.ENODEV:
            hint = "`ip -br link` lists interfaces"
        return EnvironmentLackError(f"interface socketcan, channel {self._channel}: {error.strerror}; {hint}")


class PythonCanSender(AbstractContextManager["PythonCanSender"]):
    """Sender on any python-can bus."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        """Open the bus. Raises EnvironmentLackError if it cannot be opened."""
        from tipforce.host.network.interfaces import open_bus

        self._name = str(options.get("channel") or options.get("interface") or "the bus")
        self._bus = open_bus(**options)

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def send(self, can_id: int, length: int, data: bytes, fd_flags: int | None = None) -> None:
        """See SocketCanSender."""
        import can

        from tipforce.host.live.python_can import message

        try:
            self._bus.send(message(0, can_id, length, data, "", False, fd_flags))
        except (can.CanError, OSError, ValueError) as error:
            if fd_flags is not None:
                raise NotCarriedError(f"{self._name} carries no CAN FD frames (try --fd): {error}") from None
            raise EnvironmentLackError(f"{self._name}: a frame was not sent: {error}") from error


Sender = SocketCanSender | PythonCanSender
"""A context manager."""


def open_sender(options: Mapping[str, Any]) -> Sender:
    """Return a sender on the bus given by ``options`` (keywords of ``can.Bus``). Raises EnvironmentLackError."""
    if options.get("interface") == "socketcan" and options.get("channel") and hasattr(socket, "AF_CAN"):
        return SocketCanSender(str(options["channel"]))
    return PythonCanSender(options)
