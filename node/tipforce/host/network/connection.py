"""A bus and the nodes on it, as the host sees them."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from types import TracebackType
from typing import Any

import can
import canopen

from tipforce.errors import EnvironmentLackError, InputError, NoResponseError
from tipforce.host.frames.frame_array import FrameArray, FrameBuffer
from tipforce.host.network.bus import open_bus
from tipforce.host.network.heartbeats import Heartbeats
from tipforce.host.network.sdo import DEFAULT_RETRIES, DEFAULT_TIMEOUT_S, SdoChannel

NMT_COMMANDS = {"start": 1, "stop": 2, "preop": 128, "reset-node": 129, "reset-comm": 130}
NMT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
SYNC_COB_ID = 0x80
_RECEIVE_CYCLE_S = 0.05  # how long close() waits for the receiver at most; canopen's own is a second


class Connection:
    """One CAN bus: SDO to its nodes, NMT, SYNC, and every frame that was received.

    Use it as a context manager. ``timeout_s`` and ``retries`` hold for every SDO transfer.
    """

    def __init__(self, bus: can.BusABC, timeout_s: float = DEFAULT_TIMEOUT_S, retries: int = DEFAULT_RETRIES) -> None:
        self._timeout_s = timeout_s
        self._retries = retries
        self._channels: dict[int, SdoChannel] = {}
        self._lock = threading.Lock()
        self.network = canopen.Network(bus)
        self.network.NOTIFIER_CYCLE = _RECEIVE_CYCLE_S
        self.buffer = FrameBuffer()
        self.heartbeats = Heartbeats()
        self.network.listeners += [self.buffer, self.heartbeats]  # type: ignore[list-item]
        self.network.connect()

    @classmethod
    def open(
        cls,
        channel: str | None = None,
        interface: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: int = DEFAULT_RETRIES,
        **bus_options: Any,
    ) -> Connection:
        """Open a bus by python-can's names, its configuration files and environment variables included.

        Raises EnvironmentLackError when the bus cannot be opened.
        """
        return cls(open_bus(channel=channel, interface=interface, **bus_options), timeout_s, retries)

    def sdo(self, node_id: int) -> SdoChannel:
        """The SDO channel to a node; the same object for the same node. Raises InputError outside 1..127."""
        if not 1 <= node_id <= 127:
            raise InputError(f"node-id {node_id}: allowed are 1 to 127")
        with self._lock:
            if node_id not in self._channels:
                self._channels[node_id] = SdoChannel(self.network, node_id, self._timeout_s, self._retries)
            return self._channels[node_id]

    def nmt(self, command: str, node_id: int = 0) -> None:
        """Send an NMT command (a key of NMT_COMMANDS) to a node, or to all with 0."""
        if command not in NMT_COMMANDS:
            raise InputError(f"NMT command {command!r}: allowed are {', '.join(NMT_COMMANDS)}")
        self.send(0, bytes((NMT_COMMANDS[command], node_id)))

    def sync(self) -> None:
        """Send one SYNC."""
        self.send(SYNC_COB_ID, b"")

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame with an 11-bit identifier. Raises EnvironmentLackError when the bus refuses it."""
        try:
            self.network.send_message(can_id, data)
        except (can.CanError, RuntimeError) as error:  # canopen says so of a closed bus
            raise EnvironmentLackError(f"frame 0x{can_id:03X}: the bus refused it: {error}") from None

    def wait_for(self, can_ids: set[int], timeout_s: float = 1.0) -> FrameArray:
        """Take received frames until each of ``can_ids`` was among them; returns all that came, in order.

        Raises NoResponseError naming the identifiers that did not come in time.
        """
        deadline = time.monotonic() + timeout_s
        missing = set(can_ids)

        def complete(can_id: int) -> bool:
            missing.discard(can_id)
            return not missing

        frames = self.buffer.take(complete, deadline)
        if missing:
            names = ", ".join(f"0x{can_id:03X}" for can_id in sorted(missing))
            raise NoResponseError(f"no frame with identifier {names} within {timeout_s:g} s")
        return frames

    def close(self) -> None:
        """Stop receiving and release the bus; also one that has failed, whose error was for those who waited."""
        if self.network.notifier is not None:
            self.network.notifier.exception = None  # canopen would log it, and raise it when all is released
        with suppress(can.CanError):
            self.network.disconnect()

    def __enter__(self) -> Connection:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
