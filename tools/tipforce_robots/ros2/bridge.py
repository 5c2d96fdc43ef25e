"""Samples of a fingertip as ROS 2 messages, the state of the hand as diagnostics, the bridge from a feed, and bus.yml.

The frame ``<finger>_tip`` is at the centre of the tip: x along F3, y along F1 (docs/mechanics.md), right-handed. The
force is P (cos phi, sin phi, 0), the torque r P sin(phi - theta) = r F2 around z."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError, TipforceError
from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.samples.reasons import Status
from tipforce_robots.ros2 import cdr

if TYPE_CHECKING:
    from tipforce.host.decoding.services import BusEvent
    from tipforce.host.hand.events import Event
    from tipforce.host.hand.file import HandFile
    from tipforce.output_file import Kind
    from tipforce.watching.feeds import Feed, Finger
    from tipforce_robots.ros2.dds import RosDomain

PERIOD_NS = 1_000_000_000
_TAKE_S = 0.02
OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

_LEVELS = {
    "emcy": ERROR, "heartbeat_lost": ERROR, "failed": ERROR, "bus_down": ERROR, "refused": ERROR, "babbling": ERROR,
    "callback_failed": ERROR, "duplicate": ERROR, "boot_up": WARN, "changed": WARN, "accepted": WARN, "restored": WARN,
}  # fmt: skip


class Tip:
    """One fingertip: its samples as messages, and what those of a period say as diagnostics of ``name``."""

    def __init__(self, name: str, node_id: int, frame_id: str, tip_radius_m: float) -> None:
        self.name, self.node_id, self.hardware_id = name, node_id, f"node {node_id}"
        self.wrenches = 0
        """Messages so far."""
        self._radius_m = tip_radius_m
        torque = {"wrench.force.z": 0.0, "wrench.torque.x": 0.0, "wrench.torque.y": 0.0}
        self._wrench = cdr.Layout(cdr.WRENCH, {"header.frame_id": frame_id, **torque})
        constants = {"header.frame_id": frame_id, "node_id": node_id}
        self._contact = cache(lambda gauges: cdr.Layout(cdr.CONTACT, constants, {"microstrain": gauges}))
        self._begin_period()

    def _begin_period(self) -> None:
        self._counts = {"samples": 0, "without force": 0, "wrenches": 0}
        self._unknown = self._doubtful = 0
        self._last: Block | None = None

    def messages(self, samples: Block, numbers: npt.NDArray[np.int64]) -> Iterator[tuple[str, int, bytes]]:
        """Yield kind, stamp and content of the messages of this period's samples: contacts first, then wrenches.
        ``numbers`` (k,) of the samples, -1 for none. There is a wrench where P, phi and theta are all known."""
        if not len(samples):
            return
        known = np.flatnonzero(np.isfinite(samples.contact).all(axis=1))
        self._judge(samples, len(known))
        rows = self._wrench.rows(len(known))
        P, (phi, theta) = samples.contact[known, 0], np.radians(samples.contact[known, 1:]).T
        cdr.set_stamps(rows, samples.t_ns[known])
        rows["wrench.force.x"], rows["wrench.force.y"] = P * np.cos(phi), P * np.sin(phi)
        rows["wrench.torque.z"] = self._radius_m * P * np.sin(phi - theta)
        contacts = self._contact(samples.gauges.shape[1]).rows(len(samples))
        cdr.set_stamps(contacts, samples.t_ns)
        contacts["number"], contacts["status"], contacts["microstrain"] = numbers, samples.status, samples.gauges
        for values, suffix in ((samples.contact, ""), (samples.u, "_uncertainty")):
            contacts["force" + suffix] = values[:, 0]
            contacts["direction" + suffix], contacts["angle" + suffix] = np.radians(values[:, 1:]).T
        for t_ns, message in zip(samples.t_ns.tolist(), cdr.split(contacts), strict=True):
            yield cdr.CONTACT, t_ns, message
        for t_ns, message in zip(samples.t_ns[known].tolist(), cdr.split(rows), strict=True):
            yield cdr.WRENCH, t_ns, message

    def _judge(self, samples: Block, wrenches: int) -> None:
        known = np.isfinite(samples.contact[:, 0])
        counts = self._counts
        counts["samples"] += int(np.count_nonzero(samples.status & np.uint16(Status.NO_ANSWER) == 0))
        counts["without force"] += int(np.count_nonzero(~known))
        counts["wrenches"] += wrenches
        self.wrenches += wrenches
        unknown = samples.status[~known]
        self._unknown |= int(np.bitwise_or.reduce(unknown, initial=0))
        if not (unknown & np.uint16(Status.CALIBRATED)).all():  # a bit that should be set and is not
            self._unknown &= ~int(Status.CALIBRATED)
        self._doubtful |= int(np.bitwise_or.reduce(samples.status[known], initial=0))
        self._last = samples

    def status(self, state: str) -> dict[str, Any]:
        """Return the DiagnosticStatus of the period and begin the next one; ``state`` is the NMT state, if known."""
        values, last, without = {"NMT state": state, **self._counts}, self._last, self._counts["without force"]
        if last is None:
            level, message = STALE, "no sample"
        else:
            values["force, N"] = f"{last.contact[-1, 0]:.3f}"
            values["status"] = f"{int(last.status[-1]):04X}h"
            if without:
                why = reasons.why(self._unknown, force_known=False, angles_known=False)
                level, message = ERROR, f"{why} ({without} of {max(self._counts['samples'], without)} samples)"
            elif doubts := reasons.doubts(self._doubtful):
                level, message = WARN, ", ".join(doubts)
            else:
                level, message = OK, "contact" if int(last.status[-1]) & Status.CONTACT else "no contact"
        self._begin_period()
        return diagnostic(self.name, self.hardware_id, level, message, values)


def diagnostic(name: str, hardware_id: str, level: int, message: str, values: Mapping[str, object]) -> dict[str, Any]:
    """Return a DiagnosticStatus; empty values are left out."""
    pairs = [{"key": key, "value": str(value)} for key, value in values.items() if value != ""]
    return {"level": level, "name": name, "message": message, "hardware_id": hardware_id, "values": pairs}


def of_event(name: str, hardware_id: str, event: Event | BusEvent, **values: str) -> dict[str, Any]:
    """Return the DiagnosticStatus of an event of a hand or a log."""
    message = f"{event.kind.replace('_', ' ')}: {event.text}"
    return diagnostic(name, hardware_id, _LEVELS.get(event.kind, OK), message, {"event": event.kind, **values})


def array(t_ns: int, status: list[dict[str, Any]]) -> bytes:
    """Serialise a DiagnosticArray."""
    return cdr.encode(cdr.DIAGNOSTICS, {"header": {"stamp": cdr.stamp(t_ns), "frame_id": ""}, "status": status})


def ros_name(name: str, node_id: int) -> str:
    """Return a name that ROS 2 takes for a node: letters, digits and underscores, a letter first."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return plain if plain[:1].isalpha() else f"finger_{node_id}{'_' if plain else ''}{plain}"


