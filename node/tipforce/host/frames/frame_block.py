"""A block of frames with the names of their interfaces: the output of text, logs and live buses."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from canopen_device.can_frame import raw_can_id
from tipforce.host.frames.frame_array import FRAME, PACK_FRAME, SENT, FrameArray

if TYPE_CHECKING:
    import can

BIT_RATE_SWITCH, ERROR_STATE = 0x01, 0x02
"""Bits of ``flags``: CANFD_BRS and CANFD_ESI of linux/can.h."""

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""The valid data lengths of an FD frame."""


Frame: TypeAlias = tuple[int, int, int, bytes, int, bool, int | None]
"""t_ns, can_id with SocketCAN's flags, length, data, index of the interface, sent, ``flags`` of CAN FD (else None)."""


class FdFrame(NamedTuple):
    """One CAN FD frame of a block; it came just before the classic frame ``row`` of the block (or after the last)."""

    row: int
    t_ns: int
    can_id: int  # with SocketCAN's flags
    flags: int
    data: bytes  # 0 to 64 bytes
    interface: int  # index into the block's names
    sent: bool


@dataclass(frozen=True, slots=True, eq=False)
class CandumpBlock:
    """Frames from text: ``frames`` FRAME (n,), whose ``channel`` indexes ``names``. ``timed`` is False for a line
    without timestamp; its ``t_ns`` is 0. ``fd``: the CAN FD frames, in order."""

    frames: FrameArray
    names: tuple[str, ...]
    timed: bool = True
    fd: tuple[FdFrame, ...] = ()

    def __len__(self) -> int:
        """Return the number of all frames, CAN FD included."""
        return len(self.frames) + len(self.fd)

    def take(self, rows: npt.NDArray[np.bool_], fd_rows: Iterable[bool]) -> CandumpBlock:
        """Return the block with only ``rows`` of its classic frames, and ``fd_rows`` of its FD frames."""
        row_now = np.concatenate(([0], np.cumsum(rows))).tolist()
        fd = tuple(one._replace(row=row_now[one.row]) for one, kept in zip(self.fd, fd_rows, strict=True) if kept)
        return CandumpBlock(self.frames[rows], self.names, self.timed, fd)

    def between(self, start: int, end: int) -> CandumpBlock:
        """Return the block with its classic frames ``start`` to ``end``, and the FD frames among and behind them."""
        last, row = end == len(self.frames), np.arange(len(self.frames))
        fd_rows = [start <= frame.row < end or (last and frame.row >= end) for frame in self.fd]
        return self.take((start <= row) & (row < end), fd_rows)

    def head(self, count: int) -> CandumpBlock:
        """Return the block with only its first frames, FD frames included in the count."""
        if count >= len(self):
            return self
        fd_rows = [frame.row + number < count for number, frame in enumerate(self.fd)]
        return self.take(np.arange(len(self.frames)) < count - sum(fd_rows), fd_rows)

    def in_order(self) -> Iterator[Frame]:
        """Yield all frames, CAN FD frames in their places."""
        frames = self.frames
        fd = deque((one.row, (*one[1:3], len(one.data), *one[4:], one.flags)) for one in self.fd)
        data = frames["data"].tobytes()
        sent = frames["flags"] & SENT != 0
        columns = (frames["t_ns"], frames["can_id"], frames["length"], frames["channel"], sent)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for row, (t_ns, can_id, length, interface, is_sent) in enumerate(rows):
            while fd and fd[0][0] <= row:
                yield fd.popleft()[1]
            yield t_ns, can_id, length, data[8 * row : 8 * row + length], interface, is_sent, None
        for _, frame in fd:
            yield frame

    def positions(self) -> npt.NDArray[np.intp]:
        """Return the position of each classic frame among all frames of the block: (n,)."""
        rows = np.arange(len(self.frames))
        if not self.fd:
            return rows
        return rows + np.searchsorted([one.row for one in self.fd], rows, side="right")


def packed(message: can.Message, t_ns: int, interface: int) -> bytes | FdFrame:
    """Return a message of python-can as the bytes of a FRAME, or as a CAN FD frame."""
    can_id, data, sent = raw_can_id(message), bytes(message.data), not message.is_rx
    if message.is_fd or len(data) > 8:  # of a format that does not record what is CAN FD
        flags = message.bitrate_switch * BIT_RATE_SWITCH + message.error_state_indicator * ERROR_STATE
        return FdFrame(0, t_ns, can_id, flags, data, interface, sent)
    length = message.dlc if message.is_remote_frame else len(data)
    return PACK_FRAME(t_ns, can_id, min(length, 8), interface, SENT if sent else 0, data)


def gathered(rows: Iterable[bytes | FdFrame], names: tuple[str, ...], timed: bool = True) -> CandumpBlock:
    """Return frames in order, classic ones as the bytes of a FRAME, as a block."""
    frames, fd = bytearray(), list[FdFrame]()
    for row in rows:
        if isinstance(row, FdFrame):
            fd.append(row._replace(row=len(frames) // FRAME.itemsize))
        else:
            frames += row
    return CandumpBlock(np.frombuffer(frames, dtype=FRAME), names, timed, tuple(fd))
