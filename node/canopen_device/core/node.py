"""A CANopen device as a pure state machine (CiA 301): frames and time in, frames and the next due time out."""

from . import codes, communication
from .emcy import COB_ID_COLLISION, BusFaults, Emcy
from .error_control import HeartbeatConsumer, HeartbeatProducer, NodeGuarding
from .pdo import ReceivePdos, TransmitPdos
from .sdo_server import SdoServer
from .storage import COMMUNICATION, LSS_GROUP, Storage, WearBudget
from .sync import SyncConsumer, TimeConsumer

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from .lss import LssSlave
    from .object_dictionary import ObjectDictionary

    Frame = tuple[int, bytes]
    Request = tuple[str, int, int]

_STATE_AFTER = {
    codes.NMT_START: codes.OPERATIONAL, codes.NMT_STOP: codes.STOPPED,
    codes.NMT_ENTER_PRE_OPERATIONAL: codes.PRE_OPERATIONAL,
}  # fmt: skip
SELF_START_OFF = 4  # 1F80h bit 2 (CiA 302-2)


class Nmt:
    """Hold ``state``; the services of the device depend on it."""

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.state = codes.INITIALISING
        # Only bit 2 applies to a slave; bit 0 would make this device the NMT master, which it does not support.
        device.od.writers[communication.NMT_STARTUP] = lambda _sub, value: (
            0 if value in (0, SELF_START_OFF) else codes.INVALID_VALUE
        )

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
        elif command in (codes.NMT_RESET_NODE, codes.NMT_RESET_COMMUNICATION):
            self._device.reset(command == codes.NMT_RESET_NODE)

    def enter(self, state: int) -> None:
        """Change the state and notify the services that depend on it."""
        if state != self.state:
            self.state = state
            self._device.state_changed()


class Application:
    """Functions of a device beyond CANopen; every method may be overridden. ``live``: indices of values that change on
    their own: ``refresh`` is called before one is uploaded. ``expire`` is called at ``due_us``."""

    live: "frozenset[int]" = frozenset()
    due_us = codes.NEVER_US

    def on_reset(self, now_us: int) -> None:
        """Handle a reset: all parameters are restored; the boot-up message follows."""

    def on_settings(self) -> None:
        """Handle a change of a PDO parameter or of the NMT state."""

    def on_sync(self, now_us: int, number: int) -> None:
        """Handle a SYNC: latch the values that the PDOs carry. ``number``: its counter, 0 for a SYNC without one."""

    def refresh(self, now_us: int) -> None:
        """Update the live values before a read outside a SYNC (SDO upload, event-driven PDO)."""

    def expire(self, now_us: int) -> None:
        """Handle the time ``due_us``."""