class PublishedTip(Tip):
    """The topics of one fingertip; its info, which late subscribers receive too, is published at once."""

    def __init__(self, domain: RosDomain, prefix: str, finger: Finger, gauges: int, t_ns: int) -> None:
        self.ros_name = ros_name(finger.name, finger.node_id)
        frame_id, topic, r_m = f"{self.ros_name}_tip", f"{prefix}/{self.ros_name}", finger.geometry.r_m
        super().__init__(diagnostics_name(prefix, self.ros_name), finger.node_id, frame_id, r_m)
        kinds = ((cdr.CONTACT, "contact"), (cdr.WRENCH, "wrench"))
        self.publishers = {kind: domain.publisher(f"{topic}/{name}", kind, "sensor data") for kind, name in kinds}
        about = {"name": finger.label, "node_id": finger.node_id, "gauges": gauges, "tip_radius": r_m}
        info = {"header": {"stamp": cdr.stamp(t_ns), "frame_id": frame_id}, **about}
        self._info = domain.publisher(f"{topic}/info", cdr.FINGERTIP, "static")
        self._info.publish(cdr.encode(cdr.FINGERTIP, info), t_ns)

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
        self._diagnostics = domain.publisher("/diagnostics", cdr.DIAGNOSTICS, "events")
        self._due_ns = 0
        self._period_rows = self._overrun = 0
        self.rows = 0
        self.tips: dict[int, PublishedTip] = {}
        self._tares: list[tuple[PublishedTip, Callable[[], int]]] = []

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
        status += [self._tare(tip) for tip, asked in self._tares if asked()]
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
            self._tares.append((tip, self._domain.subscription(f"{self._prefix}/{name}/tare", cdr.EMPTY)))

    def report(self, now_ns: int) -> None:
        """Publish the state of the hand, and begin the next period."""
        if self._due_ns:
            tips = [tip.status(self._feed.state(tip.node_id)) for tip in self.tips.values()]
            lost, self._overrun = self._feed.overrun - self._overrun, self._feed.overrun
            level, message = (OK, "SYNC") if self._period_rows else (ERROR, "no SYNC, no rows")
            if lost:
                level, message = max(level, WARN), f"{message}; {lost} batches lost: this process is too slow"
            bus = diagnostic(diagnostics_name(self._prefix, "bus"), "", level, message, {"rows": self._period_rows})
            self._send(now_ns, [bus, *tips])
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
            level, message = OK, f"tared: {self._feed.tare(tip.node_id)}"
        except TipforceError as error:
            level, message = ERROR, f"not tared: {error}"
        return diagnostic(tip.name, tip.hardware_id, level, message, {"event": "tare"})

    def _of_event(self, event: Event) -> dict[str, Any]:
        tip = self.tips.get(event.node_id)
        name = tip.name if tip else diagnostics_name(self._prefix, f"node {event.node_id}" if event.node_id else "bus")
        code = f"{event.code:04X}h" if event.kind == "emcy" else ""
        return of_event(name, tip.hardware_id if tip else "", event, code=code)

    def _send(self, now_ns: int, status: list[dict[str, Any]]) -> None:
        self._diagnostics.publish(array(now_ns, status), now_ns)


