"""SYNC and TIME consumers (CiA 301, 7.2.5, 7.2.6): objects 1005h, 1007h, 1012h, 1013h, 1019h."""

import struct

from . import codes, communication
from .emcy import COMMUNICATION, SYNC_LENGTH

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device
    from .object_dictionary import Value

OVERFLOW = communication.SYNC_OVERFLOW << 8  # the key of 1019h in ``od.values``


class SyncConsumer:
    """SYNC consumer: the application latches one sample, then the synchronous PDOs are sent."""

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.cob_id = codes.SYNC_COB_ID
        self.last_us = 0
        self._wrong = False  # the last frame had a wrong length
        device.od.writers[communication.COB_ID_SYNC] = self._write_cob_id
        device.od.writers[communication.SYNC_OVERFLOW] = lambda _sub, value: codes.INVALID_VALUE if value == 1 else 0

    def reset(self) -> None:
        """Apply the present value of 1005h."""
        self.cob_id = self._device.od.integer(communication.COB_ID_SYNC) & codes.STANDARD_MASK or codes.SYNC_COB_ID

    def receive(self, data: bytes) -> None:
        """Process a SYNC frame: no data, or one counter byte if 1019h is set; other lengths are an error."""
        device = self._device
        if len(data) != (1 if device.od.values.get(OVERFLOW) else 0):
            self._wrong = True
            device.emcy.raise_error(SYNC_LENGTH, COMMUNICATION)
            return
        if self._wrong:
            self._wrong = False
            device.emcy.cure(SYNC_LENGTH)
        self.last_us = device.now_us
        number = data[0] if data else 0
        if device.application is not None:
            device.application.on_sync(device.now_us, number)
        if device.nmt.state == codes.OPERATIONAL:
            if device.rpdos.is_waiting:
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


_EPOCH_DAYS = 5113  # from 1970-01-01, where Unix time starts, to 1984-01-01, where TIME_OF_DAY does
_DAY_MS = 86400000


class TimeConsumer:
    """Network time, known after the first TIME message; between messages it follows the device's clock."""

    def __init__(self, device: "Device") -> None:
        self._device = device
        self._unix_ms, self._received_us = -1, 0
        self._high_us = 0  # offset of 1013h from the device's clock
        od = device.od
        od.writers[communication.COB_ID_TIME] = self._write_cob_id
        od.writers[communication.HIGH_RESOLUTION_TIME] = self._write_high_resolution
        od.readers[communication.HIGH_RESOLUTION_TIME] = lambda _sub: (device.now_us + self._high_us) & 0xFFFFFFFF

    @property
    def can_id(self) -> "int | None":
        """Return the identifier to receive, None if the device does not consume TIME."""
        cob_id = self._device.od.integer(communication.COB_ID_TIME)
        return cob_id & codes.STANDARD_MASK if cob_id & codes.TIME_CONSUMER else None

    def unix_ms(self) -> "int | None":
        """Return network time in milliseconds since 1970, None before the first TIME message."""
        if self._unix_ms < 0:
            return None
        return self._unix_ms + (self._device.now_us - self._received_us) // 1000

    def receive(self, data: bytes) -> None:
        """Process TIME_OF_DAY: milliseconds after midnight in 28 bits, days since 1984-01-01 (7.1.6.5)."""
        if len(data) != 6:
            return
        ms, days = struct.unpack("<IH", data)
        ms &= 0x0FFFFFFF
        if ms < _DAY_MS:
            self._unix_ms = (days + _EPOCH_DAYS) * _DAY_MS + ms
            self._received_us = self._device.now_us

    def _write_cob_id(self, _sub: int, value: "Value") -> int:
        cob_id = int(value)
        if cob_id & codes.COB_ID_RESERVED or codes.restricted(cob_id & codes.STANDARD_MASK):
            return codes.INVALID_VALUE  # bit 30: this device produces no TIME; 29-bit identifiers are unsupported
        self._device.od.values[communication.COB_ID_TIME << 8] = cob_id
        self._device.routes_changed()
        return 0

    def _write_high_resolution(self, _sub: int, value: "Value") -> int:
        self._high_us = int(value) - self._device.now_us
        return 0
