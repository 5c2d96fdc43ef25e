"""Heartbeat producer (CiA 301, 7.2.8.3.2.2), object 1017h."""

from . import codes, communication

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device
    from .object_dictionary import Value


class HeartbeatProducer:
    """Send the NMT state every 1017h milliseconds; the boot-up message counts as the first heartbeat."""

    __slots__ = ("_device", "due_us")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.due_us = codes.NEVER_US
        device.od.writers[communication.PRODUCER_HEARTBEAT] = self._write_period

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

    def _write_period(self, _sub: int, value: "Value") -> int:
        self._restart(value)  # type: ignore[arg-type]
        return 0

    def _restart(self, period_ms: int) -> None:
        self.due_us = self._device.now_us + 1000 * period_ms if period_ms else codes.NEVER_US
