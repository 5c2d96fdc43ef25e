"""What the CAN drivers share: the queue of frames to send, and the controller's state as SocketCAN error frames.

Frames are (can_id, data) with the flags of SocketCAN in can_id, as the device core takes them.
"""

from tipforce.device import codes
from tipforce.device.bus_faults import ACTIVE, BUS_OFF, CONTROLLER, TRANSMIT_OVERFLOW, WARNING

TYPE_CHECKING = False
if TYPE_CHECKING:
    Frame = tuple[int, bytes]

STATE_ACTIVE, STATE_WARNING, STATE_PASSIVE, STATE_OFF = 0, 1, 2, 3
QUEUE = 160  # frames: a block of an SDO block upload has 127
RECEIVE_AT_ONCE = 32  # frames handed over in one call: the node's own work must not starve

_RECEIVE_OVERFLOW = codes.ERROR_FLAG | CONTROLLER, b"\0\x01\0\0\0\0\0\0"
_SHOWN = {STATE_ACTIVE: ACTIVE, STATE_WARNING: WARNING, STATE_PASSIVE: 0x30}


class CanPort:
    """One controller. A driver has ``_start``, ``_next``, ``_put``, ``_state``, ``_restart`` of its own.

    Nothing here waits: ``send`` queues, ``receive`` also hands queued frames to the controller.
    """

    def __init__(self, bit_rate: int) -> None:
        self._queue: "list[Frame]" = []
        self._news: "list[Frame]" = []
        self._known = STATE_ACTIVE
        self.bit_rate = bit_rate
        self._start(bit_rate)

    # --- of the driver --------------------------------------------------------------------------------------

    def _start(self, bit_rate: int) -> None:
        """Bring the controller onto the bus with this bit rate, all standard identifiers received."""
        raise NotImplementedError

    def _next(self) -> "Frame | None":
        """The next frame received, None without one."""
        raise NotImplementedError

    def _put(self, can_id: int, data: bytes) -> bool:
        """Give a frame to the controller; False while it has no room. The order of one identifier is kept."""
        raise NotImplementedError

    def _state(self) -> int:
        """One of STATE_..."""
        raise NotImplementedError

    def _restart(self) -> None:
        """Leave the bus-off state; what waits in the controller is dropped."""
        raise NotImplementedError

    # --- of the node ----------------------------------------------------------------------------------------

    def receive(self) -> "list[Frame]":
        """What came since the last call, error frames for changes of the controller's state first."""
        self._watch()
        found, self._news = self._news, []
        while len(found) < RECEIVE_AT_ONCE:
            frame = self._next()
            if frame is None:
                break
            found.append(frame)
        if self._news:  # an overrun shows while frames are fetched
            found += self._news
            self._news = []
        self.flush()
        return found

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame. One that finds the queue full is dropped, and the device is told (EMCY 8110h)."""
        if self._known == STATE_OFF:
            return  # it would be stale when the bus is back
        if len(self._queue) >= QUEUE:
            self._news = [TRANSMIT_OVERFLOW]
            return
        self._queue.append((can_id, data))
        self.flush()

    def flush(self) -> None:
        """Give the controller what it has room for."""
        while self._queue and self._put(*self._queue[0]):
            self._queue.pop(0)

    def busy(self) -> bool:
        """Frames wait to be sent: the loop must come back soon."""
        return bool(self._queue)

    def restart(self) -> None:
        """The device's request "bus-restart"."""
        self._queue = []
        self._restart()

    def set_bit_rate(self, bit_rate: int) -> None:
        """Another bit rate, at once."""
        self._queue = []
        self.bit_rate = bit_rate
        self._start(bit_rate)

    def overrun(self) -> None:
        """Drivers call this when the controller says that frames were lost."""
        self._news.append(_RECEIVE_OVERFLOW)

    def _watch(self) -> None:
        state = self._state()
        if state == self._known:
            return
        self._known = state
        if state == STATE_OFF:
            self._queue = []
            self._news.append((codes.ERROR_FLAG | BUS_OFF, bytes(8)))
        else:
            self._news.append((codes.ERROR_FLAG | CONTROLLER, bytes((0, _SHOWN[state], 0, 0, 0, 0, 0, 0))))
