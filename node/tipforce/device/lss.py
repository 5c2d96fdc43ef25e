"""LSS slave (CiA 305): node-id and bit rate set over the bus, and the services by which a master finds devices."""

import struct

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device

REQUEST_ID, ANSWER_ID = 0x7E5, 0x7E4
UNCONFIGURED = 255
GROUP = "lss"  # what ``save`` and ``load`` call the stored node-id and bit rate
BIT_RATES = {0: 1000000, 1: 800000, 2: 500000, 3: 250000, 4: 125000, 6: 50000, 7: 20000, 8: 10000}  # table 0
DEFAULT_BIT_RATE_INDEX = 0
_STORED = "<BB"

_SWITCH_GLOBAL, _NODE_ID, _BIT_TIMING, _ACTIVATE, _STORE = 0x04, 0x11, 0x13, 0x15, 0x17
_SELECT_FIRST, _SELECT_LAST, _SELECTED = 0x40, 0x43, 0x44
_IDENTIFY_FIRST, _IDENTIFY_LAST, _IDENTIFIED = 0x46, 0x4B, 0x4F
_IDENTIFY_UNCONFIGURED, _UNCONFIGURED_ANSWER, _FASTSCAN = 0x4C, 0x50, 0x51
_INQUIRE_FIRST, _INQUIRE_NODE_ID = 0x5A, 0x5E
_OK, _OUT_OF_RANGE, _STORE_UNSUPPORTED, _STORE_FAILED = 0, 1, 1, 2
_START_FASTSCAN = 0x80


