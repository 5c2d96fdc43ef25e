"""Heartbeat consumer (CiA 301, 7.2.8.3.2.2 and 7.5.2.19): object 1016h."""

from . import codes, communication
from .emcy import COMMUNICATION, HEARTBEAT_LOST
from .guarding import MASTER

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device
    from .object_dictionary import Value


class HeartbeatConsumer:
    """Monitor up to four nodes, each from its first heartbeat on."""

    __slots__ = ("_deadlines", "_device", "_lost", "_periods", "due_us")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self._periods: "dict[int, int]" = {}  # node-id -> microseconds
        self._deadlines: "dict[int, int]" = {}  # node-id -> time at which its heartbeat is overdue
        self._lost: "list[int]" = []
        self.due_us = codes.NEVER_US
        device.od.writers[communication.CONSUMER_HEARTBEAT] = self._write

    def reset(self) -> None:
        """Apply the present value of 1016h; monitoring of a node starts with its first heartbeat."""
        self._periods = {}
        for sub in self._device.od.subs(communication.CONSUMER_HEARTBEAT)[1:]:
            node_id, period_ms = _split(self._device.od.integer(communication.CONSUMER_HEARTBEAT, sub))
            if node_id and period_ms:
                self._periods[node_id] = 1000 * period_ms
        self._deadlines = {n: due for n, due in self._deadlines.items() if n in self._periods}
        self._lost = [n for n in self._lost if n in self._periods]
        self._device.emcy.cure_all_but(HEARTBEAT_LOST, [MASTER] + self._lost)
        self._schedule()

    def forget(self) -> None:
        """Reset all monitoring."""
        self._deadlines = {}
        self._lost = []
        self.reset()

    def routes(self) -> "list[tuple[int, Callable[[bytes], None]]]":
        """Return (can_id, handler) of each monitored heartbeat."""
        return [(codes.HEARTBEAT_BASE + node_id, self._route(node_id)) for node_id in self._periods]

    def expire(self, now_us: int) -> None:
        """Report each node whose heartbeat is overdue."""
        for node_id in sorted(self._deadlines):  # the same order everywhere: MicroPython's dicts are unordered
            if self._deadlines[node_id] <= now_us:
                del self._deadlines[node_id]
                self._lost.append(node_id)
                self._device.emcy.raise_error(HEARTBEAT_LOST, COMMUNICATION, node_id)
                self._device.communication_failed()
        self._schedule()

    def _route(self, node_id: int) -> "Callable[[bytes], None]":
        def receive(data: bytes) -> None:
            if len(data) != 1:
                return
            self._deadlines[node_id] = self._device.now_us + self._periods[node_id]
            if node_id in self._lost:
                self._lost.remove(node_id)
                self._device.emcy.cure(HEARTBEAT_LOST, node_id)
            self._schedule()

        return receive

    def _schedule(self) -> None:
        self.due_us = min(self._deadlines.values()) if self._deadlines else codes.NEVER_US

    def _write(self, sub: int, value: "Value") -> int:
        od = self._device.od
        node_id, period_ms = _split(int(value))
        if int(value) >> 24 or node_id > 127:
            return codes.INVALID_VALUE
        others = [
            _split(od.integer(communication.CONSUMER_HEARTBEAT, k))
            for k in od.subs(communication.CONSUMER_HEARTBEAT)[1:]
            if k != sub
        ]
        if node_id and period_ms and node_id in [n for n, period in others if period]:
            return codes.INCOMPATIBLE  # two times for one node (7.5.2.19)
        od.values[communication.CONSUMER_HEARTBEAT << 8 | sub] = value
        self._deadlines.pop(node_id, None)
        self.reset()
        self._device.routes_changed()
        return 0


def _split(word: int) -> "tuple[int, int]":
    """Return (node-id, milliseconds) of an entry of 1016h."""
    return word >> 16 & 0xFF, word & 0xFFFF
