"""A bus and its nodes, seen from the host: SDO, SYNC, NMT (CiA 301, 7.3.2.2), and their heartbeats (7.2.8.3.2)."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import can

from canopen_device.can_frame import raw_can_id
from canopen_device.core import codes
from canopen_device.errors import cause
from tipforce.arrays import whole
from tipforce.errors import EnvironmentLackError, InputError, NoResponseError
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.frames.frame_array import FrameArray, FrameBuffer
from tipforce.host.network.sdo import DEFAULT_RETRIES, DEFAULT_TIMEOUT_S, SdoChannel, checked_time

if TYPE_CHECKING:
    import canopen

    from tipforce.host.network.find import FoundNode
    from tipforce.host.network.finger import Finger

_SYNC_SILENT_S = 1.0
_LONGEST_SYNC_PERIOD_S = 10.0
_RECEIVE_CYCLE_S = 0.05  # the receiver sees the end of its thread so late
_AFTER_ERROR_S = 0.05

Subscriber: TypeAlias = Callable[[int, bytearray, float], None]

NMT_COMMANDS = {
    "start": (codes.NMT_START, codes.OPERATIONAL),
    "stop": (codes.NMT_STOP, codes.STOPPED),
    "preop": (codes.NMT_ENTER_PRE_OPERATIONAL, codes.PRE_OPERATIONAL),
    "reset-node": (codes.NMT_RESET_NODE, codes.INITIALISING),  # a reset ends with the boot-up message
    "reset-comm": (codes.NMT_RESET_COMMUNICATION, codes.INITIALISING),
}
"""Command specifier, and the state that the heartbeat then reports."""


class Heartbeats(can.Listener):
    """Store each node's last heartbeat; any number of threads may wait for one. ``duplicates`` gets every frame."""

    def __init__(self) -> None:
        self._last: dict[int, int] = {}
        self._heard_s: dict[tuple[int, int], float] = {}  # by node-id and state: a boot-up is followed by another state
        self._arrived = threading.Condition()
        self.duplicates = DuplicateNodes()

    def on_message_received(self, msg: can.Message) -> None:
        """Store a heartbeat; called by the Notifier's thread."""
        can_id = raw_can_id(msg)
        if not msg.is_fd:
            self.duplicates.frame(can_id, bytes(msg.data), round(1e9 * msg.timestamp))
        if not 0 < can_id - codes.HEARTBEAT_BASE <= codes.NODE_ID_MASK or len(msg.data) != 1:
            return
        with self._arrived:
            node_id, state = can_id & codes.NODE_ID_MASK, msg.data[0] & 0x7F
            self._last[node_id], self._heard_s[node_id, state] = state, time.monotonic()
            self._arrived.notify_all()

    def on_error(self, _exc: Exception) -> None:
        """Continue to listen after a bus error, which the Notifier keeps for waiting threads; called by the Notifier.
        Without this its thread would end with a traceback. A bus that fails repeatedly must not keep a core busy."""
        time.sleep(_AFTER_ERROR_S)

    def state(self, node_id: int) -> int | None:
        """Return the NMT state of the last heartbeat, None for a node without one."""
        with self._arrived:
            return self._last.get(node_id)

    def wait(self, node_id: int, wanted: int, since_s: float, timeout_s: float) -> bool:
        """Wait for a heartbeat with a state after ``since_s`` (monotonic), also if others followed it; return False if
        there is none."""
        with self._arrived:
            return self._arrived.wait_for(lambda: self._heard_s.get((node_id, wanted), -1.0) >= since_s, timeout_s)


