"""LSS slave (CiA 305): set node-id and bit rate over the bus; let a master find devices."""

import struct

from . import codes, communication
from .storage import LSS_GROUP

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device

BIT_RATES = {0: 1000000, 1: 800000, 2: 500000, 3: 250000, 4: 125000, 6: 50000, 7: 20000, 8: 10000}  # table 0
DEFAULT_BIT_RATE_INDEX = 0
_STORED = "<BB"

_OK, _OUT_OF_RANGE, _STORE_UNSUPPORTED, _STORE_FAILED = 0, 1, 1, 2


class LssSlave:
    """LSS state, waiting or configuration; ``pending_node_id`` becomes the node-id at the next reset."""

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.pending_node_id = device.node_id
        self._bit_rate_index = DEFAULT_BIT_RATE_INDEX
        self._configuring = False
        self._matched = self._identified = self._position = 0

    @property
    def bit_rate(self) -> int:
        """Configured bit rate in bit/s: 1 Mbit/s until the loop, the store or a master sets another one."""
        return BIT_RATES[self._bit_rate_index]

    @bit_rate.setter
    def bit_rate(self, value: int) -> None:
        self._bit_rate_index = {rate: index for index, rate in BIT_RATES.items()}.get(value, self._bit_rate_index)

    def restore(self, blob: "bytes | None") -> None:
        """Apply the stored node-id and bit rate, if any."""
        if blob is not None and len(blob) == struct.calcsize(_STORED):
            node_id, index = struct.unpack(_STORED, blob)
            if _valid_node_id(node_id) and index in BIT_RATES:
                self.pending_node_id, self._bit_rate_index = node_id, index

    def leave(self) -> None:
        """Return to the waiting state after a reset."""
        self._configuring = False

    def receive(self, data: bytes) -> None:
        """Process a request of the master; it always has 8 bytes."""
        if len(data) != 8:
            return
        service = data[0]
        number: int = struct.unpack("<I", data[1:5])[0]
        if service == codes.LSS_SWITCH_GLOBAL:
            self._switch(data[1])
        elif codes.LSS_SELECT_FIRST <= service <= codes.LSS_SELECT_LAST:
            self._select(service - codes.LSS_SELECT_FIRST, number)
        elif codes.LSS_IDENTIFY_FIRST <= service <= codes.LSS_IDENTIFY_LAST:
            self._identify(service - codes.LSS_IDENTIFY_FIRST, number)
        elif service == codes.LSS_IDENTIFY_UNCONFIGURED:
            if self._device.node_id == codes.LSS_UNCONFIGURED:
                self._answer(codes.LSS_UNCONFIGURED_RESPONSE)
        elif service == codes.LSS_FASTSCAN:
            self._fastscan(number, data[5], data[6], data[7])
        elif self._configuring:
            self._configure(service, data)

    def _switch(self, mode: int) -> None:
        if mode == 1:
            self._configuring = True
        elif mode == 0:
            leaving, self._configuring = self._configuring, False
            if leaving and self._device.node_id == codes.LSS_UNCONFIGURED != self.pending_node_id:
                # An unconfigured device that received a node-id boots when it leaves the configuration state (6.3.2).
                self._device.reset(False)

    def _select(self, part: int, number: int) -> None:
        """Switch state selective: four consecutive numbers must match those of 1018h."""
        self._matched = part + 1 if number == self._identity(part) and part in (0, self._matched) else 0
        if self._matched == 4:
            self._matched = 0
            self._configuring = True
            self._answer(codes.LSS_SELECTED)

    def _configure(self, service: int, data: bytes) -> None:
        if service == codes.LSS_NODE_ID:
            valid = _valid_node_id(data[1])
            self.pending_node_id = data[1] if valid else self.pending_node_id
            self._answer(service, _OK if valid else _OUT_OF_RANGE)
        elif service == codes.LSS_BIT_TIMING:
            valid = data[1] == 0 and data[2] in BIT_RATES
            self._bit_rate_index = data[2] if valid else self._bit_rate_index
            self._answer(service, _OK if valid else _OUT_OF_RANGE)
        elif service == codes.LSS_ACTIVATE:
            delay_ms = data[1] | data[2] << 8
            self._device.requests.append(("bit-rate", BIT_RATES[self._bit_rate_index], delay_ms))
        elif service == codes.LSS_STORE:
            content = struct.pack(_STORED, self.pending_node_id, self._bit_rate_index)
            error = _STORE_FAILED if self._device.storage.available else _STORE_UNSUPPORTED
            self._answer(service, error if self._device.storage.save_blob(LSS_GROUP, content) else _OK)
        elif codes.LSS_INQUIRE_FIRST <= service < codes.LSS_INQUIRE_NODE_ID:
            self._answer(service, self._identity(service - codes.LSS_INQUIRE_FIRST))
        elif service == codes.LSS_INQUIRE_NODE_ID:
            self._answer(service, self._device.node_id)

    def _identify(self, part: int, number: int) -> None:
        """Check vendor, product, revision low and high, serial low and high in this order; each is a condition."""
        own = self._identity((0, 1, 2, 2, 3, 3)[part])
        holds = number == own if part < 2 else number <= own if part % 2 == 0 else own <= number
        self._identified = part + 1 if holds and part in (0, self._identified) else 0
        if self._identified == 6:
            self._identified = 0
            self._answer(codes.LSS_IDENTIFIED)

    def _fastscan(self, number: int, bits_left: int, part: int, following: int) -> None:
        """Fastscan (6.6.4): the master searches 1018h bit by bit; an unconfigured device confirms a match."""
        if self._device.node_id != codes.LSS_UNCONFIGURED or self._configuring:
            return
        if bits_left == codes.LSS_START_FASTSCAN:
            self._position = 0
            self._answer(codes.LSS_IDENTIFIED)
            return
        if bits_left > 31 or part > 3 or following > 3 or part != self._position:
            return
        if self._identity(part) >> bits_left != number >> bits_left:
            return
        self._position = following
        if bits_left == 0 and following < part:
            self._configuring = True
        self._answer(codes.LSS_IDENTIFIED)

    def _identity(self, part: int) -> int:
        od, sub = self._device.od, part + 1
        if isinstance(od.find(communication.IDENTITY, sub), int):
            return 0  # all but the vendor are optional
        return int(od.get(communication.IDENTITY, sub))

    def _answer(self, service: int, value: int = 0) -> None:
        self._device.send(codes.LSS_RESPONSE_COB_ID, struct.pack("<BIxxx", service, value))


def _valid_node_id(node_id: int) -> bool:
    return 1 <= node_id <= 127 or node_id == codes.LSS_UNCONFIGURED
