"""Convert frames to python-can messages: for its log writers and for buses that only it can send on."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import can

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG
from tipforce.host.frames.fd_frame import BIT_RATE_SWITCH, ERROR_STATE, FdFrame
from tipforce.host.frames.frame_block import CandumpBlock


def message(t_ns: int, can_id: int, length: int, data: bytes, channel: str, sent: bool) -> can.Message:
    """Return a classic frame, ``can_id`` with SocketCAN's flags, as a message."""
    error = bool(can_id & ERROR_FLAG)
    remote = bool(can_id & REMOTE_FLAG) and not error
    return can.Message(
        timestamp=t_ns / 1_000_000_000,
        arbitration_id=can_id & EXTENDED_MASK,
        is_extended_id=bool(can_id & EXTENDED_FLAG),
        is_remote_frame=remote,
        is_error_frame=error,
        dlc=length,
        data=None if remote else data,
        channel=channel,
        is_rx=not sent,
    )


def fd_message(frame: FdFrame, channel: str) -> can.Message:
    """Return a CAN FD frame as a message."""
    return can.Message(
        timestamp=frame.t_ns / 1_000_000_000,
        arbitration_id=frame.can_id & EXTENDED_MASK,
        is_extended_id=bool(frame.can_id & EXTENDED_FLAG),
        is_error_frame=bool(frame.can_id & ERROR_FLAG),
        is_fd=True,
        bitrate_switch=bool(frame.flags & BIT_RATE_SWITCH),
        error_state_indicator=bool(frame.flags & ERROR_STATE),
        dlc=len(frame.data),
        data=frame.data,
        channel=channel,
        is_rx=not frame.sent,
    )


def block_messages(block: CandumpBlock) -> Iterator[can.Message]:
    """Return all frames of a block as messages, CAN FD frames in their order."""
    frames = block.frames
    data = frames["data"].tobytes()
    fd = deque(block.fd)
    columns = (frames["t_ns"], frames["can_id"], frames["length"], block.interface, block.sent)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for row, (t_ns, can_id, length, interface, sent) in enumerate(rows):
        while fd and fd[0].row <= row:
            yield fd_message(fd[0], block.names[fd.popleft().interface])
        yield message(t_ns, can_id, length, data[8 * row : 8 * row + length], block.names[interface], sent)
    for frame in fd:
        yield fd_message(frame, block.names[frame.interface])
