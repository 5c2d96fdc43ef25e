"""Frames in bulk: the structured array for live reception and logs, and a buffer that collects frames."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from canopen_device.can_frame import raw_can_id
from canopen_device.core import codes

if TYPE_CHECKING:
    import can  # only for types: a candump log is read without its import time of 65 ms

FRAME = np.dtype(
    [
        ("t_ns", "<i8"),
        ("can_id", "<u4"),
        ("length", "u1"),
        ("channel", "u1"),
        ("flags", "u1"),
        ("spare", "u1"),
        ("data", "u1", (8,)),
    ]
)
"""One classic CAN frame in 24 bytes: receive time in nanoseconds, SocketCAN can_id (flags included), data length,
channel (an index into the source's list of interface names), flags (SENT), a zero, data. All numbers are aligned, and
the part after t_ns has the layout of Linux' ``struct can_frame``."""

SENT = 1
"""In ``flags``: this machine sent the frame (TX in candump -x, T in python-can's logs)."""

MAX_CHANNELS = 256
"""Number of interfaces that ``channel`` can distinguish."""

PACK_FRAME = struct.Struct("<qIBBBx8s").pack
"""Return one FRAME as bytes."""
FIELDS = struct.Struct("<qIB3xQ")
"""Of FRAME: t_ns, can_id, length, and the data as a little-endian number."""

FrameArray = npt.NDArray[np.void]
RawFrame = tuple[int, int, bytes]  # t_ns, can_id with SocketCAN's flags, data


def frame_array(frames: Iterable[RawFrame]) -> FrameArray:
    """Convert frames (t_ns, can_id, data of at most 8 bytes) to FRAME (n,); missing data bytes are zero."""
    rows = [(t_ns, can_id, len(data), 0, 0, 0, tuple(data.ljust(8, b"\0"))) for t_ns, can_id, data in frames]
    return np.array(rows, dtype=FRAME)


def heartbeats_and_emcys(frames: FrameArray) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield row, function code, node-id and data of the heartbeats and EMCYs of any length among FRAME (n,)."""
    can_id = frames["can_id"]
    function = can_id & np.uint32(~codes.NODE_ID_MASK & 0xFFFFFFFF)
    chosen = (function == codes.HEARTBEAT_BASE) | (function == codes.EMCY_BASE)
    for row in np.flatnonzero(chosen & (can_id != function)).tolist():  # 0x080 is the SYNC
        data = frames["data"][row, : frames["length"][row]].tobytes()
        yield row, int(function[row]), int(can_id[row] & codes.NODE_ID_MASK), data


class FrameBuffer:
    """Store every classic frame of a python-can Notifier until it is read; ``dropped``: the oldest beyond ``limit``."""

    def __init__(self, limit: int = 1_000_000) -> None:
        self._frames: list[RawFrame] = []
        self._arrived = threading.Condition()
        self.limit = limit
        self.dropped = 0

    def __call__(self, msg: can.Message) -> None:
        """Store a frame; called by the Notifier's thread."""
        if msg.is_fd:
            return
        with self._arrived:
            self._frames.append((round(msg.timestamp * 1e9), raw_can_id(msg), bytes(msg.data)))
            if len(self._frames) > self.limit:
                excess = len(self._frames) - self.limit // 2
                del self._frames[:excess]
                self.dropped += excess
            self._arrived.notify_all()

    def take(self, can_ids: Collection[int], deadline: float) -> FrameArray:
        """Remove and return frames until each of ``can_ids`` has come, or to ``deadline`` (``time.monotonic()``)."""
        taken, missing = list[RawFrame](), set(can_ids)
        with self._arrived:
            while True:
                for count, frame in enumerate(self._frames, start=1):
                    missing.discard(frame[1])
                    if not missing:
                        taken += self._frames[:count]
                        del self._frames[:count]
                        return frame_array(taken)
                taken += self._frames
                self._frames.clear()
                if (remaining_s := deadline - time.monotonic()) <= 0:
                    return frame_array(taken)
                self._arrived.wait(remaining_s)  # then the frames are looked at, also those after a late end of it

    def put(self, frame: RawFrame) -> None:
        """Append a frame from another source."""
        with self._arrived:
            self._frames.append(frame)
            self._arrived.notify_all()

    def take_some(self, deadline: float) -> FrameArray:
        """Remove and return the received frames as soon as there are any; empty at ``deadline`` (monotonic)."""
        with self._arrived:
            while not self._frames:
                if (remaining_s := deadline - time.monotonic()) <= 0:
                    break
                self._arrived.wait(remaining_s)
            taken, self._frames = self._frames, []
        return frame_array(taken)

    def take_all(self) -> FrameArray:
        """Remove and return the received frames."""
        return self.take_some(0.0)

    def clear(self) -> None:
        """Discard the received frames."""
        with self._arrived:
            self._frames.clear()
