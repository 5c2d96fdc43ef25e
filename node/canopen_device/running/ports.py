"""The port of the loop to SocketCAN: a raw socket."""

from __future__ import annotations

import errno
import json
import logging
import select
import socket
import subprocess
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING

from canopen_device.can_frame import CAN_FRAME
from canopen_device.core import codes
from canopen_device.core.emcy import TRANSMIT_OVERFLOW

if TYPE_CHECKING:
    from canopen_device.running.loop import Frame

_LOG = logging.getLogger(__name__)
_FULL_QUEUE_WAIT_S = 0.05
_INTERFACE_LOST = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)  # down, removed, send after a removal
_ERROR_FILTER, _ALL_ERRORS = 2, codes.EXTENDED_MASK  # CAN_RAW_ERR_FILTER and CAN_ERR_MASK of linux/can.h


class SocketCanPort:
    """A raw SocketCAN socket, the fastest port on Linux. Raises OSError without ``interface``. It waits for one that
    goes down (ENETDOWN) or is removed (ENODEV), and logs both ends once; frames sent meanwhile are lost."""

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._overflow = False  # a frame was dropped: the device must report it
        self._refused = False  # logged already; a bus without listeners would otherwise fill a log in days
        self._lost = False  # frames do not pass at present
        self._bound = True  # bound to an interface that exists
        self._socket = _bound_socket(interface)

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next classic frame or error frame, or None."""
        if not self._bound:  # the interface was removed: a new socket, because the old one lost its filter
            try:
                bound = _bound_socket(self._interface)
            except OSError:
                time.sleep(timeout_s)
                return None
            self._socket.close()
            self._socket, self._bound = bound, True
            return None
        if self._overflow:
            self._overflow = False
            return TRANSMIT_OVERFLOW
        ready, _, _ = select.select([self._socket], [], [], timeout_s)
        if not ready:
            return None
        try:
            can_id, length, data = CAN_FRAME.unpack(self._socket.recv(CAN_FRAME.size))
        except OSError as error:
            # The kernel reports it once per change, so this is not a busy loop.
            self._lose(error)
            return None
        # A frame may have waited since before the interface went down: that it is up again shows a sent one.
        return can_id, data[:length]

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames; wait shortly for a full transmit queue, then drop the frame and log it."""
        pack, send = CAN_FRAME.pack, self._socket.send
        for can_id, data in frames:
            try:
                send(pack(can_id, len(data), data))
            except OSError as error:
                self._send_again(pack(can_id, len(data), data), error)
            else:
                if self._refused or self._lost:
                    self._find()

    def _send_again(self, frame: bytes, error: OSError) -> None:
        """Send a frame a second and last time if the error may be temporary."""
        if error.errno == errno.ENOBUFS:
            # ENOBUFS is not cleared by poll() on CAN sockets: give the queue time to drain.
            time.sleep(_FULL_QUEUE_WAIT_S)
            try:
                self._socket.send(frame)
                self._find()
                return
            except OSError as again:
                error = again
        if error.errno in _INTERFACE_LOST:
            self._lose(error)
            return
        self._overflow = self._overflow or error.errno == errno.ENOBUFS
        if not self._refused:
            self._refused = True
            _LOG.warning("a frame was not sent: %s; no further warning until a frame passes", error.strerror)

    def request(self, what: str, value: int, delay_ms: int) -> None:
        """Restart the controller after bus-off, or switch the bit rate, with ``ip link``; needs its privileges."""
        link = ["ip", "link", "set", self._interface]
        if what == "bus-restart":
            _run([*link, "type", "can", "restart"], "enable automatic restart: `ip link set ... restart-ms 100`")
        elif what == "bit-rate" and not _has_bit_timing(self._interface):
            _LOG.warning("%s has no bit timing: LSS requests %d bit/s, nothing changes", self._interface, value)
        elif what == "bit-rate":
            time.sleep(delay_ms / 1000)  # CiA 305, 6.4.4: the switch delay, in which no node sends
            _run([*link, "down"], "set the bit rate manually")
            _run([*link, "type", "can", "bitrate", str(value)], f"set the bit rate manually to {value} bit/s")
            _run([*link, "up"], "set the interface up manually")
            time.sleep(delay_ms / 1000)

    def _lose(self, error: OSError) -> None:
        if error.errno in (errno.ENODEV, errno.ENXIO):
            self._bound = False
        if not self._lost:
            self._lost = True
            _LOG.warning("%s: %s; the node continues when it is up again", self._interface, error.strerror)

    def _find(self) -> None:
        self._refused = False
        if self._lost:
            self._lost = False
            _LOG.warning("%s: up again", self._interface)

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


def _bound_socket(interface: str) -> socket.socket:
    made = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        made.setsockopt(socket.SOL_CAN_RAW, _ERROR_FILTER, _ALL_ERRORS)
        made.bind((interface,))
    except OSError:
        made.close()
        raise
    return made


def _has_bit_timing(interface: str) -> bool:
    """Return whether `ip` shows a CAN controller; vcan, vxcan and slcan have no bit timing to set."""
    command = ["ip", "-json", "-details", "link", "show", interface]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout
        return any(link.get("linkinfo", {}).get("info_kind") == "can" for link in json.loads(shown))
    except (OSError, subprocess.SubprocessError, ValueError):
        return False  # without `ip` it could not be set either


def _run(command: list[str], remedy: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
        complaint = done.stderr.strip() if done.returncode else ""
    except (OSError, subprocess.TimeoutExpired) as error:
        complaint = str(error)
    if complaint:
        _LOG.warning("%s: %s; %s", " ".join(command), complaint, remedy)