_MASTER_NODE_ID = 127
_HEAD = """\
options:
  dcf_path: "@BUS_CONFIG_PATH@"

master:
  node_id: {master}
  driver: "ros2_canopen::MasterDriver"
  package: "canopen_master_driver"
  sync_period: {sync_us}
"""
_FINGER = """
{name}:
  node_id: {node_id}
  dcf: {eds}
  driver: "ros2_canopen::ProxyDriver"
  package: "canopen_proxy_driver"
  heartbeat_producer: {heartbeat_ms}
"""


def write_ros2_bus(hand: HandFile, folder: Path) -> list[Path]:
    """Write bus.yml (``sync_period`` in microseconds; 0: another device sends the SYNC) and an EDS for each number of
    gauges; return the paths. Raises as ``write_files``, and InputError for a finger with the node-id of the master."""
    from tipforce.dictionary.eds import eds_text, file_name, lely_dialect
    from tipforce.output_file import BUS_CONFIGURATION, EDS, write_files

    if _MASTER_NODE_ID in hand.node_ids:
        raise InputError(f"node-id {_MASTER_NODE_ID}: the master of the bus has it; give the finger another one")
    sync_hz = hand.hand.sync_hz
    text = _HEAD.format(master=_MASTER_NODE_ID, sync_us=round(1e6 / sync_hz) if sync_hz else 0)
    files: dict[str, tuple[str, Kind]] = {}
    for finger in hand.finger:
        eds = file_name(finger.gauges)
        files[eds] = lely_dialect(eds_text(finger.gauges)), EDS
        name, beat_ms = ros_name(finger.name, finger.node_id), hand.hand.heartbeat_ms
        text += _FINGER.format(name=name, node_id=finger.node_id, eds=json.dumps(eds), heartbeat_ms=beat_ms)
    return write_files(folder, files | {"bus.yml": (text, BUS_CONFIGURATION)})
