"""Receive PDOs (CiA 301, 7.2.2): applied at once, or on the next SYNC for synchronous types."""

from . import codes, communication
from .emcy import COMMUNICATION, PDO_LENGTH, RPDO_TIMEOUT
from .object_dictionary import RPDO, SIZES
from .pdo import Pdo

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device


class ReceivePdo(Pdo):
    """One RPDO; ``waiting`` holds the data of a synchronous one until the SYNC, ``deadline_us`` is the next one's."""

    __slots__ = ("deadline_us", "waiting")

    def load(self) -> None:
        """Compile the parameters and discard data that waits for a SYNC."""
        Pdo.load(self)
        self.forget()

    def forget(self) -> None:
        """Discard data that waits for a SYNC, so that a later start does not apply it; stop monitoring the deadline."""
        self.waiting = b""
        self.deadline_us = codes.NEVER_US


class ReceivePdos:
    """All RPDOs of a device. ``due_us`` is when one is overdue (event timer, 7.5.2.35)."""

    __slots__ = ("_device", "_pdos", "due_us")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.due_us = codes.NEVER_US
        self._pdos = [
            ReceivePdo(device.od, index, index + communication.MAPPING, RPDO, self._changed)
            for index in device.od.indices(communication.RPDO, communication.LAST_RPDO)
        ]

    def reset(self) -> None:
        """Apply the present parameter objects after a boot-up."""
        for pdo in self._pdos:
            pdo.load()
        self._schedule()

    def _changed(self) -> None:
        """Clear the error of a PDO that has another identifier or is no longer valid."""
        for code in (PDO_LENGTH, RPDO_TIMEOUT):
            self._device.emcy.cure_all_but(code, self.can_ids())
        self._schedule()
        self._device.routes_changed()

    def can_ids(self) -> "list[int]":
        """Return the identifiers of the RPDOs that this device receives."""
        return [pdo.can_id for pdo in self._pdos if pdo.active]

    def receive(self, can_id: int, data: bytes) -> None:
        """Process the frame of an RPDO. A frame shorter than the mapping changes nothing (7.2.2.5.1)."""
        for pdo in self._pdos:
            if pdo.active and pdo.can_id == can_id:
                if len(data) < pdo.length:
                    self._device.emcy.raise_error(PDO_LENGTH, COMMUNICATION, can_id)
                else:
                    self._device.emcy.cure(PDO_LENGTH, can_id)
                    self._accept(pdo, data)
        self._schedule()

    def _accept(self, pdo: ReceivePdo, data: bytes) -> None:
        event_ms = pdo.parameter(5)
        pdo.deadline_us = self._device.now_us + 1000 * event_ms if event_ms else codes.NEVER_US
        self._device.emcy.cure(RPDO_TIMEOUT, pdo.can_id)
        if pdo.transmission > codes.LAST_SYNCHRONOUS:
            self._apply(pdo, data)
        elif self._device.sync.in_window():
            pdo.waiting = bytes(data)

    def expire(self, now_us: int) -> None:
        """Report each RPDO that is overdue."""
        for pdo in self._pdos:
            if pdo.deadline_us <= now_us:
                pdo.deadline_us = codes.NEVER_US
                self._device.emcy.raise_error(RPDO_TIMEOUT, COMMUNICATION, pdo.can_id)
        self._schedule()

    def on_sync(self) -> None:
        """Apply the data that synchronous RPDOs received since the last SYNC."""
        for pdo in self._pdos:
            if pdo.waiting:
                data, pdo.waiting = pdo.waiting, b""
                self._apply(pdo, data)

    def forget(self) -> None:
        """Stop all RPDOs when the device leaves OPERATIONAL."""
        for pdo in self._pdos:
            pdo.forget()
        self._schedule()

    def _schedule(self) -> None:
        self.due_us = min([pdo.deadline_us for pdo in self._pdos], default=codes.NEVER_US)

    def _apply(self, pdo: ReceivePdo, data: bytes) -> None:
        if pdo.widths is not None:
            from .bit_packing import unpack  # a device without mapped bits does without

            for (index, sub), part in zip(pdo.keys, unpack(pdo.widths, data)):  # noqa: B905
                if index > 0x1F:
                    self._device.od.download(index, sub, part)
            return
        offset = 0
        for letter, (index, sub) in zip(pdo.letters, pdo.keys):  # noqa: B905
            size = SIZES[letter]
            if index > 0x1F:  # below are the dummy types, placeholders without a value
                self._device.od.download(index, sub, data[offset : offset + size])
            offset += size
