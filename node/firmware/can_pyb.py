"""CAN driver for ``pyb.CAN`` on an STM32, for MicroPython before ``machine.CAN``."""

from canopen_device.core import codes

from .can_port import EXTENDED, CanPort

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

_PENDING_TX = 5  # index in the list of info()


class PybCan(CanPort):
    """``can`` is ``pyb.CAN(number)``."""

    def __init__(self, can: "Any", bit_rate: int) -> None:
        self._info = [0] * 8
        super().__init__(bit_rate, can, (can.ERROR_WARNING, can.ERROR_PASSIVE, can.BUS_OFF))

    def _start(self, bit_rate: int) -> None:
        can = self._can
        can.init(can.NORMAL, baudrate=bit_rate, sample_point=80, auto_restart=False)
        # A bank accepts data frames or remote frames, not both.
        can.setfilter(0, can.MASK16, 0, (0, 0, 0, 0), rtr=(False, False))
        can.setfilter(1, can.MASK16, 0, (0, 0, 0, 0), rtr=(True, True))

    def _next(self) -> "tuple[int, bytes] | None":
        if not self._can.any(0):
            return None
        can_id, extended, remote, _filter, data = self._can.recv(0, timeout=0)
        if extended:
            return EXTENDED
        return (can_id | codes.REMOTE_FLAG, b"") if remote else (can_id, bytes(data))

    def _put(self, can_id: int, data: bytes) -> bool:
        # Mailboxes send by identifier, equal ones by mailbox number: using one at a time keeps the order.
        if self._can.info(self._info)[_PENDING_TX]:
            return False
        try:
            self._can.send(data, can_id, timeout=0)
        except OSError:
            return False
        return True
