"""Node guarding and life guarding (CiA 301, 7.2.8.3.2.1): objects 100Ch and 100Dh; a heartbeat disables it."""

from . import codes, communication
from .emcy import COMMUNICATION, HEARTBEAT_LOST

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device

MASTER = 0  # detail of the EMCY: the lost node is the one that guards


class NodeGuarding:
    """Respond to the master's remote frames with state and toggle bit; report when they stop."""

    __slots__ = ("_device", "_toggle", "due_us")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self._toggle = 0
        self.due_us = codes.NEVER_US

    def reset(self) -> None:
        """Restart after a boot-up: toggle bit 0, no life guarding before the first remote frame."""
        self._toggle = 0
        self.due_us = codes.NEVER_US

    def receive(self, _data: bytes) -> None:
        """Respond to a remote frame on 0x700 + node-id."""
        od = self._device.od
        if od.integer(communication.PRODUCER_HEARTBEAT):
            return  # a device that sends heartbeats does not support guarding (7.2.8.3.2.2)
        self._device.send(codes.HEARTBEAT_BASE + self._device.node_id, bytes((self._toggle | self._device.nmt.state,)))
        self._toggle ^= 0x80
        life_ms = od.integer(communication.GUARD_TIME) * od.integer(communication.LIFE_TIME_FACTOR)
        self.due_us = self._device.now_us + 1000 * life_ms if life_ms else codes.NEVER_US
        self._device.emcy.cure(HEARTBEAT_LOST, MASTER)

    def expire(self, _now_us: int) -> None:
        """Report a life time that elapsed without a remote frame."""
        self.due_us = codes.NEVER_US
        od = self._device.od
        if od.integer(communication.PRODUCER_HEARTBEAT) or not od.integer(communication.GUARD_TIME) * od.integer(
            communication.LIFE_TIME_FACTOR
        ):
            return  # guarding was disabled since the last remote frame
        self._device.emcy.raise_error(HEARTBEAT_LOST, COMMUNICATION, MASTER)
        self._device.communication_failed()
