"""CAN driver for ``machine.CAN``, which MicroPython has after 1.27, for a controller inside the microcontroller."""

from canopen_device.core import codes

from .can_port import EXTENDED, CanPort

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


class MachineCan(CanPort):
    """``can`` is ``machine.CAN(number, bit_rate)``."""

    def __init__(self, can: "Any", bit_rate: int) -> None:
        super().__init__(bit_rate, can, (can.STATE_WARNING, can.STATE_PASSIVE, can.STATE_BUS_OFF))

    def _start(self, bit_rate: int) -> None:
        self._can.deinit()
        self._can.init(bit_rate, sample_point=80)
        self._can.set_filters(None)

    def _next(self) -> "tuple[int, bytes] | None":
        message = self._can.recv()
        if message is None:
            return None
        can_id, data, flags, errors = message
        if errors & self._can.RECV_ERR_OVERRUN:
            self.overrun()
        if flags & self._can.FLAG_EXT_ID:
            return EXTENDED
        return (can_id | codes.REMOTE_FLAG, b"") if flags & self._can.FLAG_RTR else (can_id, bytes(data))

    def _put(self, can_id: int, data: bytes) -> bool:
        try:
            return self._can.send(can_id, data) is not None
        except OSError:  # bus-off, which the state reports next
            return False
