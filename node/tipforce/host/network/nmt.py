"""NMT states of the nodes from their heartbeats (CiA 301, 7.2.8.3.2), and commands that wait for them (7.3.2.2)."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from typing import TYPE_CHECKING

import can

from canopen_device.can_frame import raw_can_id
from canopen_device.core import codes
from canopen_device.core.codes import HEARTBEAT_BASE, NODE_ID_MASK
from tipforce.errors import NoResponseError
from tipforce.host.decoding.duplicates import DuplicateNodes

if TYPE_CHECKING:
    from tipforce.host.network.bus import Bus

_AFTER_ERROR_S = 0.05


class Heartbeats(can.Listener):
    """Store each node's last heartbeat; any number of threads may wait for one. ``duplicates`` gets every frame."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[float, int]] = {}
        self._arrived = threading.Condition()
        self.duplicates = DuplicateNodes()

    def on_message_received(self, msg: can.Message) -> None:
        """Store a heartbeat; called by the Notifier's thread."""
        can_id = raw_can_id(msg)
        if not msg.is_fd:
            self.duplicates.frame(can_id, bytes(msg.data), round(1e9 * msg.timestamp))
        if not 0 < can_id - HEARTBEAT_BASE <= NODE_ID_MASK or len(msg.data) != 1:
            return
        with self._arrived:
            self._last[can_id & NODE_ID_MASK] = time.monotonic(), msg.data[0] & 0x7F
            self._arrived.notify_all()

    def on_error(self, exc: Exception) -> None:
        """Continue to listen after a bus error, which the Notifier keeps for waiting threads; called by the Notifier.
        Without this its thread would end with a traceback. A bus that fails repeatedly must not keep a core busy."""
        del exc
        time.sleep(_AFTER_ERROR_S)

    def stop(self) -> None:
        """Do nothing; called by the Notifier at its end."""

    def state(self, node_id: int) -> int | None:
        """Return the NMT state of the last heartbeat, None for a node without one."""
        with self._arrived:
            return self._last[node_id][1] if node_id in self._last else None

    def wait(self, node_id: int, wanted: int, since_s: float, timeout_s: float) -> bool:
        """Wait for a heartbeat with a state after ``since_s`` (monotonic); return False if there is none."""
        deadline_s = time.monotonic() + timeout_s
        with self._arrived:
            while True:
                heard_s, state = self._last.get(node_id, (-1.0, -1))
                if heard_s >= since_s and state == wanted:
                    return True
                left_s = deadline_s - time.monotonic()
                if left_s <= 0 or not self._arrived.wait(left_s):
                    return False


NMT_COMMANDS = {
    "start": (codes.NMT_START, codes.OPERATIONAL),
    "stop": (codes.NMT_STOP, codes.STOPPED),
    "preop": (codes.NMT_ENTER_PRE_OPERATIONAL, codes.PRE_OPERATIONAL),
    "reset-node": (codes.NMT_RESET_NODE, codes.INITIALISING),  # a reset ends with the boot-up message
    "reset-comm": (codes.NMT_RESET_COMMUNICATION, codes.INITIALISING),
}
"""Command specifier, and the state that the heartbeat then reports."""

_AGAIN_S = 0.5


class NotReachedError(NoResponseError):
    """Some nodes did not report the state; ``reached`` has the states of the others, by node-id."""

    def __init__(self, message: str, reached: dict[int, str]) -> None:
        super().__init__(message)
        self.reached = reached


def command_and_wait(
    connection: Bus, command: str, node_ids: Collection[int], timeout_s: float = 2.0
) -> dict[int, str]:
    """Send an NMT command to each node and wait for its heartbeat; return the state that each reported. A command other
    than a reset is repeated until then (NMT is not confirmed), so a node may boot meanwhile. Raises NotReachedError
    naming the nodes without it: off, or their heartbeat (1017h) is slower or 0."""
    from tipforce.dictionary.service_texts import state_text

    since_s = time.monotonic()
    wanted, reached = NMT_COMMANDS[command][1], dict[int, str]()
    again_s = timeout_s if command.startswith("reset") else _AGAIN_S
    waiting = sorted(node_ids)
    while waiting and (now_s := time.monotonic()) < since_s + timeout_s:
        for node_id in waiting:
            connection.nmt(command, node_id)
        until_s = min(now_s + again_s, since_s + timeout_s)
        for node_id in waiting:
            if connection.heartbeats.wait(node_id, wanted, since_s, max(0.0, until_s - time.monotonic())):
                reached[node_id] = state_text(wanted)
        waiting = [node_id for node_id in waiting if node_id not in reached]
    if waiting:
        last = ((node_id, connection.heartbeats.state(node_id)) for node_id in waiting)
        shown = [f"{n} ({'silent' if s is None else f'last reported {state_text(s)}'})" for n, s in last]
        raise NotReachedError(
            f"nmt {command}: no heartbeat with the new state within {timeout_s:g} s from node {', '.join(shown)}; "
            "check that its heartbeat (1017h) is on and faster than this",
            reached,
        )
    return reached
