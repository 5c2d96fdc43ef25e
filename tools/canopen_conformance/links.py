"""The two links on which cases run: a device core in this process with a fake clock, and any python-can bus."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Protocol

from canopen_conformance.case import LostDeviceError
from canopen_conformance.raw_frames import EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG, STANDARD_MASK, Frame

if TYPE_CHECKING:
    import can

    Sent = list[tuple[int, bytes]]
    Step = tuple[int, Sent, Sent]

DEFAULT_TOLERANCE_MS = 20
_MOST_STEPS_AT_ONCE = 1000


class Core(Protocol):
    """A device as a pure state machine, driven by ``CoreLink``."""

    def step(self, now_us: int, frames: Sent = ...) -> tuple[Sent, int]:
        """Frames in; frames out and the next due time."""


class CoreLink:
    """A device core whose clock advances only by waiting. ``steps`` keeps (now_us, frames in, frames out)."""

    tolerance_ms = 0
    error_frames = True

    def __init__(self, device: Core) -> None:
        self._device = device
        self._now_us = self._due_us = 0
        self._queue: deque[Frame] = deque()
        self.steps: list[Step] = []
        self._step([])

    def now_us(self) -> int:
        """Return the fake time in microseconds."""
        return self._now_us

    def send(self, can_id: int, data: bytes) -> None:
        """Pass the frame to the device."""
        self._step([(can_id, data)])

    def receive(self, until_us: int) -> Frame | None:
        """Step the device at each of its due times until it sends a frame."""
        for _ in range(_MOST_STEPS_AT_ONCE):
            if self._queue:
                return self._queue.popleft()
            if self._due_us > until_us:
                self._now_us = max(self._now_us, until_us)
                return None
            self._now_us = max(self._now_us, self._due_us)
            self._step([])
        raise AssertionError(f"the device is always due at {self._now_us} us")

    def _step(self, frames: Sent) -> None:
        sent, self._due_us = self._device.step(self._now_us, frames)
        self.steps.append((self._now_us, frames, list(sent)))
        self._queue.extend(Frame(can_id, data, self._now_us) for can_id, data in sent)


class BusLink:
    """A python-can bus with a device on it, and the machine's clock."""

    error_frames = False

    def __init__(self, bus: can.BusABC, tolerance_ms: int = DEFAULT_TOLERANCE_MS) -> None:
        self._bus = bus
        self.tolerance_ms = tolerance_ms

    def now_us(self) -> int:
        """Microseconds of the monotonic clock."""
        return time.monotonic_ns() // 1000

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame. Raises LostDeviceError if the bus accepts nothing for a second."""
        import can

        extended = bool(can_id & EXTENDED_FLAG)
        message = can.Message(
            arbitration_id=can_id & (EXTENDED_MASK if extended else STANDARD_MASK),
            data=data,
            is_extended_id=extended,
            is_remote_frame=bool(can_id & REMOTE_FLAG),
        )
        try:
            self._bus.send(message, timeout=1.0)
        except can.CanError as error:
            raise LostDeviceError(f"the bus no longer accepts frames: {error}") from error

    def receive(self, until_us: int) -> Frame | None:
        """Return the next classic CAN frame."""
        while True:
            left_s = max(0.0, (until_us - self.now_us()) * 1e-6)
            message = self._bus.recv(left_s)
            if message is None:
                return None
            if not (message.is_fd or message.is_error_frame):
                flags = EXTENDED_FLAG * message.is_extended_id | REMOTE_FLAG * message.is_remote_frame
                return Frame(message.arbitration_id | flags, bytes(message.data), self.now_us())
