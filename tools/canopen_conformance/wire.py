"""The wire, stated for the suite alone: identifiers, commands, states and abort codes; raw frames; the two links.

Independent of any device on purpose: a wrong number of a device must not pass its own test.
"""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

from canopen_conformance.case import CheckError, LostDeviceError

if TYPE_CHECKING:
    import can

    Sent = list[tuple[int, bytes]]
    Step = tuple[int, Sent, Sent]

# Flags and masks of a CAN identifier (linux/can.h).
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x80000000, 0x40000000, 0x20000000
STANDARD_MASK, EXTENDED_MASK = 0x7FF, 0x1FFFFFFF

# NMT commands and states (CiA 301, 7.2.8.3).
START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
STOPPED, OPERATIONAL, PRE_OPERATIONAL = 4, 5, 127
STATES = [(PRE_OPERATIONAL, "PRE-OPERATIONAL"), (OPERATIONAL, "OPERATIONAL"), (STOPPED, "STOPPED")]
RESETS = [(RESET_NODE, "reset node"), (RESET_COMMUNICATION, "reset communication")]

ANSWER_MS = 200  # timeout of a response
QUIET_MS = 30  # waiting time for a forbidden frame
DEFAULT_TOLERANCE_MS = 20  # of measured times on a bus
_KEPT = 5000  # bounds the memory on a bus with traffic of other nodes
_MOST_STEPS_AT_ONCE = 1000


class Abort:
    """SDO abort codes (CiA 301, 7.2.4.3.17)."""

    TOGGLE_BIT = 0x05030000
    TIMED_OUT = 0x05040000
    UNKNOWN_COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE_NUMBER = 0x05040003
    CRC_ERROR = 0x05040004
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    HARDWARE_ERROR = 0x06060000
    WRONG_LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUB = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL_ERROR = 0x08000000
    NOT_STORED = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class Frame(NamedTuple):
    """A frame with its SocketCAN identifier and the time of its arrival in microseconds."""

    can_id: int
    data: bytes
    at_us: int


Wanted: TypeAlias = "str | Callable[[bytes], bool] | None"


def text(can_id: int, data: bytes) -> str:
    """Format a frame as candump does; R marks a remote frame, eight digits an extended one."""
    shown = f"{can_id & EXTENDED_MASK:08X}" if can_id & EXTENDED_FLAG else f"{can_id & STANDARD_MASK:03X}"
    return f"{shown}#R" if can_id & REMOTE_FLAG else f"{shown}#{data.hex().upper()}"


def as_bytes(data: bytes | str) -> bytes:
    """Bytes, or hex text with spaces."""
    return bytes.fromhex(data) if isinstance(data, str) else data


def _fits(data: bytes, wanted: Wanted) -> bool:
    if isinstance(wanted, str):
        # "4F 01 10 00 .. 00 00 00": two dots match any byte, and "*" at the end any rest.
        pattern = wanted.replace(" ", "").lower().replace("*", ".*")
        return re.fullmatch(pattern, data.hex()) is not None
    return wanted is None or wanted(data)


class Frames:
    """A link, and the frames received that no check has consumed."""

    def __init__(self, link: Link, node_id: int) -> None:
        self.link = link
        self.node_id = node_id
        self.log: list[str] = []
        self._pending: deque[Frame] = deque(maxlen=_KEPT)

    @property
    def now_us(self) -> int:
        """The link's clock."""
        return self.link.now_us()

    def send(self, can_id: int, data: bytes | str = b"") -> None:
        """Send a frame."""
        content = as_bytes(data)
        self._note(">", can_id, content, self.now_us)
        self.link.send(can_id, content)

    def expect(self, can_id: int, wanted: Wanted = None, within_ms: float = ANSWER_MS) -> Frame:
        """Return the next frame with ``can_id``, which must arrive in time and match. Other frames stay pending."""
        frame = self.heard(can_id, within_ms)
        what = wanted if isinstance(wanted, str) else "with other content"
        if frame is None:
            raise CheckError(f"a frame {can_id:03X}h {what if wanted else ''} within {within_ms:g} ms", "none")
        if not _fits(frame.data, wanted):
            raise CheckError(f"{can_id:03X}#{what}", text(frame.can_id, frame.data))
        return frame

    def heard(self, can_id: int, within_ms: float = ANSWER_MS) -> Frame | None:
        """Return the next frame with ``can_id``, None if none arrives in time."""
        limit_us = self.now_us + round(1000 * (within_ms + self.link.tolerance_ms))
        while True:
            for frame in self._pending:
                if frame.can_id == can_id:
                    self._pending.remove(frame)
                    return frame
            if not self._pump(limit_us):
                return None

    def silence(self, *can_ids: int, ms: float = QUIET_MS) -> None:
        """Check that no frame of these identifiers (default: the device's, except heartbeat) arrives or is pending."""
        self.sleep(ms)
        for frame in self._pending:
            can_id = frame.can_id
            own = can_id & 0x7F == self.node_id and 0x80 <= can_id < 0x600 and can_id & 0x780 != 0x500
            if can_id in can_ids if can_ids else own or can_id == 0x7E4:
                raise CheckError("silence", text(can_id, frame.data))

    def sleep(self, ms: float) -> None:
        """Wait; received frames stay pending."""
        limit_us = self.now_us + round(1000 * ms)
        while self._pump(limit_us):
            pass

    def forget(self, *can_ids: int) -> None:
        """Discard pending frames (default: of any identifier)."""
        self.sleep(0)
        kept = [frame for frame in self._pending if can_ids and frame.can_id not in can_ids]
        self._pending.clear()
        self._pending.extend(kept)

    def check_ms(self, what: str, actual_us: float, expected_ms: float) -> None:
        """Check that a measured time is the expected one, within the link's tolerance."""
        if abs(actual_us / 1000 - expected_ms) > self.link.tolerance_ms:
            raise CheckError(f"{what} {expected_ms:g} ms (+-{self.link.tolerance_ms} ms)", f"{actual_us / 1000:.1f} ms")

    def _pump(self, limit_us: int) -> bool:
        frame = self.link.receive(limit_us)
        if frame is None:
            return False
        self._note("<", *frame)
        self._pending.append(frame)
        return True

    def _note(self, direction: str, can_id: int, data: bytes, at_us: int) -> None:
        self.log.append(f"{at_us / 1000:10.1f} ms  {direction} {text(can_id, data)}")


class Core(Protocol):
    """A device as a pure state machine, driven by ``CoreLink``."""

    def step(self, now_us: int, frames: Sent = ...) -> tuple[Sent, int]:
        """Frames in; frames out and the next due time."""


class CoreLink:
    """A device core whose clock advances only by waiting. ``steps`` keeps (now_us, frames in, frames out).

    ``tolerance_ms`` is the permitted timing error.
    """

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


Link: TypeAlias = CoreLink | BusLink
