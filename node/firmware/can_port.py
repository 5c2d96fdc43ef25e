"""Common part of the CAN drivers: transmit queue, and error frames of the controller's state; flags as in SocketCAN."""

from canopen_device.core import codes
from canopen_device.core.emcy import ACTIVE, BUS_OFF, CONTROLLER, TRANSMIT_OVERFLOW, WARNING

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    Frame = tuple[int, bytes]

STATE_ACTIVE, STATE_WARNING, STATE_PASSIVE, STATE_OFF = 0, 1, 2, 3
QUEUE = 160  # frames: a block of an SDO block upload has 127
RECEIVE_AT_ONCE = 32  # frames per call: leaves time for the node's other work
EXTENDED = (codes.EXTENDED_FLAG, b"")  # any frame of 29 bits: this node has no such identifiers

_RECEIVE_OVERFLOW = codes.ERROR_FLAG | CONTROLLER, b"\0\x01\0\0\0\0\0\0"
_SHOWN = {STATE_ACTIVE: ACTIVE, STATE_WARNING: WARNING, STATE_PASSIVE: 0x30}


class CanPort:
    """One controller. A driver implements ``_start``, ``_next``, ``_put``, and without a ``can`` of MicroPython the
    others. No method waits: ``send`` queues, ``receive`` also passes queued frames to the controller."""

    def __init__(self, bit_rate: int, can: "Any" = None, states: "tuple[int, ...]" = ()) -> None:
        """``states``: those of ``can`` that are STATE_WARNING, STATE_PASSIVE, STATE_OFF; any other is STATE_ACTIVE."""
        self._can, self._states = can, states
        self._queue: "list[Frame]" = []
        self._news: "list[Frame]" = []
        self._known = STATE_ACTIVE
        self.bit_rate = bit_rate
        self._start(bit_rate)

    def _start(self, bit_rate: int) -> None:
        raise NotImplementedError

    def _next(self) -> "Frame | None":
        raise NotImplementedError

    def _put(self, can_id: int, data: bytes) -> bool:
        """Pass a frame to the controller; return False if it is full. Frames of one identifier stay in order."""
        raise NotImplementedError

    def _state(self) -> int:
        state = self._can.state()
        return STATE_WARNING + self._states.index(state) if state in self._states else STATE_ACTIVE

    def receive(self) -> "list[Frame]":
        """Return the frames since the last call, with error frames for changes of the controller's state first."""
        state = self._state()
        if state != self._known:
            self._known = state
            if state == STATE_OFF:
                self._queue = []
                self._news.append((codes.ERROR_FLAG | BUS_OFF, bytes(8)))
            else:
                self._news.append((codes.ERROR_FLAG | CONTROLLER, bytes((0, _SHOWN[state], 0, 0, 0, 0, 0, 0))))
        found, self._news = self._news, []
        for _ in range(RECEIVE_AT_ONCE):
            frame = self._next()
            if frame is None:
                break
            if frame is not EXTENDED:
                found.append(frame)
        if self._news:  # an overrun is detected while frames are read
            found += self._news
            self._news = []
        self.flush()
        return found

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame. If the queue is full it is dropped and the device notified (EMCY 8110h)."""
        if self._known == STATE_OFF:
            return  # it would be stale when the bus recovers
        if len(self._queue) >= QUEUE:
            self._news = [TRANSMIT_OVERFLOW]
            return
        self._queue.append((can_id, data))
        self.flush()

    def flush(self) -> None:
        """Pass frames to the controller while it accepts them."""
        while self._queue and self._put(*self._queue[0]):
            self._queue.pop(0)

    def busy(self) -> bool:
        """Return True while frames wait in the queue: the loop must return soon."""
        return bool(self._queue)

    def restart(self) -> None:
        """Leave the bus-off state, the device's request "bus-restart"; frames that wait are dropped."""
        self._queue = []
        self._can.restart()

    def set_bit_rate(self, bit_rate: int) -> None:
        """Switch to another bit rate at once."""
        self._queue = []
        self.bit_rate = bit_rate
        self._start(bit_rate)

    def overrun(self) -> None:
        """Note that frames were lost; drivers call this when the controller reports it."""
        self._news.append(_RECEIVE_OVERFLOW)
