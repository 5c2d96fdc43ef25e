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
from tipforce_robots.ros2.messages import Tip

if TYPE_CHECKING:
    from tipforce.host.hand.events import Event
    from tipforce.watching.feeds import Feed
    from tipforce.watching.watcher import Finger
    from tipforce_robots.ros2.dds import RosDomain, RosSubscription

PERIOD_NS = 1_000_000_000
_TAKE_S = 0.02


class PublishedTip(Tip):
    """The topics of one fingertip; its info, which late subscribers receive too, is published at once."""

    def __init__(self, domain: RosDomain, prefix: str, finger: Finger, gauges: int, t_ns: int) -> None:
        self.ros_name = ros_name(finger.name, finger.node_id)
        frame_id, topic, r_m = f"{self.ros_name}_tip", f"{prefix}/{self.ros_name}", finger.geometry.r_m
        super().__init__(diagnostics_name(prefix, self.ros_name), finger.node_id, frame_id, r_m)
        kinds = {CONTACT: "contact", WRENCH: "wrench"}
        self.publishers = {
            kind: domain.publisher(f"{topic}/{name}", kind, "sensor data") for kind, name in kinds.items()
        }
        self._info = domain.publisher(f"{topic}/info", FINGERTIP, "static")
        about = {"name": finger.label, "node_id": finger.node_id, "gauges": gauges, "tip_radius": r_m}
        header = {"stamp": cdr.stamp(t_ns), "frame_id": frame_id}
        self._info.publish(cdr.encode(FINGERTIP, {"header": header, **about}), t_ns)

    def publish(self, samples: Block, numbers: npt.NDArray[np.int64]) -> None:
        """Publish a contact for each sample, with its number (k,), and a wrench where the force is known."""
        for kind, t_ns, message in self.messages(samples, numbers):
            self.publishers[kind].publish(message, t_ns)


def diagnostics_name(prefix: str, name: str) -> str:
    """Return the name of a DiagnosticStatus."""
    return f"{prefix.strip('/') or 'tipforce'}: {name}"


class Bridge:
    """Publishes what a feed delivers."""

    def __init__(self, feed: Feed, domain: RosDomain, prefix: str, allow_tare: bool) -> None:
        self._feed, self._domain, self._prefix, self._allow_tare = feed, domain, prefix, allow_tare
        self._diagnostics = domain.publisher("/diagnostics", DIAGNOSTICS, "events")
        self._due_ns = 0
        self._period_rows = self._overrun = 0
        self.rows = 0
        self.tips: dict[int, PublishedTip] = {}
        self._tares: list[tuple[PublishedTip, RosSubscription]] = []

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
        status = [self._of_event(event) for event in events]
        status += [self._tare(tip) for tip, asked in self._tares if asked.take()]
        if status:
            self._send(now_ns, status)
        if now_ns >= self._due_ns or now_ns < self._due_ns - PERIOD_NS:
            self.report(now_ns)
        return status

    def _add(self, finger: Finger, now_ns: int) -> None:
        name = ros_name(finger.name, finger.node_id)
        for other in self.tips.values():
            if other.ros_name == name:
                raise InputError(f"fingers {other.node_id} and {finger.node_id}: both are {name} in ROS 2; rename one")
        tip = PublishedTip(self._domain, self._prefix, finger, self._feed.gauges, now_ns)
        self.tips[finger.node_id] = tip
        if self._allow_tare:
            self._tares.append((tip, self._domain.subscription(f"{self._prefix}/{name}/tare", EMPTY)))

    def report(self, now_ns: int) -> None:
        """Publish the state of the hand, and begin the next period."""
        if self._due_ns:
            tips = [tip.status(self._feed.state(tip.node_id)) for tip in self.tips.values()]
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

    def _tare(self, tip: PublishedTip) -> dict[str, Any]:
        try:
            level, message = diagnosing.OK, f"tared: {self._feed.tare(tip.node_id)}"
        except TipforceError as error:
            level, message = diagnosing.ERROR, f"not tared: {error}"
        return diagnosing.diagnostic(tip.name, tip.hardware_id, level, message, {"event": "tare"})

    def _bus(self) -> dict[str, Any]:
        lost, self._overrun = self._feed.overrun - self._overrun, self._feed.overrun
        level, message = (diagnosing.OK, "SYNC") if self._period_rows else (diagnosing.ERROR, "no SYNC, no rows")
        if lost:
            level, message = max(level, diagnosing.WARN), f"{message}; {lost} batches lost: this process is too slow"
        name = diagnostics_name(self._prefix, "bus")
        return diagnosing.diagnostic(name, "", level, message, {"rows": self._period_rows})

    def _of_event(self, event: Event) -> dict[str, Any]:
        tip = self.tips.get(event.node_id)
        name = tip.name if tip else diagnostics_name(self._prefix, f"node {event.node_id}" if event.node_id else "bus")
        code = f"{event.code:04X}h" if event.kind == "emcy" else ""
        return diagnosing.of_event(name, tip.hardware_id if tip else "", event.kind, event.text, code=code)

    def _send(self, now_ns: int, status: list[dict[str, Any]]) -> None:
        self._diagnostics.publish(diagnosing.array(now_ns, status), now_ns)
