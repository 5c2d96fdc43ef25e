"""A CANopen device as a pure state machine (CiA 301): frames and time in, frames and the next due time out."""

from . import codes
from .heartbeat import HeartbeatProducer
from .nmt import Nmt
from .rpdo import ReceivePdos
from .sdo_server import SdoServer
from .storage import Storage
from .sync import SyncConsumer
from .tpdo import TransmitPdos

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from .object_dictionary import ObjectDictionary

    Frame = tuple[int, bytes]


class Application:
    """What a device does besides CANopen. Every method may be overridden; this one does nothing.

    ``live`` holds the indices whose values change by themselves: ``refresh`` is called before one is uploaded.
    """

    live: "frozenset[int]" = frozenset()

    def on_reset(self, now_us: int) -> None:
        """All parameters are restored; the boot-up message is about to go out."""

    def on_sync(self, now_us: int) -> None:
        """A SYNC came: latch what the PDOs are to carry."""

    def refresh(self, now_us: int) -> None:
        """A live value is about to be read outside a SYNC (SDO upload, event-driven PDO)."""


class Device:
    """One node. Call ``step`` with the frames that came and with the time; send what it returns.

    ``now_us`` is a count of microseconds that never wraps and never goes back. ``requests`` collects what the loop
    must do for the device ("reset-node", "reset-communication"); the loop empties it.
    """

    def __init__(
        self,
        od: "ObjectDictionary",
        save: "Callable[[str, bytes], bool] | None" = None,
        load: "Callable[[str], bytes | None] | None" = None,
    ) -> None:
        self.od = od
        self.node_id = od.node_id
        self.now_us = 0
        self.application: "Application | None" = None
        self.requests: "list[str]" = []
        self._outbox: "list[Frame]" = []
        self._routes: "dict[int, Callable[[bytes], None]]" = {}
        self._booted = False
        self.storage = Storage(self, save, load)
        self.nmt = Nmt(self)
        self.heartbeat = HeartbeatProducer(self)
        self.sdo = SdoServer(self)
        self.sync = SyncConsumer(self)
        self.rpdos = ReceivePdos(self)
        self.tpdos = TransmitPdos(self)

    def step(self, now_us: int, frames: "Iterable[Frame]" = ()) -> "tuple[list[Frame], int]":
        """Take ``frames`` as (SocketCAN can_id, data); return the frames to send and the next due time."""
        self.now_us = now_us
        if not self._booted:
            self._booted = True
            self._restart(True)
        for can_id, data in frames:
            # Error, 29-bit and remote frames carry their flags above bit 28, so no route matches them.
            handler = self._routes.get(can_id)
            if handler is not None:
                handler(data)
        due_us = codes.NEVER_US
        for service in (self.heartbeat, self.sdo, self.tpdos):
            if service.due_us <= now_us:
                service.expire(now_us)
            due_us = min(due_us, service.due_us)
        sent, self._outbox = self._outbox, []
        return sent, due_us

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame; services call this."""
        self._outbox.append((can_id, data))

    def upload(self, index: int, sub: int) -> "bytes | int":
        """What an SDO client reads, after the application had the chance to bring live values up to date."""
        if self.application is not None and index in self.application.live:
            self.application.refresh(self.now_us)
        return self.od.upload(index, sub)

    def reset(self, whole: bool) -> None:
        """NMT reset: the communication area, or the whole node."""
        self.requests.append("reset-node" if whole else "reset-communication")
        self._restart(whole)

    def state_changed(self) -> None:
        """The NMT state is another one: what may be received and sent changes with it."""
        if self.nmt.state == codes.OPERATIONAL:
            self.tpdos.started()
        else:
            self.tpdos.stopped()
            self.rpdos.forget()
        if self.nmt.state == codes.STOPPED:
            self.sdo.reset()
        self.routes_changed()

    def routes_changed(self) -> None:
        """Work out anew which identifiers are listened to in this state (7.3.2.3, table 38)."""
        routes: "dict[int, Callable[[bytes], None]]" = {0x000: self.nmt.receive}
        state = self.nmt.state
        if state == codes.OPERATIONAL:
            for can_id in self.rpdos.can_ids():
                routes[can_id] = self._rpdo_route(can_id)
        if state in (codes.OPERATIONAL, codes.PRE_OPERATIONAL):
            routes[self.sync.cob_id] = self.sync.receive
            routes[0x600 + self.node_id] = self.sdo.receive
        self._routes = routes

    def _rpdo_route(self, can_id: int) -> "Callable[[bytes], None]":
        return lambda data: self.rpdos.receive(can_id, data)

    def _restart(self, whole: bool) -> None:
        self.nmt.state = codes.INITIALISING
        self.storage.restore(None if whole else [2])
        self.sdo.reset()
        self.sync.reset()
        self.rpdos.reset()
        self.tpdos.reset()
        if whole and self.application is not None:
            self.application.on_reset(self.now_us)
        self.heartbeat.reset()
        self.nmt.boot()
