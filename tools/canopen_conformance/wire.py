"""The wire, stated for the suite alone: identifiers, commands, states and abort codes; raw frames; the two links.
Independent of any device on purpose: a wrong number of a device must not pass its own test."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

from canopen_conformance.case import LostDeviceError

if TYPE_CHECKING:
    import can

    Sent = list[tuple[int, bytes]]
    Step = tuple[int, Sent, Sent]

# Flags and masks of a CAN identifier (linux/can.h).
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x80000000, 0x40000000, 0x20000000
STANDARD_MASK, EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
# Identifiers of the device under test: ``Dut`` adds its node-id; PDO is the one that a case has set up.
OF_DEVICE, PDO = 0x10000, 0x20000
EMCY, SDO, REQUEST, HEARTBEAT = OF_DEVICE | 0x080, OF_DEVICE | 0x580, OF_DEVICE | 0x600, OF_DEVICE | 0x700

# NMT commands and states (CiA 301, 7.2.8.3).
START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
STOPPED, OPERATIONAL, PRE_OPERATIONAL = 4, 5, 127
STATES = [(PRE_OPERATIONAL, "PRE-OPERATIONAL"), (OPERATIONAL, "OPERATIONAL"), (STOPPED, "STOPPED")]
RESETS = [(RESET_NODE, "reset node"), (RESET_COMMUNICATION, "reset communication")]

ANSWER_MS = 200  # timeout of a response
QUIET_MS = 30  # waiting time for a forbidden frame
DEFAULT_TOLERANCE_MS, MOST_TOLERANCE_MS = 20, 60_000  # of measured times on a bus
_MOST_STEPS_AT_ONCE = 1000
_DRAIN_US = 1_000_000  # for frames that came in time


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


def abort_code(data: bytes) -> int:
    """Return the code of an SDO abort, 0 of another SDO frame."""
    return int.from_bytes(data[4:], "little") if data[0] == 0x80 else 0


class Frame(NamedTuple):
    """A frame with its SocketCAN identifier and the time of its arrival in microseconds."""

    can_id: int
    data: bytes
    at_us: int


def text(can_id: int, data: bytes) -> str:
    """Format a frame as candump does; R marks a remote frame, eight digits an extended one."""
    shown = f"{can_id & EXTENDED_MASK:08X}" if can_id & EXTENDED_FLAG else f"{can_id & STANDARD_MASK:03X}"
    return f"{shown}#R" if can_id & REMOTE_FLAG else f"{shown}#{data.hex().upper()}"


def as_bytes(data: bytes | str) -> bytes:
    """Bytes, or hex text with spaces."""
    return bytes.fromhex(data) if isinstance(data, str) else data


class Core(Protocol):
    """A device as a pure state machine, driven by ``CoreLink``."""

    def step(self, now_us: int, frames: Sent = ...) -> tuple[Sent, int]:
        """Frames in; frames out and the next due time."""


class CoreLink:
    """A device core on a clock that waiting advances. ``steps``: (now_us, frames in, frames out)."""

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
        self._looked_us = self._drained_us = 0

    def now_us(self) -> int:
        """Microseconds of the monotonic clock."""
        self._looked_us = time.monotonic_ns() // 1000
        return self._looked_us

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
        """Return the next classic CAN frame; long after ``until_us`` none, even of a bus that has ever more."""
        while True:
            looked_us, now_us = self._looked_us, self.now_us()
            if looked_us <= until_us < now_us:  # however late this is seen: the process may have stood still
                self._drained_us = now_us + _DRAIN_US
            if now_us > max(until_us, self._drained_us):
                return None
            message = self._bus.recv(max(0.0, (until_us - now_us) * 1e-6))
            if message is None:
                return None
            if not (message.is_fd or message.is_error_frame):
                flags = EXTENDED_FLAG * message.is_extended_id | REMOTE_FLAG * message.is_remote_frame
                return Frame(message.arbitration_id | flags, bytes(message.data), time.monotonic_ns() // 1000)


Link: TypeAlias = CoreLink | BusLink
