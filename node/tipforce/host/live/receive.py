"""Live reception: frames from a bus in batches, ready for the bulk decoder.

``open_receiver`` returns the same interface for every bus. On SocketCAN it reads many frames per call, with the
kernel's time stamps and filters (``recvmmsg``); every other interface is read through python-can. Classic frames
are returned as a FRAME array; CAN FD frames separately, for programs that display or record them.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import SENT, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame
from tipforce.host.live import recvmmsg
from tipforce.host.live.receiver import TICK_S, InterfaceDownError, Receiver, Selection, ShortSwitchInterval
from tipforce.host.live.recvmmsg import CLASSIC_BYTES, FD_BYTES, DatagramBatch

ANY = "any"
"""SocketCAN channel name for all interfaces."""

_BUFFER_BYTES = 16 << 20  # of the socket: 30,000 frames/s for one second, with the kernel's overhead
_SO_RCVBUFFORCE = 33  # asm-generic/socket.h
_SOL_CAN_RAW = 101  # the following is from linux/can/raw.h; Python's socket has it only on Linux
_CAN_RAW_FILTER, _CAN_RAW_ERR_FILTER, _CAN_RAW_FD_FRAMES, _CAN_RAW_JOIN_FILTERS = 1, 2, 5, 6
_FD_HEADER = struct.Struct("=IBB2x")
# A frame's second word, little-endian: can_id, length, channel, flags, spare.
_ID_AND_LENGTH, _LENGTH_SHIFT, _CHANNEL_SHIFT = np.uint64((1 << 40) - 1), np.uint64(32), np.uint64(40)
_BYTE, _FULL = np.uint64(0xFF), np.uint64(8)
_SENT_BIT = np.uint64(SENT << 48)
_KEEP = np.array([(1 << 8 * length) - 1 for length in range(9)], dtype=np.uint64)  # little-endian, by data length


Interfaces = npt.NDArray[np.uint16]


def open_receiver(
    options: Mapping[str, Any], selection: Selection | None = None, *, tick_s: float = TICK_S
) -> Receiver:
    """Open a receiver on the bus given by ``options`` (keywords of ``can.Bus``) for ``selection`` (None: data frames).

    Raises EnvironmentLackError if the bus cannot be opened; the text says what to do.
    """
    chosen = Selection() if selection is None else selection
    if options.get("interface") == "socketcan" and recvmmsg.AVAILABLE and options.get("channel") is not None:
        channel = str(options["channel"])
        return SocketReceiver(open_socket(channel, chosen), channel, tick_s=tick_s)
    from tipforce.host.live.python_can import PythonCanReceiver
    from tipforce.host.network.open_bus import open_bus

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
    can_socket.setsockopt(socket.SOL_SOCKET, recvmmsg.SO_TIMESTAMPNS, 1)
    can_socket.setsockopt(socket.SOL_SOCKET, recvmmsg.SO_RXQ_OVFL, 1)
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
        self._channel = channel
        self._any = channel in {ANY, ""}
        self._batch = DatagramBatch(can_socket, capacity, addresses=self._any)
        self._names: dict[str, int] = {} if self._any else {channel: 0}
        self._name_of_index: dict[int, int] = {}
        self._tick_s = tick_s
        self._next_s = 0.0
        self._words = self._batch.frames.view(np.uint64).reshape(capacity, 3)  # a time and a struct can_frame
        self._one_interface: Interfaces = np.zeros(capacity, dtype=np.uint16)
        self._one_interface.flags.writeable = False
        self._poll = select.poll()
        self._poll.register(can_socket, select.POLLIN)

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped so far."""
        return self._batch.dropped

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._switch_interval.close()
        self._socket.close()

    def receive(self, timeout_s: float | None = None) -> FrameArray:
        """See Receiver."""
        count = self._read(timeout_s)
        if self._batch.done:
            return self._batch.frames[:count].copy()
        plain = self._batch.plain(count)
        frames, _ = self._frames(count, plain)
        if not plain:
            frames = frames[self._batch.lengths[:count] == CLASSIC_BYTES]
        self._batch.release(count)
        return frames

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """See Receiver."""
        count = self._read(timeout_s)
        if self._batch.done:
            frames = self._batch.frames[:count].copy()
            sent = frames["flags"] == SENT
            return CandumpBlock(frames, self._one_interface[:count], tuple(self._names), sent)
        plain = self._batch.plain(count)
        frames, interface = self._frames(count, plain)
        sent = self._batch.sent(count)
        fd: tuple[FdFrame, ...] = ()
        if not plain:
            lengths = self._batch.lengths[:count]
            classic = lengths == CLASSIC_BYTES
            fd = self._fd_frames(frames, np.flatnonzero(lengths == FD_BYTES), interface, np.cumsum(classic))
            frames, interface, sent = frames[classic], interface[classic], sent[classic]
        self._batch.release(count)
        return CandumpBlock(frames, interface, tuple(self._names), sent, fd=fd)

    def _read(self, timeout_s: float | None) -> int:
        try:
            now = time.monotonic()
            if self._next_s > now:
                # Other threads run during the wait, and all new frames are read in one batch.
                time.sleep(self._next_s - now if timeout_s is None else min(self._next_s - now, timeout_s))
            count = self._batch.read()
            if not count and timeout_s != 0:
                timeout_ms = None if timeout_s is None else max(round((timeout_s - time.monotonic() + now) * 1000), 0)
                self._poll.poll(timeout_ms)
                count = self._batch.read()
        except OSError as error:
            if error.errno == errno.ENETDOWN:
                text = f"{self._channel}: interface down; `ip link set {self._channel} up` sets it up"
                raise InterfaceDownError(text) from error
            text = f"{self._channel}: {error.strerror}; `ip -details link` shows its state"
            raise EnvironmentLackError(text) from error
        # A full batch means that more frames are waiting.
        self._next_s = time.monotonic() + self._tick_s if 0 < count < self._batch.capacity else 0.0
        return count

    def _frames(self, count: int, plain: bool) -> tuple[FrameArray, Interfaces]:
        """Return the received frames as FRAME (count,), CAN FD frames cut to eight bytes; and the interface of each."""
        batch = self._batch
        words = self._words[:count]
        words[:, 0] = batch.times_ns(count).view(np.uint64)
        words[:, 1:] = batch.words[:count]
        head = words[:, 1]
        head &= _ID_AND_LENGTH
        if self._any:
            interface = self._interfaces(count)
            head |= interface.astype(np.uint64) << _CHANNEL_SHIFT
        else:
            interface = self._one_interface[:count]
        if not plain:
            head |= batch.sent(count) * _SENT_BIT
        length = head >> _LENGTH_SHIFT & _BYTE
        if np.count_nonzero(length != _FULL):
            length = np.minimum(length, _FULL)
            words[:, 1] = head & ~(_BYTE << _LENGTH_SHIFT) | length << _LENGTH_SHIFT
            words[:, 2] &= _KEEP[length]  # bytes after the data are undefined
        return self._batch.frames[:count].copy(), interface

    def _interfaces(self, count: int) -> Interfaces:
        index = self._batch.interfaces[:count].tolist()
        for number in set(index) - self._name_of_index.keys():
            try:
                name = socket.if_indextoname(number)
            except OSError:  # the interface was removed in the meantime
                name = f"if{number}"
            self._name_of_index[number] = self._names.setdefault(name, len(self._names))
        return np.array([self._name_of_index[number] for number in index], dtype=np.uint16)

    def _fd_frames(
        self,
        frames: FrameArray,
        rows: npt.NDArray[np.intp],
        interface: Interfaces,
        classic_before: npt.NDArray[np.intp],
    ) -> tuple[FdFrame, ...]:
        fd = []
        for row in rows.tolist():
            datagram = self._batch.datagram(row)
            can_id, length, flags = _FD_HEADER.unpack_from(datagram)
            data = datagram[8 : 8 + min(length, 64)]
            t_ns, sent = int(frames["t_ns"][row]), bool(frames["flags"][row] & SENT)
            fd.append(FdFrame(int(classic_before[row]), t_ns, can_id, flags, data, int(interface[row]), sent))
        return tuple(fd)


def _not_opened(channel: str, error: Exception) -> EnvironmentLackError:
    reason = error.strerror if isinstance(error, OSError) else "this system has no SocketCAN"
    return EnvironmentLackError(
        f"interface socketcan, channel {channel}: {reason}; "
        "check -i and -c (`ip -br link` lists interfaces), or run on a kernel with vcan: `tipforce vcan -- ...`"
    )
