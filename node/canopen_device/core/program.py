"""Program download (CiA 302-3): 1F50h data, 1F51h control, 1F56h identification, 1F57h flash status; program 1. A
download goes into the slot that does not run. ``START`` starts what was downloaded: the node restarts with it."""

from . import codes, communication

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Protocol

    from .node import Device
    from .object_dictionary import Value
    from .sdo_server import Sink

    class Programs(Protocol):
        """The slots of a node; methods return 0 or a reason. ``busy``: a download or trial; ``locked``: a trial."""

        reason: int
        version: str
        crc: int
        ready: bool

        @property
        def busy(self) -> bool: ...
        @property
        def locked(self) -> bool: ...
        def begin(self, size: int) -> int: ...  # open the slot that does not run for an image of so many bytes
        def write(self, part: bytes) -> int: ...
        def end(self) -> int: ...  # check the image
        def cancel(self) -> None: ...
        def clear(self) -> int: ...  # erase what was downloaded
        def start(self) -> int: ...  # what was downloaded, from the next restart on


# 1F51h:1, written and read.
STOP, START, RESET, CLEAR = 0, 1, 2, 3
STOPPED, RUNNING = 0, 1
# 1F57h:1: bit 0 in progress, bits 1 to 7 the error of CiA 302-3, bits 16 to 31 the reason of the slots.
IN_PROGRESS, REASON_SHIFT = 1, 16
# Of each reason: the error (2 format unknown, 3 format or CRC, 5 write, 6 address, 63 unspecified), the abort code.
_ERRORS = (0, 2, 2, 3, 63, 5, 6, 63)
_ABORTS = (
    0, codes.INVALID_VALUE, codes.INVALID_VALUE, codes.INVALID_VALUE, codes.NOT_TRANSFERRED, codes.HARDWARE,
    codes.OUT_OF_MEMORY, codes.GENERAL,
)  # fmt: skip
RESTART_DELAY_MS = 50  # the response to START is on the bus by then


class ProgramDownload:
    """The objects of a device with program slots. Not in OPERATIONAL: flash stops a node for milliseconds."""

    def __init__(self, device: "Device", programs: "Programs") -> None:
        self._device, self._programs = device, programs
        self._state = RUNNING
        od = device.od
        od.add(communication.SOFTWARE_VERSION, 0, ("s", "const", 0, programs.version, None, None))
        od.sinks[communication.PROGRAM_DATA] = self._open
        od.writers[communication.PROGRAM_DATA] = lambda _sub, _value: codes.INVALID_VALUE  # 4 bytes are no image
        od.writers[communication.PROGRAM_CONTROL] = self._control
        od.readers[communication.PROGRAM_CONTROL] = lambda _sub: self._state
        od.readers[communication.PROGRAM_IDENTIFICATION] = lambda _sub: programs.crc
        od.readers[communication.FLASH_STATUS] = lambda _sub: (
            (IN_PROGRESS if programs.busy else 0) | _ERRORS[programs.reason] << 1 | programs.reason << REASON_SHIFT
        )

    def write(self, part: bytes) -> int:
        """Write the next bytes of a download; return 0 or an abort code."""
        return codes.DEVICE_STATE if self._refuses() else _ABORTS[self._programs.write(part)]

    def end(self) -> int:
        """Check the downloaded image; return 0 or an abort code."""
        return _ABORTS[self._programs.end()]

    def cancel(self) -> None:
        """Give up a download."""
        self._programs.cancel()

    def _open(self, _sub: int, size: "int | None") -> "Sink | int":
        if self._refuses():
            return codes.DEVICE_STATE
        if size is None:
            return codes.LENGTH
        return self._device.wear.spend(1) or _ABORTS[self._programs.begin(size)] or self

    def _refuses(self) -> bool:
        return self._device.nmt.state == codes.OPERATIONAL or self._programs.locked

    def _control(self, _sub: int, value: "Value") -> int:
        if self._refuses():
            return codes.DEVICE_STATE
        if value == CLEAR:
            return self._device.wear.spend(1) or _ABORTS[self._programs.clear()]
        if value == RESET or (value == START and self._programs.ready):
            abort = _ABORTS[self._programs.start()] if value == START else 0
            if not abort:
                self._device.requests.append(("restart", 0, RESTART_DELAY_MS))
            return abort
        self._state = STOPPED if value == STOP else RUNNING
        return 0
