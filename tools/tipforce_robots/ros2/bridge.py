"""Publish a feed: wrench and contact of each fingertip at each SYNC, diagnostics once a second and at each event."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError, TipforceError
from tipforce.samples.columns import Block
from tipforce_robots.ros2 import cdr
from tipforce_robots.ros2 import messages as diagnosing
from tipforce_robots.ros2.bus_file import ros_name
from tipforce_robots.ros2.cdr import CONTACT, DIAGNOSTICS, EMPTY, FINGERTIP, WRENCH
from tipforce_robots.ros2.messages import TipMessages

if TYPE_CHECKING:
    from tipforce.host.hand.events import Event
    from tipforce.watching.feeds import Feed
    from tipforce.watching.watcher import Finger
    from tipforce_robots.ros2.dds import RosDomain

PERIOD_NS = 1_000_000_000
_TAKE_S = 0.02


class Tip:
    """The topics of one fingertip."""

    def __init__(self, domain: RosDomain, prefix: str, finger: Finger, gauges: int, allow_tare: bool) -> None:
        self.node_id = finger.node_id
        self.name = ros_name(finger.name, finger.node_id)
        frame_id, topic = f"{self.name}_tip", f"{prefix}/{self.name}"
        self.messages = TipMessages(frame_id, finger.node_id, finger.geometry.r_m)
        self.diagnostics = diagnosing.TipDiagnostics(f"{prefix.strip('/') or 'tipforce'}: {self.name}", finger.node_id)
        self._wrench = domain.publisher(f"{topic}/wrench", WRENCH, "sensor data")
        self._contact = domain.publisher(f"{topic}/contact", CONTACT, "sensor data")
        self._info = domain.publisher(f"{topic}/info", FINGERTIP, "static")
        self.tares = domain.subscription(f"{topic}/tare", EMPTY) if allow_tare else None
        self._about = {
            "name": finger.label, "node_id": finger.node_id, "gauges": gauges, "tip_radius": finger.geometry.r_m,
        }  # fmt: skip
        self._frame_id = frame_id
        self.wrenches = 0

    def introduce(self, t_ns: int) -> None:
        """Publish the message that late subscribers receive, too."""
        header = {"stamp": cdr.stamp(t_ns), "frame_id": self._frame_id}
        self._info.publish(cdr.encode(FINGERTIP, {"header": header, **self._about}), t_ns)

    def publish(self, samples: Block, numbers: npt.NDArray[np.int64]) -> None:
        """Publish a contact for each sample, with its number (k,), and a wrench where the force is known."""
        self.diagnostics.add(samples)
        for message, t_ns in zip(self.messages.contacts(samples, numbers), samples.t_ns.tolist(), strict=True):
            self._contact.publish(message, t_ns)
        known_ns, messages = self.messages.wrenches(samples)
        self.wrenches += len(messages)
        for message, t_ns in zip(messages, known_ns.tolist(), strict=True):
            self._wrench.publish(message, t_ns)


class Bridge:
    """Publishes what a feed delivers."""

    def __init__(self, feed: Feed, domain: RosDomain, prefix: str, allow_tare: bool) -> None:
        self._feed, self._domain, self._prefix, self._allow_tare = feed, domain, prefix, allow_tare
        self._diagnostics = domain.publisher("/diagnostics", DIAGNOSTICS, "events")
        self._due_ns = 0
        self._period_rows = self._overrun = 0
        self.rows = 0
        self.tips: dict[int, Tip] = {}

    @property
    def wrenches(self) -> int:
        """Number of wrenches published."""
        return sum(tip.wrenches for tip in self.tips.values())

    def step(self) -> list[dict[str, Any]]:
        """Publish what has arrived; return the DiagnosticStatus of each event. Raises InputError for equal names."""
        blocks, events = self._feed.take(_TAKE_S)
        now_ns = self._feed.now_ns()
        for finger in self._feed.fingers:
            if finger.node_id not in self.tips:
                self._add(finger, now_ns)
        for block in blocks:
            self._publish(block)
        asked = [tip for tip in self.tips.values() if tip.tares is not None and tip.tares.take()]
        status = [self._of_event(event) for event in events] + [self._tare(tip) for tip in asked]
        if status:
            self._send(now_ns, status)
        if now_ns >= self._due_ns or now_ns < self._due_ns - PERIOD_NS:
            self.report(now_ns)
        return status

    def _add(self, finger: Finger, now_ns: int) -> None:
        tip = Tip(self._domain, self._prefix, finger, self._feed.gauges, self._allow_tare)
        for other in self.tips.values():
            if other.name == tip.name:
                raise InputError(f"fingers {other.node_id} and {tip.node_id}: both are {tip.name} in ROS 2; rename one")
        self.tips[finger.node_id] = tip
        tip.introduce(now_ns)

    def report(self, now_ns: int) -> None:
        """Publish the state of the hand, and begin the next period."""
        if self._due_ns:
            tips = [tip.diagnostics.status(self._feed.state(tip.node_id)) for tip in self.tips.values()]
            self._send(now_ns, [self._bus(), *tips])
        self._due_ns = now_ns + PERIOD_NS
        self._period_rows = 0

    def _publish(self, block: Block) -> None:
        numbers = self.rows + np.arange(len(block))
        self.rows += len(block)
        self._period_rows += len(block)
        strains = block.gauges.astype(np.float64)
        sent = np.asarray(np.isfinite(strains).any(axis=(0, 2)))
        for k, finger in enumerate(self._feed.fingers):
            microstrain = strains[:, k] if sent[k] else strains[:, k, :0]
            contact, u = block.contact[:, k].astype(np.float64), block.u[:, k].astype(np.float64)
            self.tips[finger.node_id].publish(Block(block.t_ns, contact, u, microstrain, block.status[:, k]), numbers)

    def _tare(self, tip: Tip) -> dict[str, Any]:
        try:
            level, message = diagnosing.OK, f"tared: {self._feed.tare(tip.node_id)}"
        except TipforceError as error:
            level, message = diagnosing.ERROR, f"not tared: {error}"
        return tip.diagnostics.of(level, message, {"event": "tare"})

    def _bus(self) -> dict[str, Any]:
        lost, self._overrun = self._feed.overrun - self._overrun, self._feed.overrun
        level, message = (diagnosing.OK, "SYNC") if self._period_rows else (diagnosing.ERROR, "no SYNC, no rows")
        if lost:
            level, message = max(level, diagnosing.WARN), f"{message}; {lost} batches lost: this process is too slow"
        return self._named("bus", level, message, {"rows": self._period_rows})

    def _of_event(self, event: Event) -> dict[str, Any]:
        level, message = diagnosing.level_of(event.kind), f"{event.kind.replace('_', ' ')}: {event.text}"
        values = {"event": event.kind, "code": f"{event.code:04X}h" if event.kind == "emcy" else ""}
        if event.node_id in self.tips:
            return self.tips[event.node_id].diagnostics.of(level, message, values)
        return self._named(f"node {event.node_id}" if event.node_id else "bus", level, message, values)

    def _named(self, name: str, level: int, message: str, values: dict[str, Any]) -> dict[str, Any]:
        return diagnosing.diagnostic(f"{self._prefix.strip('/') or 'tipforce'}: {name}", "", level, message, values)

    def _send(self, now_ns: int, status: list[dict[str, Any]]) -> None:
        self._diagnostics.publish(diagnosing.array(now_ns, status), now_ns)
