"""Bus faults that the CAN controller reports as SocketCAN error frames (linux/can/error.h): passive, overrun, bus-off.

Also detects another node that uses this node's identifiers. An EMCY reports each fault once; the device continues.
"""

from . import codes
from .emcy import BUS_OFF_RECOVERED, CAN_OVERRUN, COB_ID_COLLISION, COMMUNICATION, ERROR_PASSIVE

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device

CONTROLLER, BUS_OFF, RESTARTED = 0x004, 0x040, 0x100  # error classes, in the identifier
OVERFLOW, PASSIVE, WARNING, ACTIVE = 0x03, 0x30, 0x0C, 0x40  # of a controller error, in data byte 1
TRANSMIT_OVERFLOW = codes.ERROR_FLAG | CONTROLLER, b"\0\x02\0\0\0\0\0\0"
"""Error frame by which a loop reports that its transmit queue was full."""

FIRST_RESTART_US, LAST_RESTART_US = 100000, 10000000  # bus-off recovery backs off from one to the other
OVERRUN_QUIET_US = 1000000  # an overrun has ended when none occurred for this time


class BusFaults:
    """Monitor the bus; ``off`` is true while the controller is bus-off and cannot send."""

    __slots__ = ("_back_us", "_device", "_overrun_until_us", "_restart_at_us", "_wait_us", "due_us", "off")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.off = False
        self._wait_us = FIRST_RESTART_US
        self._back_us = 0
        self._restart_at_us = codes.NEVER_US
        self._overrun_until_us = codes.NEVER_US
        self.due_us = codes.NEVER_US

    def receive(self, can_id: int, data: bytes) -> None:
        """Process an error frame."""
        detail = data[1] if len(data) > 1 and can_id & CONTROLLER else 0
        if can_id & BUS_OFF:
            self._went_off()
        elif self.off and (can_id & RESTARTED or detail & (ACTIVE | WARNING)):
            self._came_back()
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
        self._came_back()
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

    def _went_off(self) -> None:
        if not self.off:
            self.off = True
            if self._device.now_us - self._back_us > LAST_RESTART_US:
                self._wait_us = FIRST_RESTART_US  # the bus was free of faults for long: this is a new fault
            self._restart_at_us = self._device.now_us + self._wait_us
            self._device.communication_failed()

    def _came_back(self) -> None:
        self.off = False
        self._back_us = self._device.now_us
        self._restart_at_us = codes.NEVER_US
        self._device.emcy.report(BUS_OFF_RECOVERED)

    def _schedule(self) -> None:
        self.due_us = min(self._restart_at_us, self._overrun_until_us)
