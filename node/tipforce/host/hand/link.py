"""Access of a hand to its bus: a connection for SDO and NMT, a receiver for all frames, and a SYNC producer.

On SocketCAN the receiver is a separate raw socket, which also receives the SYNCs that the kernel sends. On other
interfaces one python-can bus does both, and own SYNCs are inserted among the received frames when they are sent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from canopen_device.core.codes import FUNCTION_MASK, HEARTBEAT_BASE, SDO_RESPONSE_BASE, SYNC_COB_ID
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FrameArray, FrameBuffer
from tipforce.host.hand.sync import ThreadSync, kernel_sync
from tipforce.host.live.receive import open_receiver
from tipforce.host.live.receiver import Receiver
from tipforce.host.network.bus import Bus
from tipforce.host.network.open_bus import open_bus

SERVICE_FILTERS = (
    {"can_id": SDO_RESPONSE_BASE, "can_mask": FUNCTION_MASK, "extended": False},
    {"can_id": HEARTBEAT_BASE, "can_mask": HEARTBEAT_BASE, "extended": False},
)
"""Frames for a connection beside a receiver: SDO responses, heartbeats, LSS. PDOs would cost 15 us each twice."""

KEPT_FRAMES = 20_000  # in the connection's buffer: a hand runs for days, and only the search for nodes reads it


class Link:
    """An open bus of python-can: a connection, its frames, and SYNCs."""

    def __init__(self, connection: Bus) -> None:
        self.connection = connection
        connection.buffer.limit = KEPT_FRAMES
        self._frames = FrameBuffer()
        assert self.connection.network.notifier is not None  # a Bus is connected
        self.connection.network.notifier.add_listener(self._frames)

    def receive(self, timeout_s: float) -> FrameArray:
        """Return the received frames, FRAME (n,), SYNCs included. Raises EnvironmentLackError if the bus fails."""
        notifier = self.connection.network.notifier
        if notifier is not None and notifier.exception is not None:
            raise EnvironmentLackError(f"the bus failed: {notifier.exception}")
        return self._frames.take_some(time.monotonic() + timeout_s)

    def start_sync(self, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
        """Send SYNCs with ``data`` in turn from now on, until the returned function is called."""
        return ThreadSync(self._sync, period_s, data).stop

    def _sync(self, data: bytes) -> None:
        # First into the stream, then onto the bus: no answer can precede its SYNC.
        self._frames.put((time.time_ns(), SYNC_COB_ID, data))
        self.connection.send(SYNC_COB_ID, data)

    @property
    def dropped(self) -> int:
        """Frames lost because they were not read in time."""
        return self._frames.dropped

    def close(self) -> None:
        """Close the bus."""
        self.connection.close()


class SharedLink(Link):
    """A bus that was already open and stays open."""

    def close(self) -> None:
        """Stop listening."""
        notifier = self.connection.network.notifier
        if notifier is not None:
            with suppress(ValueError):
                notifier.remove_listener(self._frames)


class SocketLink(Link):
    """A SocketCAN interface."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._receiver: Receiver = open_receiver(options)
        try:
            self._receiver.receive(0.0)  # an interface that is down can be opened; reading raises the error
            self._bus = open_bus(**options)
        except BaseException:
            self._receiver.close()
            raise
        self._bus.set_filters(SERVICE_FILTERS)  # type: ignore[arg-type]
        self.connection = Bus(self._bus)
        self.connection.buffer.limit = KEPT_FRAMES

    def receive(self, timeout_s: float) -> FrameArray:
        """See Link."""
        return self._receiver.receive(timeout_s)

    def start_sync(self, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
        """See Link."""
        return kernel_sync(self._bus, period_s, data)

    @property
    def dropped(self) -> int:
        """See Link."""
        return self._receiver.dropped

    def close(self) -> None:
        """See Link."""
        self._receiver.close()
        super().close()


def open_link(options: Mapping[str, Any]) -> Link:
    """Open the bus that ``options`` (keywords of ``can.Bus``) name. Raises EnvironmentLackError."""
    return SocketLink(options) if options.get("interface") == "socketcan" else Link(Bus(open_bus(**options)))
