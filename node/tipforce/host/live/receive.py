"""Live reception: frames from a bus in batches, ready for the bulk decoder: classic frames as a FRAME array, CAN FD
frames separately. On SocketCAN it reads many frames per call, with the kernel's time stamps and filters (``recvmmsg``);
every other interface is read through python-can.

recvmmsg fills memory that numpy reads in place. The compiled core makes FRAME of it at once; without it, and for
datagrams that are no plain frames, numpy does. Both keep the GIL (ctypes.PyDLL does): with MSG_DONTWAIT the call never
blocks, and releasing the GIL would yield to a busy thread for up to sys.getswitchinterval() (5 ms) each time. Needs a
little-endian 64-bit Linux, see ``AVAILABLE``.
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.core import core
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FRAME, SENT, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame
from tipforce.host.live.receiver import TICK_S, InterfaceDownError, Receiver, Selection, ShortSwitchInterval

ANY = "any"
"""SocketCAN channel name for all interfaces."""

_BUFFER_BYTES = 16 << 20  # of the socket: 30,000 frames/s for one second, with the kernel's overhead
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_RXQ_OVFL = 33, 35, 40  # asm-generic/socket.h; Python's socket lacks them
_SOL_CAN_RAW = 101  # the following is from linux/can/raw.h; Python's socket has it only on Linux
_CAN_RAW_FILTER, _CAN_RAW_ERR_FILTER, _CAN_RAW_FD_FRAMES, _CAN_RAW_JOIN_FILTERS = 1, 2, 5, 6
_CLASSIC_BYTES, _FD_BYTES = 16, 72  # sizeof struct can_frame and struct canfd_frame
_FD_HEADER = struct.Struct("=IBB2x")
# A frame's second word, little-endian: can_id, length, channel, flags, spare.
_ID_AND_LENGTH, _LENGTH_SHIFT, _CHANNEL_SHIFT = np.uint64((1 << 40) - 1), np.uint64(32), np.uint64(40)
_BYTE, _FULL = np.uint64(0xFF), np.uint64(8)
_SENT_BIT = np.uint64(SENT << 48)
_KEEP = np.array([(1 << 8 * length) - 1 for length in range(9)], dtype=np.uint64)  # little-endian, by data length

_DONTWAIT, _DONTROUTE = 0x40, 0x04  # linux/socket.h
_NOTHING = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR)
_DROP_MODULUS = 1 << 32
_STAMP_BYTES, _ADDRESS_BYTES = 32, 32  # CMSG_SPACE of a timespec; space for any address

_HEADER = np.dtype(
    [
        ("name", "=u8"), ("name_bytes", "=u4"), ("pad_1", "=u4"), ("parts", "=u8"), ("part_count", "=u8"),
        ("control", "=u8"), ("control_bytes", "=u8"), ("flags", "=i4"), ("pad_2", "=u4"),
        ("received_bytes", "=u4"), ("pad_3", "=u4"),
    ]
)  # fmt: skip
_KIND_WORDS = slice(6, 8)  # of a header: flags, received_bytes
_PLAIN = np.array([0, _CLASSIC_BYTES], dtype=np.uint64)
_PART = np.dtype([("base", "=u8"), ("bytes", "=u8")])
_CONTROL = np.dtype(
    [
        ("bytes_1", "=u8"), ("level_1", "=i4"), ("kind_1", "=i4"), ("seconds", "=i8"), ("nanoseconds", "=i8"),
        ("bytes_2", "=u8"), ("level_2", "=i4"), ("kind_2", "=i4"), ("drops", "=u4"), ("pad", "=u4"), ("rest", "=u8"),
    ]
)  # fmt: skip
_CAN_ADDRESS = np.dtype([("family", "=u2"), ("pad", "=u2"), ("interface", "=i4"), ("rest", "u1", (24,))])


def _function() -> ctypes._NamedFuncPointer | None:
    if sys.platform != "linux" or sys.byteorder != "little" or ctypes.sizeof(ctypes.c_void_p) != 8:
        return None
    try:
        function = ctypes.PyDLL(None, use_errno=True).recvmmsg
    except (OSError, AttributeError):
        return None
    function.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
    function.restype = ctypes.c_int
    return function


_recvmmsg = _function()
AVAILABLE = _recvmmsg is not None
"""True if this machine supports it."""


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
        self._socket, self._fd = can_socket, can_socket.fileno()
        self._switch_interval = ShortSwitchInterval()
        self._channel, self._any = channel, channel in {ANY, ""}
        self._names: dict[str, int] = {} if self._any else {channel: 0}
        self._name_of_index: dict[int, int] = {}
        self._tick_s, self._next_s = tick_s, 0.0
        self._poll = select.poll()
        self._poll.register(can_socket, select.POLLIN)
        self._dropped = self._drops = 0
        self._capacity = capacity
        self._data = np.zeros((capacity, _FD_BYTES), dtype=np.uint8)
        self._control = np.zeros(capacity, dtype=_CONTROL)
        self._addresses = np.zeros(capacity, dtype=_CAN_ADDRESS)
        self._parts = np.zeros(capacity, dtype=_PART)
        self._headers = np.zeros(capacity, dtype=_HEADER)
        self._parts["base"], self._parts["bytes"] = _rows(self._data), _FD_BYTES
        self._headers["parts"], self._headers["part_count"] = _rows(self._parts), 1
        self._headers["control"] = _rows(self._control)
        if self._any:
            self._headers["name"] = _rows(self._addresses)
        self._pointer = self._headers.ctypes.data
        # Views are created once: creating one takes as long as copying a hundred numbers.
        self._first_words = self._data.view(np.uint64)[:, :2]  # of each datagram: all of a classic frame
        self._lengths = self._headers["received_bytes"]
        self._kinds = self._headers.view(np.uint64).reshape(capacity, -1)[:, _KIND_WORDS]
        self._control_bytes = self._headers["control_bytes"]
        self._seconds, self._nanoseconds = self._control["seconds"], self._control["nanoseconds"]
        self._kind_1, self._kind_2 = self._control["kind_1"], self._control["kind_2"]
        self._release(capacity)
        self._frames: FrameArray = np.zeros(capacity, dtype=FRAME)
        self._words = self._frames.view(np.uint64).reshape(capacity, 3)  # a time and a struct can_frame
        self._is_done = False  # the frames of the last read are there, and their places are prepared for the next
        self._room, self._memory = self._frames.view(np.uint8), self._headers.view(np.uint8)
        self._is_fast = core is not None and not self._any

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
        count = self._wait(timeout_s)
        return self._frames[:count].copy() if self._is_done else self._block(count).frames

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """See Receiver."""
        count = self._wait(timeout_s)
        return CandumpBlock(self._frames[:count].copy(), tuple(self._names)) if self._is_done else self._block(count)

    def _wait(self, timeout_s: float | None) -> int:
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
        self._next_s = time.monotonic() + self._tick_s if 0 < count < self._capacity else 0.0
        return count

    def _read(self) -> int:
        if self._is_fast:
            count, plain, drops = core.receive(self._fd, self._memory, _CONTROL.itemsize, self._room)
            self._is_done = bool(plain)
            if drops >= 0:
                self._count_drops(drops)
            return int(count)
        assert _recvmmsg is not None, "recvmmsg is not available here"
        received: int = _recvmmsg(self._fd, self._pointer, self._capacity, _DONTWAIT, None)
        if received >= 0:
            return received
        number = ctypes.get_errno()
        if number in _NOTHING:
            return 0
        raise OSError(number, os.strerror(number))

    def _release(self, count: int) -> None:
        self._control_bytes[:count] = _CONTROL.itemsize
        if self._any:
            self._headers["name_bytes"][:count] = _ADDRESS_BYTES

    def _block(self, count: int) -> CandumpBlock:
        plain = not np.count_nonzero(self._kinds[:count] != _PLAIN)  # classic frames from other machines
        words = self._words[:count]
        words[:, 0] = self._times_ns(count).view(np.uint64)
        words[:, 1:] = self._first_words[:count]
        head = words[:, 1]
        head &= _ID_AND_LENGTH
        if self._any:
            head |= self._interfaces(count) << _CHANNEL_SHIFT
        if not plain:
            head |= (self._headers["flags"][:count] & _DONTROUTE).astype(np.bool_) * _SENT_BIT
        length = head >> _LENGTH_SHIFT & _BYTE
        if np.count_nonzero(length != _FULL):
            length = np.minimum(length, _FULL)
            words[:, 1] = head & ~(_BYTE << _LENGTH_SHIFT) | length << _LENGTH_SHIFT
            words[:, 2] &= _KEEP[length]  # bytes after the data are undefined
        frames, fd = self._frames[:count].copy(), list[FdFrame]()
        if not plain:
            classic = self._lengths[:count] == _CLASSIC_BYTES
            for row in np.flatnonzero(self._lengths[:count] == _FD_BYTES).tolist():
                datagram = self._data[row].tobytes()
                can_id, size, flags = _FD_HEADER.unpack_from(datagram)
                t_ns, channel, sent = int(frames["t_ns"][row]), int(frames["channel"][row]), frames["flags"][row] & SENT
                before, data = int(np.count_nonzero(classic[:row])), datagram[8 : 8 + min(size, 64)]
                fd.append(FdFrame(before, t_ns, can_id, flags, data, channel, bool(sent)))
            frames = frames[classic]
        self._release(count)
        return CandumpBlock(frames, tuple(self._names), fd=tuple(fd))

    def _times_ns(self, count: int) -> npt.NDArray[np.int64]:
        """Return the kernel's receive time of each, (count,), in nanoseconds since 1970; else the present time. Also
        updates the number of frames that the kernel dropped, which comes with the time."""
        times_ns: npt.NDArray[np.int64] = self._seconds[:count] * 1_000_000_000 + self._nanoseconds[:count]
        if not count:
            return times_ns
        last = count - 1
        # A socket with the option stamps every datagram, so checking one is enough.
        if self._control_bytes[last] < _STAMP_BYTES or self._kind_1[last] != _SO_TIMESTAMPNS:
            times_ns[:] = time.time_ns()
        elif self._control_bytes[last] > _STAMP_BYTES and self._kind_2[last] == _SO_RXQ_OVFL:
            self._count_drops(int(self._control["drops"][last]))
        return times_ns

    def _count_drops(self, drops: int) -> None:
        self._dropped += (drops - self._drops) % _DROP_MODULUS
        self._drops = drops

    def _interfaces(self, count: int) -> npt.NDArray[np.uint64]:
        index = self._addresses["interface"][:count].tolist()
        for number in set(index) - self._name_of_index.keys():
            try:
                name = socket.if_indextoname(number)
            except OSError:  # the interface was removed in the meantime
                name = f"if{number}"
            self._name_of_index[number] = self._names.setdefault(name, len(self._names))
        return np.array([self._name_of_index[number] for number in index], dtype=np.uint64)


def _rows(array: npt.NDArray[np.generic]) -> npt.NDArray[np.uint64]:
    return (array.ctypes.data + np.arange(len(array)) * array.strides[0]).astype(np.uint64)


def _not_opened(channel: str, error: Exception) -> EnvironmentLackError:
    reason = error.strerror if isinstance(error, OSError) else "this system has no SocketCAN"
    return EnvironmentLackError(
        f"interface socketcan, channel {channel}: {reason}; "
        "check -i and -c (`ip -br link` lists interfaces), or run on a kernel with vcan: `tipforce vcan -- ...`"
    )
