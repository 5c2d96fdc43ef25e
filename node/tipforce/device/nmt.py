"""NMT slave (CiA 301, 7.2.8): the state machine and the master's commands."""

from . import codes, communication

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device
    from .object_dictionary import Value

_STATE_AFTER = {
    codes.NMT_START: codes.OPERATIONAL,
    codes.NMT_STOP: codes.STOPPED,
    codes.NMT_ENTER_PRE_OPERATIONAL: codes.PRE_OPERATIONAL,
}
SELF_START_OFF = 4  # 1F80h bit 2 (CiA 302-2)


class Nmt:
    """Hold ``state``; the services of the device depend on it."""

    __slots__ = ("_device", "state")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.state = codes.INITIALISING
        device.od.writers[communication.NMT_STARTUP] = self._write_startup

    def boot(self) -> None:
        """Send the boot-up message and leave INITIALISING (7.2.8.3.3) as 1F80h specifies."""
        self._device.send(codes.HEARTBEAT_BASE + self._device.node_id, b"\0")
        self.enter(codes.PRE_OPERATIONAL)
        od = self._device.od
        startup = communication.NMT_STARTUP
        if od.indices(startup, startup) and not od.integer(startup) & SELF_START_OFF:
            self.enter(codes.OPERATIONAL)

    def receive(self, data: bytes) -> None:
        """Process an NMT command frame; ignore one for another node or of wrong length."""
        if len(data) != 2 or data[1] not in (0, self._device.node_id):
            return
        command = data[0]
        if command in _STATE_AFTER:
            self.enter(_STATE_AFTER[command])
        elif command == codes.NMT_RESET_NODE:
            self._device.reset(True)
        elif command == codes.NMT_RESET_COMMUNICATION:
            self._device.reset(False)

    def enter(self, state: int) -> None:
        """Change the state and notify the services that depend on it."""
        if state != self.state:
            self.state = state
            self._device.state_changed()

    def _write_startup(self, _sub: int, value: "Value") -> int:
        # Only bit 2 applies to a slave; bit 0 would make this device the NMT master, which it does not support.
        return 0 if value in (0, SELF_START_OFF) else codes.INVALID_VALUE