class LssSlave:
    """State of LSS: waiting or configuration; ``pending_node_id`` becomes the node-id at the next reset."""

    __slots__ = (
        "_bit_rate_index", "_configuring", "_device", "_identified", "_matched", "_position", "pending_node_id",
    )  # fmt: skip

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.pending_node_id = device.node_id
        self._bit_rate_index = DEFAULT_BIT_RATE_INDEX
        self._configuring = False
        self._matched = 0
        self._identified = 0
        self._position = 0

    @property
    def bit_rate(self) -> int:
        """Bits a second as configured: 1 Mbit/s until a loop that knows better, a stored one or a master says so."""
        return BIT_RATES[self._bit_rate_index]

    @bit_rate.setter
    def bit_rate(self, value: int) -> None:
        for index, bit_rate in BIT_RATES.items():
            if bit_rate == value:
                self._bit_rate_index = index

    def restore(self, blob: "bytes | None") -> None:
        """Take the stored node-id and bit rate, if there are any."""
        if blob is not None and len(blob) == struct.calcsize(_STORED):
            node_id, index = struct.unpack(_STORED, blob)
            if _valid_node_id(node_id) and index in BIT_RATES:
                self.pending_node_id, self._bit_rate_index = node_id, index

    def leave(self) -> None:
        """A reset: back to the waiting state."""
        self._configuring = False

    def receive(self, data: bytes) -> None:
        """Act on a request of the master; it always has 8 bytes."""
        if len(data) != 8:
            return
        service = data[0]
        number: int = struct.unpack("<I", data[1:5])[0]
        if service == _SWITCH_GLOBAL:
            self._switch(data[1])
        elif _SELECT_FIRST <= service <= _SELECT_LAST:
            self._select(service - _SELECT_FIRST, number)
        elif _IDENTIFY_FIRST <= service <= _IDENTIFY_LAST:
            self._identify(service - _IDENTIFY_FIRST, number)
        elif service == _IDENTIFY_UNCONFIGURED:
            if self._device.node_id == UNCONFIGURED:
                self._answer(_UNCONFIGURED_ANSWER)
        elif service == _FASTSCAN:
            self._fastscan(number, data[5], data[6], data[7])
        elif self._configuring:
            self._configure(service, data)

    # --- switch state (CiA 305, 6.3) ------------------------------------------------------------------------

    def _switch(self, mode: int) -> None:
        if mode == 1:
            self._configuring = True
        elif mode == 0:
            leaving, self._configuring = self._configuring, False
            if leaving and self._device.node_id == UNCONFIGURED != self.pending_node_id:
                # An unconfigured device that was given a node-id boots as soon as it leaves configuration (6.3.2).
                self._device.reset(False)

    def _select(self, part: int, number: int) -> None:
        """Switch state selective: four numbers in a row must be those of 1018h."""
        self._matched = self._matched + 1 if self._matched == part and number == self._identity(part) else 0
        if part == 0 and self._matched == 0 and number == self._identity(0):
            self._matched = 1
        if self._matched == 4:
            self._matched = 0
            self._configuring = True
            self._answer(_SELECTED)

    # --- configure and inquire (6.4, 6.5) -------------------------------------------------------------------

    def _configure(self, service: int, data: bytes) -> None:
        if service == _NODE_ID:
            error = _OK if _valid_node_id(data[1]) else _OUT_OF_RANGE
            if not error:
                self.pending_node_id = data[1]
            self._answer(service, error)
        elif service == _BIT_TIMING:
            error = _OK if data[1] == 0 and data[2] in BIT_RATES else _OUT_OF_RANGE
            if not error:
                self._bit_rate_index = data[2]
            self._answer(service, error)
        elif service == _ACTIVATE:
            delay_ms = data[1] | data[2] << 8
            self._device.requests.append(("bit-rate", BIT_RATES[self._bit_rate_index], delay_ms))
        elif service == _STORE:
            self._answer(service, self._store())
        elif _INQUIRE_FIRST <= service < _INQUIRE_NODE_ID:
            self._answer_number(service, self._identity(service - _INQUIRE_FIRST))
        elif service == _INQUIRE_NODE_ID:
            self._answer(service, self._device.node_id)

    def _store(self) -> int:
        content = struct.pack(_STORED, self.pending_node_id, self._bit_rate_index)
        if not self._device.storage.available:
            return _STORE_UNSUPPORTED
        return _OK if self._device.storage.save_blob(GROUP, content) else _STORE_FAILED

    # --- identify (6.6) -------------------------------------------------------------------------------------

    def _identify(self, part: int, number: int) -> None:
        """Vendor, product, revision low, high, serial low, high, in this order, each a condition."""
        own = self._identity((0, 1, 2, 2, 3, 3)[part])
        holds = number == own if part < 2 else number <= own if part % 2 == 0 else own <= number
        if part == 0:
            self._identified = 0
        self._identified = self._identified + 1 if holds and self._identified == part else 0
        if self._identified == 6:
            self._identified = 0
            self._answer(_IDENTIFIED)

    def _fastscan(self, number: int, bits_left: int, part: int, following: int) -> None:
        """Fastscan (6.6.4): the master guesses 1018h bit by bit; an unconfigured device says yes."""
        if self._device.node_id != UNCONFIGURED or self._configuring:
            return
        if bits_left == _START_FASTSCAN:
            self._position = 0
            self._answer(_IDENTIFIED)
            return
        if bits_left > 31 or part > 3 or following > 3 or part != self._position:
            return
        if self._identity(part) >> bits_left != number >> bits_left:
            return
        self._position = following
        if bits_left == 0 and following < part:
            self._configuring = True
        self._answer(_IDENTIFIED)

    def _identity(self, part: int) -> int:
        return int(self._device.od.get(0x1018, part + 1))

    def _answer(self, service: int, value: int = 0) -> None:
        self._device.send(ANSWER_ID, bytes((service, value, 0, 0, 0, 0, 0, 0)))

    def _answer_number(self, service: int, number: int) -> None:
        self._device.send(ANSWER_ID, struct.pack("<BIxxx", service, number))


def _valid_node_id(node_id: int) -> bool:
    return 1 <= node_id <= 127 or node_id == UNCONFIGURED
