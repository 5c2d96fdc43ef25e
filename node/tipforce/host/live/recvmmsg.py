"""Read datagrams of a socket in batches: Linux' recvmmsg, into memory that numpy reads in place.

One call returns up to ``capacity`` frames, each with the kernel's time. The compiled core makes FRAME of them at once;
without it, and for datagrams that are no plain frames, numpy does. Both keep the GIL (ctypes.PyDLL does):
with MSG_DONTWAIT the call never blocks, and releasing the GIL at each call would yield to a busy thread of this
process for up to sys.getswitchinterval() (5 ms) each time. Needs a little-endian 64-bit Linux, see ``AVAILABLE``.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import sys
import time

import numpy as np
import numpy.typing as npt

from tipforce.core import core
from tipforce.host.frames.frame_array import FRAME, FrameArray

SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
"""Options of SOL_SOCKET missing in Python's socket: arrival time in nanoseconds, and the number of drops."""

CLASSIC_BYTES, FD_BYTES = 16, 72
"""sizeof struct can_frame and struct canfd_frame."""

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
_PLAIN = np.array([0, CLASSIC_BYTES], dtype=np.uint64)
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


class DatagramBatch:
    """Memory for ``capacity`` datagrams of one socket, and the call that fills it.

    The caller keeps ownership of the socket. Time stamps and drop count need SO_TIMESTAMPNS and SO_RXQ_OVFL.
    """

    def __init__(self, datagram_socket: socket.socket, capacity: int = 256, *, addresses: bool = False) -> None:
        """``addresses``: store the interface of each CAN frame."""
        self._fd = datagram_socket.fileno()
        self.capacity = capacity
        """The maximum number of datagrams per read."""
        self._data = np.zeros((capacity, FD_BYTES), dtype=np.uint8)
        self._control = np.zeros(capacity, dtype=_CONTROL)
        self._addresses = np.zeros(capacity, dtype=_CAN_ADDRESS)
        self._parts = np.zeros(capacity, dtype=_PART)
        self._headers = np.zeros(capacity, dtype=_HEADER)
        self._parts["base"] = _rows(self._data)
        self._parts["bytes"] = FD_BYTES
        self._headers["parts"] = _rows(self._parts)
        self._headers["part_count"] = 1
        self._headers["control"] = _rows(self._control)
        self._name_bytes = _ADDRESS_BYTES if addresses else 0
        if addresses:
            self._headers["name"] = _rows(self._addresses)
        self._pointer = self._headers.ctypes.data
        # Views are created once: creating one takes as long as copying a hundred numbers.
        self.words: npt.NDArray[np.uint64] = self._data.view(np.uint64)[:, :2]
        """The first 16 bytes of each datagram, (capacity, 2): all of a classic frame."""
        self.lengths: npt.NDArray[np.uint32] = self._headers["received_bytes"]
        """The number of bytes of each datagram, (capacity,)."""
        self.interfaces: npt.NDArray[np.int32] = self._addresses["interface"]
        """The index of the interface of each datagram, (capacity,)."""
        self._flags = self._headers["flags"]
        self._kinds = self._headers.view(np.uint64).reshape(capacity, -1)[:, _KIND_WORDS]
        self._control_bytes = self._headers["control_bytes"]
        self._seconds, self._nanoseconds = self._control["seconds"], self._control["nanoseconds"]
        self._kind_1, self._kind_2 = self._control["kind_1"], self._control["kind_2"]
        self._drops = 0
        self.dropped = 0
        self.release(capacity)
        self.frames: FrameArray = np.zeros(capacity, dtype=FRAME)
        """Room for the frames, (capacity,)."""
        self.done = False
        """The frames of the last read are in it, and their places are prepared for the next."""
        self._room, self._memory = self.frames.view(np.uint8), self._headers.view(np.uint8)
        self._is_fast = core is not None and not addresses

    def read(self) -> int:
        """Read the waiting datagrams; return their number. Raises OSError, for instance ENETDOWN."""
        if self._is_fast:
            found, plain, drops = core.receive(self._fd, self._memory, _CONTROL.itemsize, self._room)
            self.done = bool(plain)
            if drops >= 0:
                self._count_drops(drops)
            return int(found)
        assert _recvmmsg is not None, "recvmmsg is not available here"
        count: int = _recvmmsg(self._fd, self._pointer, self.capacity, _DONTWAIT, None)
        if count >= 0:
            return count
        number = ctypes.get_errno()
        if number in _NOTHING:
            return 0
        raise OSError(number, os.strerror(number))

    def release(self, count: int) -> None:
        """Prepare the first ``count`` places for the next read; called after their content has been copied."""
        self._control_bytes[:count] = _CONTROL.itemsize
        if self._name_bytes:
            self._headers["name_bytes"][:count] = self._name_bytes

    def datagram(self, row: int) -> bytes:
        """Return all bytes of one datagram."""
        return self._data[row, : int(self.lengths[row])].tobytes()

    def plain(self, count: int) -> bool:
        """Return whether all are classic frames from other machines."""
        return not np.count_nonzero(self._kinds[:count] != _PLAIN)

    def sent(self, count: int) -> npt.NDArray[np.bool_]:
        """Return which datagrams a process of this machine sent, (count,)."""
        sent: npt.NDArray[np.bool_] = (self._flags[:count] & _DONTROUTE).astype(np.bool_)
        return sent

    def times_ns(self, count: int) -> npt.NDArray[np.int64]:
        """Return the kernel's receive time of each, (count,), in nanoseconds since 1970; else the present time.

        Also updates the number of frames that the kernel dropped, which comes with the time.
        """
        times_ns: npt.NDArray[np.int64] = self._seconds[:count] * 1_000_000_000 + self._nanoseconds[:count]
        if not count:
            return times_ns
        last = count - 1
        # A socket with the option stamps every datagram, so checking one is enough.
        if self._control_bytes[last] < _STAMP_BYTES or self._kind_1[last] != SO_TIMESTAMPNS:
            times_ns[:] = time.time_ns()
        elif self._control_bytes[last] > _STAMP_BYTES and self._kind_2[last] == SO_RXQ_OVFL:
            self._count_drops(int(self._control["drops"][last]))
        return times_ns

    def _count_drops(self, drops: int) -> None:
        self.dropped += (drops - self._drops) % _DROP_MODULUS
        self._drops = drops


def _rows(array: npt.NDArray[np.generic]) -> npt.NDArray[np.uint64]:
    """Return the address of each row of a C-contiguous array."""
    return (array.ctypes.data + np.arange(len(array)) * array.strides[0]).astype(np.uint64)
