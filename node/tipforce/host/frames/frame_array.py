"""Frames in bulk: the structured array that live reception and logs share, and a buffer that collects them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tipforce.socketcan import raw_can_id

if TYPE_CHECKING:
    import can  # only what it hands over is needed: a log of candump's is read without its 65 ms of import

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
channel (an index into the source's list of interface names), flags (SENT), a zero, data.

All numbers are aligned, and behind t_ns it is laid out as Linux' ``struct can_frame``.
"""

SENT = 1
"""In ``flags``: this machine sent the frame itself (candump -x says TX, python-can's logs T)."""

MAX_CHANNELS = 256
"""How many interfaces ``channel`` can tell apart."""

FrameArray = npt.NDArray[np.void]
RawFrame = tuple[int, int, bytes]  # t_ns, can_id with SocketCAN's flags, data


def frame_array(frames: Iterable[RawFrame]) -> FrameArray:
    """Frames as (t_ns, can_id, data of at most 8 bytes) -> FRAME array, shape (n,); missing data bytes are zero."""
    rows = [(t_ns, can_id, len(data), 0, 0, 0, tuple(data.ljust(8, b"\0"))) for t_ns, can_id, data in frames]
    return np.array(rows, dtype=FRAME)


def raw_frame(message: can.Message) -> RawFrame:
    """A python-can message as (t_ns, can_id, data)."""
    return round(message.timestamp * 1e9), raw_can_id(message), bytes(message.data)


class FrameBuffer:
    """Keeps every classic frame that a python-can Notifier hands it, until someone takes it.

    ``limit`` bounds the memory: beyond it the oldest frames go and ``dropped`` counts them.
    """

    def __init__(self, limit: int = 1_000_000) -> None:
        self._frames: list[RawFrame] = []
        self._arrived = threading.Condition()
        self.limit = limit
        self.dropped = 0

    def __call__(self, msg: can.Message) -> None:
        """Called by the Notifier's thread."""
        self.on_message_received(msg)

    def on_message_received(self, msg: can.Message) -> None:
        """Keep a frame."""
        if msg.is_fd:
            return
        with self._arrived:
            self._frames.append(raw_frame(msg))
            if len(self._frames) > self.limit:
                excess = len(self._frames) - self.limit // 2
                del self._frames[:excess]
                self.dropped += excess
            self._arrived.notify_all()

    def stop(self) -> None:
        """Called by the Notifier when it ends."""

    def take(self, complete: Callable[[int], bool], deadline: float) -> FrameArray:
        """Remove and return frames up to the first whose can_id makes ``complete`` true, or up to ``deadline``.

        ``deadline`` is a time of ``time.monotonic()``. ``complete`` sees each frame once, in order.
        """
        taken: list[RawFrame] = []
        with self._arrived:
            while True:
                end = next((k + 1 for k, frame in enumerate(self._frames) if complete(frame[1])), None)
                taken += self._frames[:end]
                del self._frames[:end]
                if end is not None:
                    return frame_array(taken)
                remaining_s = deadline - time.monotonic()
                if remaining_s <= 0 or not self._arrived.wait(remaining_s):
                    return frame_array(taken)

    def put(self, frame: RawFrame) -> None:
        """Add a frame from elsewhere, behind all that has arrived."""
        with self._arrived:
            self._frames.append(frame)
            self._arrived.notify_all()

    def take_some(self, deadline: float) -> FrameArray:
        """Remove and return what has arrived, as soon as there is something; empty at ``deadline`` (monotonic)."""
        with self._arrived:
            while not self._frames:
                remaining_s = deadline - time.monotonic()
                if remaining_s <= 0 or not self._arrived.wait(remaining_s):
                    break
            taken, self._frames = self._frames, []
        return frame_array(taken)

    def take_all(self) -> FrameArray:
        """Remove and return what has arrived so far."""
        with self._arrived:
            taken, self._frames = self._frames, []
        return frame_array(taken)

    def clear(self) -> None:
        """Forget what has arrived so far."""
        with self._arrived:
            self._frames.clear()
