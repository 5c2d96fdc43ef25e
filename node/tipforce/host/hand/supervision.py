"""Judge what frames say of the fingers: events, and the recoveries that they call for."""

from __future__ import annotations

import time
from collections.abc import Callable

from canopen_device.core import emcy
from canopen_device.core.codes import OPERATIONAL
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.bring_up import HEALTH_MS
from tipforce.host.hand.events import BabbleWatch, Event, Supervisor, waited_s
from tipforce.host.hand.recovery import LOST, Recovery
from tipforce.host.hand.recovery_queue import RecoveryQueue
from tipforce.host.hand.rows import Collector
from tipforce.host.hand.trust import COUNTER

_RECOVERED_BY_HAND = (emcy.BUS_OFF_RECOVERED, emcy.SYNC_LENGTH)
_HEALTH_SILENT_S = 1.5e-3 * HEALTH_MS  # then 2126h is read
_UNANSWERED_S = 1.0  # a finger that is off is noticed by its heartbeat before
_LOST_PROBE_S = 1.0  # interval of LSS searches for a lost finger


class Supervision:
    """Process the frames that the collector has processed; ``on_event`` gets each event."""

    def __init__(
        self, supervisor: Supervisor, babbling: BabbleWatch, collector: Collector, recovery: Recovery,
        queue: RecoveryQueue, on_event: Callable[[Event], None],
    ) -> None:  # fmt: skip
        self._supervisor, self._babbling, self._collector = supervisor, babbling, collector
        self._recovery, self._queue, self._on_event = recovery, queue, on_event
        self._probe_s = 0.0
        self._heard_s = 0.0  # all frames up to this time were read

    def process(self, frames: FrameArray, now_s: float) -> None:
        """Process received frames, FRAME (n,); without frames too, to detect silence. ``now_s`` is monotonic."""
        self._heard_s = max(self._heard_s, now_s - waited_s(frames, time.time_ns()))
        for event in self._supervisor.add(frames, self._heard_s) + self._babbling.add(frames, now_s):
            self._on_event(event)
            self._react(event)
        trust, states = self._collector.trust, self._supervisor.states
        for node_id in trust.take_changes():
            text = "it was changed by another master: its values are unknown until they are verified"
            self._on_event(Event(time.monotonic(), node_id, "changed", text))
        for node_id in trust.take_unanswered(now_s, max(_UNANSWERED_S, 1.5 * self._supervisor.timeout_s)):
            if states[node_id] == OPERATIONAL:
                self._on_event(Event(time.monotonic(), node_id, "failed", "operational, but it answers no SYNC"))
                trust.ask(node_id, self._recovery.needed_keys(node_id))
                self._queue.need([node_id])
        due = trust.due(now_s, _HEALTH_SILENT_S)
        self._queue.need([n for n in due if states[n] == OPERATIONAL or trust.changed(n)])  # starts what waits, too
        self._queue.need(trust.take_asked(now_s), quiet=True)
        # Search by LSS: a finger that lost its node-id at power-off sends no boot-up message.
        if now_s >= self._probe_s:
            self._probe_s = now_s + _LOST_PROBE_S
            if any(state < 0 for state in states.values()):
                self._queue.need([LOST])

    def _react(self, event: Event) -> None:
        """Request the recovery that an event calls for."""
        node_id = event.node_id
        if event.kind == "boot_up":
            self._recovery.booted(node_id)
            self._queue.need([node_id])
        elif event.kind == "heartbeat_lost":
            self._recovery.silent(node_id)
            self._queue.drop(node_id)
        elif event.kind in ("state", "heartbeat_back"):
            self._collector.expect(node_id, event.code == OPERATIONAL)
            if event.kind == "heartbeat_back" or event.code != OPERATIONAL:
                self._queue.need([node_id])
        elif event.kind == "duplicate":
            self._collector.trust.suspect([node_id])  # until SDO shows what it is, and that one node responds
            self._queue.need([node_id])
        elif event.kind == "emcy" and event.code in _RECOVERED_BY_HAND:
            self._collector.trust.suspect([node_id], (COUNTER,))
            self._queue.need([node_id])
