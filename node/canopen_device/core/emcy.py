"""EMCY producer (CiA 301, 7.2.7), objects 1001h, 1003h, 1014h, 1015h; an error is active until it is cured."""

import struct

from . import codes, communication
from .timed import Timed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device
    from .object_dictionary import Value

# Error codes (table 26) and the bits that each sets in the error register (table 48) in addition to bit 0, generic.
GENERIC, TEMPERATURE, COMMUNICATION, PROFILE, MANUFACTURER = 0x01, 0x08, 0x10, 0x20, 0x80
NO_ERROR = 0x0000
CAN_OVERRUN, ERROR_PASSIVE, HEARTBEAT_LOST, BUS_OFF_RECOVERED = 0x8110, 0x8120, 0x8130, 0x8140
COB_ID_COLLISION, PDO_LENGTH, SYNC_LENGTH, RPDO_TIMEOUT = 0x8150, 0x8210, 0x8240, 0x8250
WEAR_BUDGET_EMPTY = 0xFF10
HISTORY_LENGTH = 8  # of a device without 1003h
MAX_WAITING = 64  # limit of messages queued by the inhibit time or in STOPPED: bounds memory


class Emcy(Timed):
    """Raise and clear errors; ``register`` is the value of 1001h."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self._history: "list[int]" = []
        self._active: "dict[tuple[int, int], int]" = {}
        self._waiting: "list[bytes]" = []
        self.reset(True)
        od = device.od
        subs = od.subs(communication.ERROR_HISTORY)
        self._history_length = subs[-1] if subs else HISTORY_LENGTH
        od.readers[communication.ERROR_REGISTER] = lambda _sub: self.register
        od.readers[communication.ERROR_HISTORY] = self._read_history
        od.writers[communication.ERROR_HISTORY] = self._write_history
        od.writers[communication.COB_ID_EMCY] = self._write_cob_id

    def reset(self, whole: bool) -> None:
        """Discard the active errors whose monitors restart with this reset: not the controller's, and after a
        communication reset not the application's. What stays active is still reported where its message waited. The
        history stays until power-off or 0 in 1003h:0."""
        lowest = CAN_OVERRUN if whole else 0
        self._active = {key: bits for key, bits in self._active.items() if lowest <= key[0] <= ERROR_PASSIVE}
        waiting, self._waiting = self._waiting, []
        self._free_us = 0
        self._update_register()
        for data in waiting:
            code, _register, detail = struct.unpack("<HBH", data[:5])
            if (code, detail) in self._active:
                self._queue(struct.pack("<HBHHx", code, self.register, detail, 0))
        self.schedule()

    def raise_error(self, code: int, bits: int, detail: int = 0) -> None:
        """Report an error that is not active yet; ``detail`` (16 bits) distinguishes errors of one code."""
        key = (code, detail)
        if key in self._active:
            return
        self._active[key] = bits | GENERIC
        self._update_register()
        self.report(code, detail)

    def cure(self, code: int, detail: int = 0) -> None:
        """Report that an active error has ended: code 0000h, with the cleared code and its detail in the data."""
        if not self._active or self._active.pop((code, detail), None) is None:
            return
        self._update_register()
        self._queue(struct.pack("<HBHHx", 0, self.register, code, detail))

    def cure_all_but(self, code: int, details: "list[int]") -> None:
        """Clear the active errors of a code whose detail is not in ``details``: they are no longer monitored."""
        for active, detail in sorted(self._active):  # the same order everywhere: MicroPython's dicts are unordered
            if active == code and detail not in details:
                self.cure(code, detail)

    def report(self, code: int, detail: int = 0) -> None:
        """Report an event that has no end: history entry and message, no bit in the register."""
        self._history.insert(0, code | detail << 16)
        del self._history[self._history_length :]
        self._queue(struct.pack("<HBHHx", code, self.register, detail, 0))

    def expire(self, now_us: int) -> None:
        """Send the next queued message."""
        if self._waiting and self._may_send():
            od = self._device.od
            self._device.send(od.integer(communication.COB_ID_EMCY) & codes.STANDARD_MASK, self._waiting.pop(0))
            self._free_us = now_us + 100 * od.integer(communication.EMCY_INHIBIT_TIME)
        self.schedule()

    def _queue(self, data: bytes) -> None:
        del self._waiting[MAX_WAITING - 1 :]  # the newest replaces the last: its register is that of now
        self._waiting.append(data)
        self.schedule()

    def schedule(self) -> None:
        """Set the due time of queued messages, also after a change of the NMT state or of 1014h."""
        self.due_us = self._free_us if self._waiting and self._may_send() else codes.NEVER_US

    def _may_send(self) -> bool:
        cob_id = self._device.od.integer(communication.COB_ID_EMCY)
        valid = bool(cob_id & codes.STANDARD_MASK) and not cob_id & codes.COB_ID_INVALID
        # While the controller is bus-off a message would be lost, so it stays queued.
        return valid and self._device.nmt.state in codes.TALKING and not self._device.bus_faults.off

    def _update_register(self) -> None:
        self.register = 0
        for bits in self._active.values():
            self.register |= bits

    def is_empty(self, sub: int) -> bool:
        """Return True for an entry of 1003h that holds no error: it cannot be read (7.5.2.4)."""
        return len(self._history) < sub <= self._history_length

    def _read_history(self, sub: int) -> "Value":
        if self.is_empty(sub):
            return 0
        return self._history[sub - 1] if sub else len(self._history)

    def _write_history(self, _sub: int, value: "Value") -> int:
        if value != 0:
            return codes.INVALID_VALUE
        self._history = []
        return 0

    def _write_cob_id(self, _sub: int, value: "Value") -> int:
        old, new = self._device.od.integer(communication.COB_ID_EMCY), int(value)
        if new & codes.COB_ID_RESERVED:
            return codes.INVALID_VALUE
        if not new & codes.COB_ID_INVALID:
            # As for a PDO: an identifier in use can be changed only after it was made invalid (7.5.2.17).
            used = not old & codes.COB_ID_INVALID and new & codes.STANDARD_MASK != old & codes.STANDARD_MASK
            if used or codes.restricted(new & codes.STANDARD_MASK):
                return codes.INVALID_VALUE
        self._device.od.values[communication.COB_ID_EMCY << 8] = new
        self.schedule()
        return 0


CONTROLLER, BUS_OFF, RESTARTED = 0x004, 0x040, 0x100  # error classes, in the identifier
OVERFLOW, PASSIVE, WARNING, ACTIVE = 0x03, 0x30, 0x0C, 0x40  # of a controller error, in data byte 1
TRANSMIT_OVERFLOW = codes.ERROR_FLAG | CONTROLLER, b"\0\x02\0\0\0\0\0\0"
"""Error frame by which a loop reports that its transmit queue was full."""

FIRST_RESTART_US, LAST_RESTART_US = 100000, 10000000  # bus-off recovery backs off from one to the other
OVERRUN_QUIET_US = 1000000  # an overrun has ended when none occurred for this time


class BusFaults(Timed):
    """Monitor the bus; ``off`` is true while the controller is bus-off and cannot send."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self.off = False
        self._wait_us, self._back_us = FIRST_RESTART_US, 0
        self._restart_at_us = self._overrun_until_us = codes.NEVER_US

    def receive(self, can_id: int, data: bytes) -> None:
        """Process an error frame."""
        detail = data[1] if len(data) > 1 and can_id & CONTROLLER else 0
        if can_id & BUS_OFF:
            if not self.off:
                self.off = True
                if self._device.now_us - self._back_us > LAST_RESTART_US:
                    self._wait_us = FIRST_RESTART_US  # the bus was free of faults for long: this is a new fault
                self._restart_at_us = self._device.now_us + self._wait_us
                self._device.communication_failed()
        elif self.off and (can_id & RESTARTED or detail & (ACTIVE | WARNING)):
            self.heard()
        if detail & OVERFLOW:
            self._device.emcy.raise_error(CAN_OVERRUN, COMMUNICATION)
            self._overrun_until_us = self._device.now_us + OVERRUN_QUIET_US
        if detail & PASSIVE:
            self._device.emcy.raise_error(ERROR_PASSIVE, COMMUNICATION)
        elif detail & (ACTIVE | WARNING) or can_id & RESTARTED:
            self._device.emcy.cure(ERROR_PASSIVE)
        self._schedule()

    def heard(self) -> None:
        """Handle the first data frame after a fault: the bus has recovered, whatever the controller last reported."""
        self.off = False
        self._back_us = self._device.now_us
        self._restart_at_us = codes.NEVER_US
        self._device.emcy.report(BUS_OFF_RECOVERED)
        self._schedule()

    def collision(self, can_id: int) -> "Callable[[bytes], None]":
        """Return the handler of an identifier that only this node may send."""
        return lambda _data: self._device.emcy.raise_error(COB_ID_COLLISION, COMMUNICATION, can_id)

    def expire(self, now_us: int) -> None:
        """Request a restart of the controller, or report the end of an overrun."""
        if self._restart_at_us <= now_us:
            self._device.requests.append(("bus-restart", 0, 0))
            self._wait_us = min(2 * self._wait_us, LAST_RESTART_US)
            self._restart_at_us = now_us + self._wait_us
        if self._overrun_until_us <= now_us:
            self._overrun_until_us = codes.NEVER_US
            self._device.emcy.cure(CAN_OVERRUN)
        self._schedule()

    def _schedule(self) -> None:
        self.due_us = min(self._restart_at_us, self._overrun_until_us)