class Dispatcher(can.Listener):
    """Pass the data frames of a bus to the subscribers of their identifiers, and send: the part of ``canopen.Network``
    that a host needs, without the import of canopen's nodes, PDOs and dictionaries."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus: can.BusABC | None = bus
        self.notifier: can.Notifier | None = None
        self._subscribers: dict[int, list[Subscriber]] = {}
        self._lock = threading.Lock()

    def subscribe(self, can_id: int, subscriber: Subscriber) -> None:
        """Call ``subscriber(can_id, data, t_s)`` for each frame, in the thread that receives it."""
        self._subscribers.setdefault(can_id, []).append(subscriber)

    def unsubscribe(self, can_id: int, subscriber: Subscriber) -> None:
        """Stop that."""
        with suppress(ValueError):
            self._subscribers.get(can_id, []).remove(subscriber)

    def on_message_received(self, msg: can.Message) -> None:
        """Pass a frame on, unless it is none of CANopen's; called by the Notifier's thread."""
        if not (msg.is_error_frame or msg.is_remote_frame or msg.is_extended_id or msg.is_fd):
            self.notify(msg.arbitration_id, msg.data, msg.timestamp)

    def notify(self, can_id: int, data: bytearray, t_s: float) -> None:
        """Pass a frame to its subscribers."""
        for subscriber in tuple(self._subscribers.get(can_id, ())):
            subscriber(can_id, data, t_s)

    def send_message(self, can_id: int, data: bytes) -> None:
        """Send a frame. Raises what the bus raises, also while it receives, and RuntimeError where it is closed."""
        bus = self.bus  # another thread may close it from here on
        if bus is None:
            raise RuntimeError("Not connected to CAN bus")
        with self._lock:
            bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        if can_id & codes.FUNCTION_MASK == codes.SDO_REQUEST_BASE:
            self.notify(can_id, bytearray(data), 0.0)
        if self.notifier is not None and self.notifier.exception is not None:
            raise self.notifier.exception


class Bus:
    """One CAN bus: its fingers, SDO, NMT, SYNC, every frame. ``bus``: python-can's, or a ``canopen.Network``, which
    ``close`` leaves open, as any not ``owned``. ``timeout_s`` and ``retries``: of every SDO transfer."""

    def __init__(
        self, bus: can.BusABC | canopen.Network, timeout_s: float = DEFAULT_TIMEOUT_S, retries: int = DEFAULT_RETRIES,
        *, owned: bool = True,
    ) -> None:  # fmt: skip
        self._timeout_s = checked_time("timeout_s", timeout_s)
        if not isinstance(retries, int) or retries < 0:
            raise InputError(f"retries = {retries!r}: allowed are whole numbers from 0")
        self._retries = retries
        self._channels: dict[int, SdoChannel] = {}
        self._fingers: dict[tuple[int, bool, int], Finger] = {}
        self._lock = threading.Lock()
        self._foreign_sync_s: tuple[float, float] = (-math.inf, 0.0)
        self._own_sync_s = -math.inf
        self._sync_number = 0
        self.sync_overflow = 0
        """1019h of the nodes: over 1, own SYNCs carry a number. A hand that was killed may have left it."""
        self.buffer = FrameBuffer()
        self.heartbeats = Heartbeats()
        self.duplicates = self.heartbeats.duplicates
        self._owned = owned
        self._network = None if isinstance(bus, can.BusABC) else bus
        if not isinstance(bus, can.BusABC):
            if bus.bus is None or bus.notifier is None:
                raise InputError("the canopen.Network is not connected: call its connect() first")
            running, bus = [bus.notifier], bus.bus
        else:
            running = list(can.Notifier.find_instances(bus))
        self.dispatcher = Dispatcher(bus)
        self.dispatcher.subscribe(codes.SYNC_COB_ID, self._on_sync)
        self._listeners: list[Any] = [self.buffer, self.heartbeats, self.dispatcher]
        self._is_shared = bool(running)  # another owner receives from the bus
        self.notifier = running[0] if running else can.Notifier(bus, [*self._listeners], _RECEIVE_CYCLE_S)
        for listener in self._listeners if running else ():
            self.notifier.add_listener(listener)
        self.dispatcher.notifier = self.notifier

    @property
    def network(self) -> canopen.Network:
        """A ``canopen.Network`` on this bus: the one given, otherwise one that receives from its first use on."""
        if self._network is None:
            import canopen

            self._network = canopen.Network(self.dispatcher.bus)
            self._network.notifier = self.notifier
            for listener in self._network.listeners:
                self.notifier.add_listener(listener)
            self._listeners += self._network.listeners
        return self._network

    @classmethod
    def open(
        cls, channel: str | can.BusABC | canopen.Network | None = None, interface: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S, retries: int = DEFAULT_RETRIES, **bus_options: Any,
    ) -> Bus:  # fmt: skip
        """Open a bus: ``open("can0")``, ``open("can0", "socketcan")``, or an open ``can.Bus`` or ``canopen.Network``,
        which stays open. Names are python-can's; on Linux alone SocketCAN's. Raises EnvironmentLackError."""
        if isinstance(channel, can.BusABC) or hasattr(channel, "add_node"):  # a canopen.Network, which is not imported
            return cls(channel, timeout_s, retries, owned=False)  # type: ignore[arg-type]
        if channel is not None and interface is None and sys.platform == "linux":
            own = can.rc.get("interface") or os.environ.get("CAN_INTERFACE")  # python-can's configuration
            interface = None if own or can.util.load_file_config().get("interface") else "socketcan"
        from tipforce.host.network.interfaces import open_bus

        opened = open_bus(channel=channel, interface=interface, **bus_options)
        try:
            return cls(opened, timeout_s, retries)
        except InputError:
            opened.shutdown()
            raise

    def finger(self, node_id: int, *, passive: bool = False, gauges: int = 3) -> Finger:
        """Return the finger with a node-id. ``passive``: nothing is sent, default PDOs of ``gauges``; else PDOs are
        read by SDO, the node is started, and SYNCs are sent if nobody sends them. Raises InputError outside 1..127."""
        from tipforce.host.network.finger import Finger

        finger = Finger(self, node_id, passive=passive, default_gauges=gauges)
        with self._lock:
            return self._fingers.setdefault((node_id, passive, gauges), finger)

    def scan(self, node_ids: Iterable[int] = range(1, 128), wait_s: float = 1.2) -> list[FoundNode]:
        """Return the nodes on the bus. See ``find_nodes``."""
        from tipforce.host.network.find import find_nodes

        return find_nodes(self, node_ids, wait_s)

    def sdo(self, node_id: int) -> SdoChannel:
        """Return the SDO channel to a node; the same object for the same node. Raises InputError outside 1..127."""
        node_id = whole("node-id", node_id, range(1, 128))
        with self._lock:
            if node_id not in self._channels:
                self._channels[node_id] = SdoChannel(
                    self.dispatcher, node_id, self._timeout_s, self._retries, duplicates=self.duplicates
                )
            return self._channels[node_id]

    def nmt(self, command: str, node_id: int = 0) -> int:
        """Send an NMT command (a key of NMT_COMMANDS) to a node, or to all with 0; return the state that follows."""
        if command not in NMT_COMMANDS:
            raise InputError(f"NMT command {command!r}: allowed are {', '.join(NMT_COMMANDS)}")
        if node_id not in range(128):
            raise InputError(f"node-id {node_id!r}: allowed are 1 to 127, and 0 for all nodes")
        specifier, state = NMT_COMMANDS[command]
        self.send(codes.NMT_COB_ID, bytes((specifier, node_id)))
        return state

    def sync(self) -> None:
        """Send one SYNC, with its number where ``sync_overflow`` asks for one."""
        self._own_sync_s = time.monotonic()
        self._sync_number = self._sync_number % self.sync_overflow + 1 if self.sync_overflow > 1 else 0
        self.send(codes.SYNC_COB_ID, bytes((self._sync_number,)) if self._sync_number else b"")

    def sync_due_s(self, period_s: float) -> float:
        """Return the next due time of an own SYNC (monotonic), one every ``period_s``; inf: another node sends it.
        Another producer counts as silent after a second, or three of its periods."""
        heard_s, other_period_s = self._foreign_sync_s
        if time.monotonic() - heard_s < max(_SYNC_SILENT_S, 3.0 * other_period_s):
            return math.inf
        return self._own_sync_s + period_s

    def _on_sync(self, _can_id: int, _data: bytearray, _t_s: float) -> None:
        now_s = time.monotonic()
        period_s = now_s - self._foreign_sync_s[0]  # a long one is none: each was sent for one reading
        self._foreign_sync_s = now_s, period_s if period_s <= _LONGEST_SYNC_PERIOD_S else 0.0

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame with an 11-bit identifier. Raises EnvironmentLackError if the bus refuses it."""
        self.duplicates.frame(can_id, data, time.time_ns())
        try:
            self.dispatcher.send_message(can_id, data)
        except (can.CanError, OSError, RuntimeError) as error:
            raise EnvironmentLackError(f"frame 0x{can_id:03X}: the bus refused it: {cause(error)}") from None

    def check_reception(self) -> None:
        """Raise EnvironmentLackError if the bus failed: frames may be lost."""
        if (exception := self.notifier.exception) is not None:
            raise EnvironmentLackError(f"the bus failed: {cause(exception)}")

    def check_duplicates(self, node_ids: Iterable[int] = ()) -> None:
        """Raise DuplicateNodeError if two nodes use one of ``node_ids``, or one with which SDO was spoken. Waits for
        second responses; sends requests only where there is a suspicion."""
        with self._lock:
            spoken = set(self._channels)
        for node_id in sorted(spoken.union(node_ids)):
            self.sdo(node_id).check_duplicates(wait=True)

    def wait_for(self, can_ids: set[int], timeout_s: float = 1.0) -> FrameArray:
        """Read received frames until each of ``can_ids`` is among them; return all of them, in order. Raises
        NoResponseError naming the identifiers that were not received in time."""
        frames = self.buffer.take(can_ids, time.monotonic() + checked_time("timeout_s", timeout_s))
        missing = can_ids - set(frames["can_id"].tolist())
        if missing:
            names = ", ".join(f"0x{can_id:03X}" for can_id in sorted(missing))
            raise NoResponseError(f"no frame with identifier {names} within {timeout_s:g} s")
        return frames

    def close(self) -> None:
        """Stop receiving and, if it is owned, release the bus; also one that has failed."""
        with self._lock:
            users: list[Finger | SdoChannel] = [*self._fingers.values(), *self._channels.values()]
            self._fingers, self._channels = {}, {}
        for user in users:
            user.close()
        if self._is_shared:
            for listener in self._listeners:
                with suppress(ValueError):
                    self.notifier.remove_listener(listener)
            return
        self.notifier.stop()
        if self._owned and self.dispatcher.bus is not None:
            with suppress(can.CanError):
                self.dispatcher.bus.shutdown()
        self.dispatcher.bus = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


open_connection = Bus.open
