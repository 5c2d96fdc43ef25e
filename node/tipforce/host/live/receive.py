"""Live reception: frames from a bus in batches, ready for the bulk decoder: classic frames as a FRAME array, CAN FD
frames separately. On SocketCAN with the kernel's time stamps and filters; every other interface through python-can.

The compiled core reads many frames by recvmmsg. It keeps the GIL: with MSG_DONTWAIT the call never blocks, and
releasing the GIL would yield to a busy thread for up to sys.getswitchinterval() (5 ms) each time. Without the core each
frame is one recvmsg.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from canopen_device.can_frame import CAN_FRAME
from tipforce.core import core
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FRAME, PACK_FRAME, SENT, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame
from tipforce.host.live.receiver import TICK_S, InterfaceDownError, Receiver, Selection, ShortSwitchInterval

ANY = "any"
"""SocketCAN channel name for all interfaces."""

_BUFFER_BYTES = 16 << 20  # of the socket: 30,000 frames/s for one second, with the kernel's overhead
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_RXQ_OVFL = 33, 35, 40  # asm-generic/socket.h; Python's socket lacks them
_SOL_CAN_RAW = 101  # the following is from linux/can/raw.h; Python's socket has it only on Linux
_CAN_RAW_FILTER, _CAN_RAW_ERR_FILTER, _CAN_RAW_FD_FRAMES, _CAN_RAW_JOIN_FILTERS = 1, 2, 5, 6
_CLASSIC_BYTES, _FD_BYTES = 16, 72  # sizeof struct can_frame and struct canfd_frame
_FD_HEADER = struct.Struct("=IBB")
_STAMP, _DROPS = struct.Struct("@ll"), struct.Struct("=I")  # struct timespec; number of frames
_CONTROL_BYTES = 64  # of both
_DONTWAIT, _DONTROUTE = 0x40, 0x04  # linux/socket.h
_DROP_MODULUS = 1 << 32

AVAILABLE = sys.platform == "linux"
"""True if this system supports it."""


def open_receiver(
    options: Mapping[str, Any], selection: Selection | None = None, *, tick_s: float = TICK_S
) -> Receiver:
    """Open a receiver on the bus given by ``options`` (keywords of ``can.Bus``) for ``selection`` (None: data frames).
    Raises EnvironmentLackError if the bus cannot be opened; the text says what to do."""
    chosen = Selection() if selection is None else selection
    if options.get("interface") == "socketcan" and AVAILABLE and options.get("channel") is not None:
        channel = str(options["channel"])
        return SocketReceiver(open_socket(channel, chosen), channel, tick_s=tick_s)
    from tipforce.host.live.python_can import PythonCanReceiver
    from tipforce.host.network.interfaces import open_bus

    return PythonCanReceiver(open_bus(**options), chosen, str(options.get("channel") or ""))


def open_socket(channel: str, selection: Selection) -> socket.socket:
    """Return a raw CAN socket on ``channel`` (``any`` or empty: all) with filters, time stamps and CAN FD frames."""
    try:
        can_socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except (OSError, AttributeError) as error:
        raise _not_opened(channel, error) from error
    try:
        # All options before bind: a frame that the filters exclude is never received.
        can_socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", selection.error_mask))
        words = [word for rule in selection.filters for word in rule.kernel_words()] or [0, 0]
        can_socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, struct.pack(f"={len(words)}I", *words))
        if selection.join:
            can_socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_JOIN_FILTERS, 1)
        with suppress(OSError):  # the kernel has no CAN FD
            can_socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
        prepare_socket(can_socket)
        can_socket.bind(("" if channel == ANY else channel,))
    except OSError as error:
        can_socket.close()
        raise _not_opened(channel, error) from error
    return can_socket


def prepare_socket(can_socket: socket.socket) -> None:
    """Set the socket options that a SocketReceiver needs: time stamps, the drop count, a large buffer."""
    can_socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    can_socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
    try:
        can_socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
    except OSError:  # needs CAP_NET_ADMIN; without it the kernel limits the buffer to net.core.rmem_max
        can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)


class SocketReceiver(Receiver):
    """Receiver on a datagram socket that carries ``struct can_frame``: a raw CAN socket, or a substitute."""

    def __init__(self, can_socket: socket.socket, channel: str, *, tick_s: float = TICK_S, capacity: int = 256) -> None:
        """Take ownership of the socket. ``tick_s`` 0: every receive returns at the first frame."""
        self._socket = can_socket
        self._switch_interval = ShortSwitchInterval()
        self._channel, self._any = channel, channel in {ANY, ""}
        self._names: dict[str, int] = {} if self._any else {channel: 0}
        self._number_of: dict[int, int] = {}  # by the kernel's number of the interface
        self._tick_s, self._next_s = tick_s, 0.0
        self._poll = select.poll()
        self._poll.register(can_socket, select.POLLIN)
        self._dropped = self._drops = 0
        self._frames: FrameArray = np.zeros(capacity, dtype=FRAME)
        self._interfaces = np.zeros(capacity, dtype=np.int32)
        # Views are created once: creating one takes as long as copying a hundred numbers.
        self._memory = self._frames.view(np.uint8), self._interfaces.view(np.uint8)
        self._count = 0  # classic frames of the last read
        self._fd: list[FdFrame] = []
        self._error: OSError | None = None  # after the frames that were read before it

    @property
    def dropped(self) -> int:
        """See Receiver."""
        return self._dropped

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._switch_interval.close()
        self._socket.close()

    def receive(self, timeout_s: float | None = None) -> FrameArray:
        """See Receiver."""
        self._wait(timeout_s)
        return self._frames[: self._count].copy()

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """See Receiver."""
        frames = self.receive(timeout_s)
        return CandumpBlock(frames, tuple(self._names), fd=tuple(self._fd))

    def _wait(self, timeout_s: float | None) -> None:
        try:
            now = time.monotonic()
            if self._next_s > now:
                # Other threads run during the wait, and all new frames are read in one batch.
                time.sleep(self._next_s - now if timeout_s is None else min(self._next_s - now, timeout_s))
            count = self._read()
            if not count and timeout_s != 0:
                timeout_ms = None if timeout_s is None else max(round((timeout_s - time.monotonic() + now) * 1000), 0)
                self._poll.poll(timeout_ms)
                count = self._read()
        except OSError as error:
            if error.errno == errno.ENETDOWN:
                text = f"{self._channel}: interface down; `ip link set {self._channel} up` sets it up"
                raise InterfaceDownError(text) from error
            text = f"{self._channel}: {error.strerror}; `ip -details link` shows its state"
            raise EnvironmentLackError(text) from error
        # A full batch means that more frames are waiting.
        self._next_s = time.monotonic() + self._tick_s if 0 < count < len(self._frames) else 0.0

    def _read(self) -> int:
        """Read the waiting frames; return the number of datagrams."""
        self._fd = []
        if core is None:
            return self._read_each()
        fd_frames: list[tuple[int, int, int, int, bytes, int, bool]] = []
        count, self._count, drops = core.receive(self._socket.fileno(), *self._memory, fd_frames)
        if drops >= 0:
            self._count_drops(drops)
        if self._any:
            interfaces = self._interfaces[: self._count].tolist()
            self._frames["channel"][: self._count] = [self._number(interface) for interface in interfaces]
        self._fd = [FdFrame(*of[:5], self._number(of[5]) if self._any else 0, of[6]) for of in fd_frames]
        return int(count)

    def _read_each(self) -> int:
        error, self._error, self._count, count = self._error, None, 0, 0
        if error is not None:
            raise error
        while count < len(self._frames):
            try:
                datagram, controls, flags, address = self._socket.recvmsg(_FD_BYTES, _CONTROL_BYTES, _DONTWAIT)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as failure:
                if not count:
                    raise
                self._error = failure
                break
            count += 1
            told = {kind: data for _, kind, data in controls}
            if _SO_RXQ_OVFL in told:
                self._count_drops(*_DROPS.unpack(told[_SO_RXQ_OVFL]))
            seconds, nanoseconds = _STAMP.unpack(told[_SO_TIMESTAMPNS]) if _SO_TIMESTAMPNS in told else (0, 0)
            t_ns = seconds * 1_000_000_000 + nanoseconds or time.time_ns()
            channel = self._names.setdefault(address[0], len(self._names)) if self._any else 0
            sent = flags & _DONTROUTE != 0
            if len(datagram) == _CLASSIC_BYTES:
                can_id, length, data = CAN_FRAME.unpack(datagram)
                frame = PACK_FRAME(t_ns, can_id, min(length, 8), channel, SENT if sent else 0, data[:length])
                self._frames[self._count] = np.frombuffer(frame, dtype=FRAME)[0]
                self._count += 1
            elif len(datagram) == _FD_BYTES:
                can_id, length, fd_flags = _FD_HEADER.unpack_from(datagram)
                data = datagram[8 : 8 + min(length, 64)]
                self._fd.append(FdFrame(self._count, t_ns, can_id, fd_flags, data, channel, sent))
        return count

    def _count_drops(self, drops: int) -> None:
        self._dropped += (drops - self._drops) % _DROP_MODULUS
        self._drops = drops

    def _number(self, interface: int) -> int:
        """Return our number of an interface by the kernel's."""
        if interface not in self._number_of:
            try:
                name = socket.if_indextoname(interface)
            except OSError:  # the interface was removed in the meantime
                name = f"if{interface}"
            self._number_of[interface] = self._names.setdefault(name, len(self._names))
        return self._number_of[interface]


def _not_opened(channel: str, error: Exception) -> EnvironmentLackError:
    reason = error.strerror if isinstance(error, OSError) else "this system has no SocketCAN"
    return EnvironmentLackError(
        f"interface socketcan, channel {channel}: {reason}; "
        "check -i and -c (`ip -br link` lists interfaces), or run on a kernel with vcan: `tipforce vcan -- ...`"
    )
