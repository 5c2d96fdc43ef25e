"""SYNC consumer (CiA 301, 7.2.5), objects 1005h, 1007h and 1019h."""

from . import codes, communication
from .emcy import COMMUNICATION, SYNC_LENGTH

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device
    from .object_dictionary import Value

OVERFLOW = communication.SYNC_OVERFLOW << 8  # the key of 1019h in ``od.values``


class SyncConsumer:
    """SYNC consumer: the application latches one sample, then the synchronous PDOs are sent."""

    __slots__ = ("_device", "cob_id", "last_us")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.cob_id = codes.SYNC_COB_ID
        self.last_us = 0
        device.od.writers[communication.COB_ID_SYNC] = self._write_cob_id
        device.od.writers[communication.SYNC_OVERFLOW] = self._write_overflow

    def reset(self) -> None:
        """Apply the present value of 1005h."""
        self.cob_id = self._device.od.integer(communication.COB_ID_SYNC) & codes.STANDARD_MASK or codes.SYNC_COB_ID

    def receive(self, data: bytes) -> None:
        """Process a SYNC frame: no data, or one counter byte if 1019h is set; other lengths are an error."""
        device = self._device
        if len(data) != (1 if device.od.values.get(OVERFLOW) else 0):
            device.emcy.raise_error(SYNC_LENGTH, COMMUNICATION)
            return
        device.emcy.cure(SYNC_LENGTH)
        self.last_us = device.now_us
        number = data[0] if data else 0
        if device.application is not None:
            device.application.on_sync(device.now_us, number)
        if device.nmt.state == codes.OPERATIONAL:
            device.rpdos.on_sync()
            device.tpdos.on_sync(number)

    def in_window(self) -> bool:
        """Return True while synchronous RPDOs are valid: for 1007h microseconds after a SYNC, always if 1007h is 0."""
        window_us = self._device.od.integer(communication.SYNC_WINDOW)
        return not window_us or self._device.now_us - self.last_us <= window_us

    def _write_cob_id(self, _sub: int, value: "Value") -> int:
        can_id = int(value) & codes.STANDARD_MASK
        if int(value) & codes.COB_ID_RESERVED or codes.restricted(can_id):
            # Bit 30 would make this node the producer, bit 29 requests a 29-bit identifier: neither is offered. Bit 31
            # has no meaning here.
            return codes.INVALID_VALUE
        self.cob_id = can_id
        self._device.routes_changed()
        return 0

    def _write_overflow(self, _sub: int, value: "Value") -> int:
        return codes.INVALID_VALUE if value == 1 else 0
