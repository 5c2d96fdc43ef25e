"""Samples of one fingertip as messages: wrench and contact of each, and the state of the hand as diagnostics.

The frame ``<finger>_tip`` has its origin at the centre of the tip: x is the direction of F3 and y of F1 (docs/
mechanics.md), z is normal to the plane of the beams, right-handed. So the force is P (cos phi, sin phi, 0), and the
torque about the origin r P sin(phi - theta) = r F2, around z.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.samples.reasons import Status
from tipforce_robots.ros2 import cdr
from tipforce_robots.ros2.cdr import CONTACT, DIAGNOSTICS, WRENCH


def wrench_known(samples: Block) -> npt.NDArray[np.bool_]:
    """Return (k,) where P, phi and theta are all known."""
    return np.asarray(np.isfinite(samples.contact).all(axis=1))


class TipMessages:
    """Serialise the samples of one fingertip."""

    def __init__(self, frame_id: str, node_id: int, tip_radius_m: float) -> None:
        self._frame_id, self._node_id, self._radius_m = frame_id, node_id, tip_radius_m
        torque = {"wrench.force.z": 0.0, "wrench.torque.x": 0.0, "wrench.torque.y": 0.0}
        self._wrench = cdr.Layout(WRENCH, {"header.frame_id": frame_id, **torque})
        self._contact: dict[int, cdr.Layout] = {}

    def wrenches(self, samples: Block) -> tuple[npt.NDArray[np.int64], list[bytes]]:
        """Return the stamps (j,) and the messages of the samples whose force is known."""
        known = wrench_known(samples)
        t_ns = samples.t_ns[known]
        rows = self._wrench.rows(len(t_ns))
        P, (phi, theta) = samples.contact[known, 0], np.radians(samples.contact[known, 1:]).T
        cdr.set_stamps(rows, t_ns)
        rows["wrench.force.x"], rows["wrench.force.y"] = P * np.cos(phi), P * np.sin(phi)
        rows["wrench.torque.z"] = self._radius_m * P * np.sin(phi - theta)
        return t_ns, cdr.split(rows)

    def contacts(self, samples: Block, numbers: npt.NDArray[np.int64]) -> list[bytes]:
        """Return a message for each sample; ``numbers`` (k,) of the samples, -1 for none."""
        n = samples.gauges.shape[1]
        if n not in self._contact:
            constants = {"header.frame_id": self._frame_id, "node_id": self._node_id}
            self._contact[n] = cdr.Layout(CONTACT, constants, {"microstrain": n})
        rows = self._contact[n].rows(len(samples))
        cdr.set_stamps(rows, samples.t_ns)
        rows["number"], rows["status"], rows["microstrain"] = numbers, samples.status, samples.gauges
        for values, suffix in ((samples.contact, ""), (samples.u, "_uncertainty")):
            rows["force" + suffix] = values[:, 0]
            rows["direction" + suffix], rows["angle" + suffix] = np.radians(values[:, 1]), np.radians(values[:, 2])
        return cdr.split(rows)


OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

_LEVELS = {
    "emcy": ERROR, "heartbeat_lost": ERROR, "failed": ERROR, "bus_down": ERROR, "refused": ERROR, "babbling": ERROR,
    "callback_failed": ERROR, "duplicate": ERROR, "boot_up": WARN, "changed": WARN, "accepted": WARN, "restored": WARN,
}  # fmt: skip


class TipDiagnostics:
    """One fingertip: what its samples of a period say."""

    def __init__(self, name: str, node_id: int) -> None:
        self.name, self.hardware_id = name, f"node {node_id}"
        self._counts = {"samples": 0, "without force": 0, "wrenches": 0}
        self._unknown = self._doubtful = 0
        self._last: Block | None = None

    def add(self, samples: Block) -> None:
        """Add samples of this period."""
        if not len(samples):
            return
        known = np.isfinite(samples.contact[:, 0])
        counts = self._counts
        counts["samples"] += int(np.count_nonzero(samples.status & np.uint16(Status.NO_ANSWER) == 0))
        counts["without force"] += int(np.count_nonzero(~known))
        counts["wrenches"] += int(np.count_nonzero(wrench_known(samples)))
        self._unknown |= int(np.bitwise_or.reduce(samples.status[~known], initial=0))
        if not known.all():  # a bit that should be set and is not
            calibrated = samples.status[~known] & np.uint16(Status.CALIBRATED)
            self._unknown &= 0xFFFF if calibrated.all() else ~int(Status.CALIBRATED)
        self._doubtful |= int(np.bitwise_or.reduce(samples.status[known], initial=0))
        self._last = samples

    def status(self, state: str) -> dict[str, Any]:
        """Return the DiagnosticStatus of the period and begin the next one; ``state`` is the NMT state, if known."""
        counts, last = self._counts, self._last
        level, message = self._judged()
        values = {"NMT state": state, **counts}
        if last is not None:
            values["force, N"] = f"{last.contact[-1, 0]:.3f}"
            values["status"] = f"{int(last.status[-1]):04X}h"
        self._counts, self._last = dict.fromkeys(counts, 0), None
        self._unknown = self._doubtful = 0
        return self.of(level, message, values)

    def of(self, level: int, message: str, values: Mapping[str, object]) -> dict[str, Any]:
        """Return a DiagnosticStatus of this fingertip."""
        return diagnostic(self.name, self.hardware_id, level, message, values)

    def _judged(self) -> tuple[int, str]:
        counts = self._counts
        if self._last is None:
            return STALE, "no sample"
        if counts["without force"]:
            why = ", ".join(reasons.why_no_force(self._unknown)) or reasons.UNKNOWN_TO_THE_NODE
            rows = max(counts["samples"], counts["without force"])
            return ERROR, f"{why} ({counts['without force']} of {rows} samples)"
        doubts = reasons.doubts(self._doubtful)
        if doubts:
            return WARN, ", ".join(doubts)
        return OK, "contact" if int(self._last.status[-1]) & Status.CONTACT else "no contact"


def diagnostic(name: str, hardware_id: str, level: int, message: str, values: Mapping[str, object]) -> dict[str, Any]:
    """Return a DiagnosticStatus; empty values are left out."""
    pairs = [{"key": key, "value": str(value)} for key, value in values.items() if value != ""]
    return {"level": level, "name": name, "message": message, "hardware_id": hardware_id, "values": pairs}


def level_of(kind: str) -> int:
    """Return the level of an event of a hand or a log."""
    return _LEVELS.get(kind, OK)


def array(t_ns: int, status: list[dict[str, Any]]) -> bytes:
    """Serialise a DiagnosticArray."""
    return cdr.encode(DIAGNOSTICS, {"header": {"stamp": cdr.stamp(t_ns), "frame_id": ""}, "status": status})
