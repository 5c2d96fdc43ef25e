"""Error control (CiA 301, 7.2.8.3.2): heartbeat 1017h, its consumer 1016h, node and life guarding 100Ch, 100Dh."""

from . import codes, communication
from .emcy import COMMUNICATION, HEARTBEAT_LOST
from .timed import Timed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device
    from .object_dictionary import Value

MASTER = 0  # detail of the EMCY: the lost node is the one that guards


class NodeGuarding(Timed):
    """Respond to the master's remote frames with state and toggle bit; report when they stop."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self.reset()

    def reset(self) -> None:
        """Restart after a boot-up: toggle bit 0, no life guarding before the first remote frame."""
        self._toggle = 0
        self.due_us = codes.NEVER_US

    def receive(self, _data: bytes) -> None:
        """Respond to a remote frame on 0x700 + node-id."""
        if self._device.od.integer(communication.PRODUCER_HEARTBEAT):
            return  # a device that sends heartbeats does not support guarding (7.2.8.3.2.2)
        self._device.send(codes.HEARTBEAT_BASE + self._device.node_id, bytes((self._toggle | self._device.nmt.state,)))
        self._toggle ^= 0x80
        life_us = self._life_us()
        self.due_us = self._device.now_us + life_us if life_us else codes.NEVER_US
        self._device.emcy.cure(HEARTBEAT_LOST, MASTER)

    def expire(self, _now_us: int) -> None:
        """Report a life time that elapsed without a remote frame, unless guarding was disabled since the last one."""
        self.due_us = codes.NEVER_US
        if self._life_us() and not self._device.od.integer(communication.PRODUCER_HEARTBEAT):
            self._device.emcy.raise_error(HEARTBEAT_LOST, COMMUNICATION, MASTER)
            self._device.communication_failed()

    def _life_us(self) -> int:
        od = self._device.od
        return 1000 * od.integer(communication.GUARD_TIME) * od.integer(communication.LIFE_TIME_FACTOR)


class HeartbeatProducer(Timed):
    """Send the NMT state every 1017h milliseconds; the boot-up message counts as the first heartbeat."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        device.od.writers[communication.PRODUCER_HEARTBEAT] = lambda _sub, value: self._restart(int(value))

    def reset(self) -> None:
        """Restart with the present value of 1017h after a boot-up."""
        self._restart(self._device.od.integer(communication.PRODUCER_HEARTBEAT))

    def expire(self, now_us: int) -> None:
        """Send one heartbeat; late calls do not shift the following ones."""
        period_us = 1000 * self._device.od.integer(communication.PRODUCER_HEARTBEAT)
        self._device.send(codes.HEARTBEAT_BASE + self._device.node_id, bytes((self._device.nmt.state,)))
        self.due_us += period_us
        if self.due_us <= now_us:
            # The process was suspended for one or more periods: continue from now, without a burst.
            self.due_us = now_us + period_us

    def _restart(self, period_ms: int) -> int:
        self.due_us = self._device.now_us + 1000 * period_ms if period_ms else codes.NEVER_US
        return 0


class HeartbeatConsumer(Timed):
    """Monitor up to four nodes, each from its first heartbeat on."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self._periods: "dict[int, int]" = {}  # node-id -> microseconds
        self._deadlines: "dict[int, int]" = {}  # node-id -> time at which its heartbeat is overdue
        self._lost: "list[int]" = []
        device.od.writers[communication.CONSUMER_HEARTBEAT] = self._write

    def reset(self) -> None:
        """Apply the present value of 1016h; monitoring of a node starts with its first heartbeat."""
        self._periods = {n: 1000 * period_ms for _sub, n, period_ms in self._entries() if n and period_ms}
        self._deadlines = {n: due for n, due in self._deadlines.items() if n in self._periods}
        self._lost = [n for n in self._lost if n in self._periods]
        self._device.emcy.cure_all_but(HEARTBEAT_LOST, [MASTER] + self._lost)
        self._schedule()

    def forget(self) -> None:
        """Reset all monitoring."""
        self._deadlines, self._lost = {}, []
        self.reset()

    def routes(self) -> "list[tuple[int, Callable[[bytes], None]]]":
        """Return (can_id, handler) of each monitored heartbeat."""
        base = codes.HEARTBEAT_BASE
        return [(base + n, lambda data, n=n: self._receive(n, data)) for n in self._periods]  # type: ignore[misc]

    def expire(self, now_us: int) -> None:
        """Report each node whose heartbeat is overdue."""
        for node_id in sorted(self._deadlines):  # the same order everywhere: MicroPython's dicts are unordered
            if self._deadlines[node_id] <= now_us:
                del self._deadlines[node_id]
                self._lost.append(node_id)
                self._device.emcy.raise_error(HEARTBEAT_LOST, COMMUNICATION, node_id)
                self._device.communication_failed()
        self._schedule()

    def _receive(self, node_id: int, data: bytes) -> None:
        if len(data) != 1:
            return
        self._deadlines[node_id] = self._device.now_us + self._periods[node_id]
        if node_id in self._lost:
            self._lost.remove(node_id)
            self._device.emcy.cure(HEARTBEAT_LOST, node_id)
        self._schedule()

    def _schedule(self) -> None:
        self.due_us = min(self._deadlines.values()) if self._deadlines else codes.NEVER_US

    def _entries(self) -> "list[tuple[int, int, int]]":
        od, index = self._device.od, communication.CONSUMER_HEARTBEAT
        return [(sub,) + _split(od.integer(index, sub)) for sub in od.subs(index)[1:]]

    def _write(self, sub: int, value: "Value") -> int:
        od = self._device.od
        node_id, period_ms = _split(int(value))
        if int(value) >> 24 or node_id > 127:
            return codes.INVALID_VALUE
        others = [n for k, n, period in self._entries() if k != sub and period]
        if node_id and period_ms and node_id in others:
            return codes.INCOMPATIBLE  # two times for one node (7.5.2.19)
        od.values[communication.CONSUMER_HEARTBEAT << 8 | sub] = value
        self._deadlines.pop(node_id, None)
        self.reset()
        self._device.routes_changed()
        return 0


def _split(word: int) -> "tuple[int, int]":
    return word >> 16 & 0xFF, word & 0xFFFF
