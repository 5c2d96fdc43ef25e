"""NMT state of every node from its heartbeats (CiA 301, 7.2.8.3.2), and nodes that use one node-id."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection

import can

from tipforce.device.codes import HEARTBEAT_BASE, NODE_ID_MASK
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.socketcan import raw_can_id

_AFTER_ERROR_S = 0.05


class Heartbeats(can.Listener):
    """Store each node's last heartbeat; any number of threads may wait for one. ``duplicates`` gets every frame."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[float, int]] = {}
        self._arrived = threading.Condition()
        self.duplicates = DuplicateNodes()

    def on_message_received(self, msg: can.Message) -> None:
        """Store a heartbeat; called by the Notifier's thread."""
        if not msg.is_fd:
            self.duplicates.frame(raw_can_id(msg), bytes(msg.data), round(1e9 * msg.timestamp))
        if not 0 < msg.arbitration_id - HEARTBEAT_BASE <= NODE_ID_MASK or len(msg.data) != 1:
            return
        if msg.is_extended_id or msg.is_remote_frame or msg.is_error_frame:
            return
        with self._arrived:
            self._last[msg.arbitration_id & NODE_ID_MASK] = time.monotonic(), msg.data[0] & 0x7F
            self._arrived.notify_all()

    def on_error(self, exc: Exception) -> None:
        """Continue to listen after a bus error, which the Notifier keeps for waiting threads; called by the Notifier.

        Without this its thread would end with a traceback. A bus that fails repeatedly must not keep a core busy.
        """
        del exc
        time.sleep(_AFTER_ERROR_S)

    def stop(self) -> None:
        """Do nothing; called by the Notifier at its end."""

    def state(self, node_id: int) -> int | None:
        """Return the NMT state of the last heartbeat, None for a node without one."""
        with self._arrived:
            return self._last[node_id][1] if node_id in self._last else None

    def wait(self, node_id: int, states: Collection[int], since_s: float, timeout_s: float) -> bool:
        """Wait for a heartbeat with one of ``states`` after ``since_s`` (monotonic); return False if there is none."""
        deadline_s = time.monotonic() + timeout_s
        with self._arrived:
            while True:
                heard_s, state = self._last.get(node_id, (-1.0, -1))
                if heard_s >= since_s and state in states:
                    return True
                left_s = deadline_s - time.monotonic()
                if left_s <= 0 or not self._arrived.wait(left_s):
                    return False
