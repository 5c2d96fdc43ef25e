"""SYNC producer (CiA 301, 7.2.5), objects 1005h bit 30, 1006h and 1019h. A device without 1006h does without."""

from . import codes, communication
from .timed import Timed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device
    from .object_dictionary import Value


class SyncProducer(Timed):
    """Send SYNC every 1006h microseconds in PRE-OPERATIONAL and OPERATIONAL; this device's own PDOs follow it."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self._on = False
        self._counter = 0
        od = device.od
        write_cob_id = od.writers[communication.COB_ID_SYNC]
        od.writers[communication.COB_ID_SYNC] = lambda sub, value: self._write_cob_id(write_cob_id, sub, value)
        od.writers[communication.SYNC_PERIOD] = lambda _sub, value: self._start(int(value))
        od.writers[communication.SYNC_OVERFLOW] = self._write_overflow

    def reset(self) -> None:
        """Apply the present values of 1005h and 1006h; the first SYNC follows after one period."""
        od = self._device.od
        self._on = bool(od.integer(communication.COB_ID_SYNC) & codes.SYNC_PRODUCER)
        self._on = self._on and not codes.restricted(self._device.sync.cob_id)  # as an EDS may have it
        self._start(od.integer(communication.SYNC_PERIOD))

    def state_changed(self) -> None:
        """Stop in STOPPED; otherwise start if nothing is due yet. The counter then starts at 1 (7.2.5.1)."""
        if self._device.nmt.state not in codes.TALKING:
            self.due_us = codes.NEVER_US
        elif self.due_us == codes.NEVER_US:
            self._start(self._device.od.integer(communication.SYNC_PERIOD))

    def expire(self, now_us: int) -> None:
        """Send one SYNC; late calls do not shift the following ones."""
        device = self._device
        overflow = device.od.integer(communication.SYNC_OVERFLOW)
        data = b""
        if overflow:
            self._counter = self._counter % overflow + 1
            data = bytes((self._counter,))
        device.send(device.sync.cob_id, data)
        self.due_us += device.od.integer(communication.SYNC_PERIOD)
        if self.due_us <= now_us:
            self.due_us = now_us + device.od.integer(communication.SYNC_PERIOD)
        device.sync.receive(data)

    def _start(self, period_us: int) -> int:
        self._counter = 0
        talking = self._device.nmt.state in codes.TALKING
        self.due_us = self._device.now_us + period_us if self._on and period_us and talking else codes.NEVER_US
        return 0

    def _write_cob_id(self, write: "Callable[[int, Value], int]", sub: int, value: "Value") -> int:
        cob_id = int(value)
        if self._on and cob_id & codes.SYNC_PRODUCER and cob_id & codes.STANDARD_MASK != self._device.sync.cob_id:
            return codes.INVALID_VALUE  # the identifier in use does not change (7.5.2.5)
        abort = write(sub, cob_id & ~codes.SYNC_PRODUCER)
        if not abort and self._on != bool(cob_id & codes.SYNC_PRODUCER):
            self._on = not self._on
            self._start(self._device.od.integer(communication.SYNC_PERIOD))
        return abort

    def _write_overflow(self, _sub: int, value: "Value") -> int:
        if self._device.od.integer(communication.SYNC_PERIOD):
            return codes.DEVICE_STATE  # 7.5.2.22
        return 0 if value == 0 or 2 <= int(value) <= codes.LAST_SYNCHRONOUS else codes.INVALID_VALUE