class Device:
    """One CANopen node: call ``step`` with the received frames and the time, and send the frames that it returns.

    ``now_us`` never wraps; where it goes back, the device's own time stays ahead. The loop empties ``requests``, (name,
    value, ms): ("reset-node", 0, 0) and ("reset-communication", 0, 0) report a reset, ("bit-rate", bit/s, delay)
    requests a switch of the bus (CiA 305, 6.4.4), ("bus-restart", 0, 0) a restart after bus-off."""

    def __init__(
        self, od: "ObjectDictionary", save: "Callable[[str, bytes], bool] | None" = None,
        load: "Callable[[str], bytes | None] | None" = None,
    ) -> None:  # fmt: skip
        self.od = od
        self.node_id = od.node_id
        self.now_us = 0
        self._ahead_us = 0  # microseconds by which the caller's clock has gone back
        self.application: "Application | None" = None
        self.requests: "list[Request]" = []
        self._outbox: "list[Frame]" = []
        self._routes: "dict[int, Callable[[bytes], None]]" = {}
        self._booted = False
        self.is_rescheduled = True  # a service has another due time
        self._due_us = codes.NEVER_US  # of all services
        self.wear = WearBudget(self)
        self.storage = Storage(self, save, load)
        self.nmt = Nmt(self)
        self.emcy = Emcy(self)
        self.bus_faults = BusFaults(self)
        self.heartbeat = HeartbeatProducer(self)
        self.heartbeat_consumer = HeartbeatConsumer(self)
        self.guarding = NodeGuarding(self)
        self.sdo = SdoServer(self)
        self.time = TimeConsumer(self)
        self.has_lss = True  # an EDS may say otherwise
        self._lss: "LssSlave | None" = None
        self.sync = SyncConsumer(self)
        self.rpdos = ReceivePdos(self)
        self.tpdos = TransmitPdos(self)
        self._timed = (
            self.heartbeat, self.heartbeat_consumer, self.guarding, self.sdo, self.rpdos, self.tpdos,
            self.bus_faults, self.emcy,
        )  # fmt: skip
        self.sync_producer = None
        if od.indices(communication.SYNC_PERIOD, communication.SYNC_PERIOD):
            from .sync_producer import SyncProducer  # a fingertip does without

            self.sync_producer = SyncProducer(self)
            self._timed += (self.sync_producer,)  # type: ignore[assignment]

    @property
    def lss(self) -> "LssSlave":
        """The LSS slave: loaded by the first request, a stored node-id or bit rate."""
        if self._lss is None:
            from .lss import LssSlave

            self._lss = LssSlave(self)
        return self._lss

    def step(self, now_us: int, frames: "Iterable[Frame]" = ()) -> "tuple[list[Frame], int]":
        """Process ``frames``, (SocketCAN can_id, data); return the frames to send and the next due time."""
        now_us += self._ahead_us
        if now_us < self.now_us:
            self._ahead_us += self.now_us - now_us
            now_us = self.now_us
        self.now_us = now_us
        if not self._booted:
            self._booted = True
            stored = self.storage.read_blob(LSS_GROUP)
            if stored:
                self.lss.restore(stored)
            self._restart(True)
        for can_id, data in frames:
            # 29-bit and remote frames have flags above bit 28: only guarding has a route with a flag.
            if can_id & codes.ERROR_FLAG:
                self.bus_faults.receive(can_id, data)
                continue
            if self.bus_faults.off:
                self.bus_faults.heard()
            handler = self._routes.get(can_id)
            if handler is not None:
                handler(data)
        due_us = self._expire(now_us)
        sent, self._outbox = self._outbox, []
        return sent, due_us - self._ahead_us

    def _expire(self, now_us: int) -> int:
        application = self.application
        if application is not None and application.due_us <= now_us:
            application.expire(now_us)
        if self.is_rescheduled or self._due_us <= now_us:  # not at most SYNCs
            for service in self._timed:
                if service.due_us <= now_us:
                    service.expire(now_us)
            self.is_rescheduled = False
            self._due_us = min([service.due_us for service in self._timed])
        if application is not None and application.due_us < self._due_us:
            return application.due_us
        return self._due_us

    def outbox(self) -> "list[Frame]":
        """Return the queue of frames to send. During bus-off they are dropped: stale when the bus recovers."""
        return [] if self.bus_faults.off else self._outbox

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame of a service, see ``outbox``."""
        if not self.bus_faults.off:
            self._outbox.append((can_id, data))

    def upload(self, index: int, sub: int) -> "bytes | int":
        """Return the data for an SDO upload after the application has updated the live values."""
        if self.application is not None and index in self.application.live:
            self.application.refresh(self.now_us)
        if index == communication.ERROR_HISTORY and self.emcy.is_empty(sub):
            return codes.NO_DATA
        return self.od.upload(index, sub)

    def reset(self, whole: bool) -> None:
        """Execute an NMT reset of the communication area or of the whole node."""
        self.requests.append(("reset-node" if whole else "reset-communication", 0, 0))
        self._restart(whole)

    def state_changed(self) -> None:
        """Apply a change of the NMT state: it determines which frames are received and sent."""
        if self.nmt.state == codes.OPERATIONAL:
            self.tpdos.started()
        else:
            self.tpdos.due_us = codes.NEVER_US
            self.rpdos.forget()
        if self.nmt.state == codes.STOPPED:
            self.sdo.reset()
        if self.sync_producer is not None:
            self.sync_producer.state_changed()
        self.emcy.schedule()
        self.settings_changed()
        self.routes_changed()

    def settings_changed(self) -> None:
        """Notify the application that the active PDOs may have changed."""
        if self.application is not None:
            self.application.on_settings()

    def communication_failed(self) -> None:
        """Apply the error behaviour (1029h:1) after heartbeat loss, life guarding or bus-off, in OPERATIONAL only."""
        if self.nmt.state == codes.OPERATIONAL:
            behaviour = self.od.integer(communication.ERROR_BEHAVIOUR, 1)
            if behaviour != 1:
                self.nmt.enter(codes.STOPPED if behaviour == 2 else codes.PRE_OPERATIONAL)

    def routes_changed(self) -> None:
        """Rebuild the table of identifiers that are received in this state (7.3.2.3, table 38)."""
        routes: "dict[int, Callable[[bytes], None]]" = {}
        if self.node_id != codes.LSS_UNCONFIGURED:
            # Identifiers that only this node may send; a service that receives the same identifier takes precedence.
            own = [codes.SDO_RESPONSE_BASE + self.node_id, codes.HEARTBEAT_BASE + self.node_id] + self.tpdos.can_ids()
            self.emcy.cure_all_but(COB_ID_COLLISION, own)
            for can_id in own:
                routes[can_id] = self.bus_faults.collision(can_id)
            routes[codes.HEARTBEAT_BASE + self.node_id | codes.REMOTE_FLAG] = self.guarding.receive
            routes.update(self.heartbeat_consumer.routes())
            if self.nmt.state == codes.OPERATIONAL:
                for can_id in self.rpdos.can_ids():
                    routes[can_id] = lambda data, can_id=can_id: self.rpdos.receive(can_id, data)  # type: ignore[misc]
            if self.nmt.state in codes.TALKING:
                if self.time.can_id is not None:
                    routes[self.time.can_id] = self.time.receive
                routes[self.sync.cob_id] = self.sync.receive
                routes[codes.SDO_REQUEST_BASE + self.node_id] = self.sdo.receive
            routes[codes.NMT_COB_ID] = self.nmt.receive
        if self.has_lss:
            routes[codes.LSS_REQUEST_COB_ID] = lambda data: self.lss.receive(data)  # noqa: PLW0108 loaded then
        self._routes = routes

    def _restart(self, whole: bool) -> None:
        self.nmt.state = codes.INITIALISING
        if self._lss is not None:
            self.node_id = self.od.node_id = self._lss.pending_node_id
            self._lss.leave()
        self.emcy.reset(whole)
        self.storage.restore(None if whole else [COMMUNICATION])
        self.heartbeat_consumer.forget()
        self.guarding.reset()
        self.sdo.reset()
        self.sync.reset()
        if self.sync_producer is not None:
            self.sync_producer.reset()
        self.rpdos.reset()
        self.tpdos.reset()
        if whole and self.application is not None:
            self.application.on_reset(self.now_us)
        if self.node_id == codes.LSS_UNCONFIGURED:
            self.heartbeat.due_us = codes.NEVER_US
            self.routes_changed()
        else:
            self.heartbeat.reset()
            self.nmt.boot()
