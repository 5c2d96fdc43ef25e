"""Receive PDOs (CiA 301, 7.2.2): taken at once, or on the next SYNC for synchronous types."""

from .object_dictionary import RPDO, SIZES
from .pdo import Pdo

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device

_SYNCHRONOUS = 240


class ReceivePdo(Pdo):
    """One RPDO; ``waiting`` holds the data of a synchronous one until the SYNC."""

    __slots__ = ("waiting",)

    def load(self) -> None:
        """Compile the parameters and forget what was waiting."""
        Pdo.load(self)
        self.waiting = b""


class ReceivePdos:
    """All RPDOs of a device."""

    __slots__ = ("_device", "_pdos")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self._pdos = [
            ReceivePdo(device.od, index, index + 0x200, RPDO, device.routes_changed)
            for index in device.od.indices(0x1400, 0x15FF)
        ]

    def reset(self) -> None:
        """Take the parameter objects as they stand, after a boot-up."""
        for pdo in self._pdos:
            pdo.load()

    def can_ids(self) -> "list[int]":
        """The identifiers that this device listens to for RPDOs."""
        return [pdo.can_id for pdo in self._pdos if pdo.active]

    def receive(self, can_id: int, data: bytes) -> None:
        """Take the frame of an RPDO. One that is shorter than its mapping changes nothing (7.2.2.5.1)."""
        for pdo in self._pdos:
            if pdo.active and pdo.can_id == can_id and len(data) >= pdo.length:
                if pdo.transmission <= _SYNCHRONOUS:
                    pdo.waiting = bytes(data)
                else:
                    self._apply(pdo, data)

    def on_sync(self) -> None:
        """Apply what synchronous RPDOs brought since the last SYNC."""
        for pdo in self._pdos:
            if pdo.waiting:
                data, pdo.waiting = pdo.waiting, b""
                self._apply(pdo, data)

    def forget(self) -> None:
        """The device is not operational any more: what waited for a SYNC is not to act at some later start."""
        for pdo in self._pdos:
            pdo.waiting = b""

    def _apply(self, pdo: ReceivePdo, data: bytes) -> None:
        offset = 0
        for letter, (index, sub) in zip(pdo.packing[1:], pdo.keys):  # noqa: B905
            size = SIZES[letter]
            if index > 0x1F:  # below are the dummy types, placeholders without a value
                self._device.od.download(index, sub, data[offset : offset + size])
            offset += size
