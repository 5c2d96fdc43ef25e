"""Samples of one fingertip as messages: wrench and contact of each, and the state of the hand as diagnostics.

The frame ``<finger>_tip`` has its origin at the centre of the tip: x is the direction of F3 and y of F1 (docs/
mechanics.md), z is normal to the plane of the beams, right-handed. So the force is P (cos phi, sin phi, 0), and the
torque about the origin r P sin(phi - theta) = r F2, around z.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.samples.reasons import Status
from tipforce_robots.ros2 import cdr
from tipforce_robots.ros2.cdr import CONTACT, DIAGNOSTICS, WRENCH

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
        self._wrench = cdr.Layout(WRENCH, {"header.frame_id": frame_id, **torque})
        constants = {"header.frame_id": frame_id, "node_id": node_id}
        self._contact = cache(lambda gauges: cdr.Layout(CONTACT, constants, {"microstrain": gauges}))
        self._begin()

    def _begin(self) -> None:
        """Begin a period."""
        self._counts = {"samples": 0, "without force": 0, "wrenches": 0}
        self._unknown = self._doubtful = 0
        self._last: Block | None = None

    def messages(self, samples: Block, numbers: npt.NDArray[np.int64]) -> Iterator[tuple[str, int, bytes]]:
        """Yield kind, stamp and content of the messages of this period's samples: contacts first, then wrenches.

        ``numbers`` (k,) of the samples, -1 for none. There is a wrench where P, phi and theta are all known.
        """
        if not len(samples):
            return
        known = np.flatnonzero(np.isfinite(samples.contact).all(axis=1))
        self._judge(samples, len(known))
        for t_ns, message in zip(samples.t_ns.tolist(), self._contacts(samples, numbers), strict=True):
            yield CONTACT, t_ns, message
        for t_ns, message in zip(samples.t_ns[known].tolist(), self._wrenches(samples, known), strict=True):
            yield WRENCH, t_ns, message

    def _wrenches(self, samples: Block, known: npt.NDArray[np.intp]) -> list[bytes]:
        t_ns = samples.t_ns[known]
        rows = self._wrench.rows(len(t_ns))
        P, (phi, theta) = samples.contact[known, 0], np.radians(samples.contact[known, 1:]).T
        cdr.set_stamps(rows, t_ns)
        rows["wrench.force.x"], rows["wrench.force.y"] = P * np.cos(phi), P * np.sin(phi)
        rows["wrench.torque.z"] = self._radius_m * P * np.sin(phi - theta)
        return cdr.split(rows)

    def _contacts(self, samples: Block, numbers: npt.NDArray[np.int64]) -> list[bytes]:
        rows = self._contact(samples.gauges.shape[1]).rows(len(samples))
        cdr.set_stamps(rows, samples.t_ns)
        rows["number"], rows["status"], rows["microstrain"] = numbers, samples.status, samples.gauges
        for values, suffix in ((samples.contact, ""), (samples.u, "_uncertainty")):
            rows["force" + suffix] = values[:, 0]
            rows["direction" + suffix], rows["angle" + suffix] = np.radians(values[:, 1]), np.radians(values[:, 2])
        return cdr.split(rows)

    def _judge(self, samples: Block, wrenches: int) -> None:
        known = np.isfinite(samples.contact[:, 0])
        counts = self._counts
        counts["samples"] += int(np.count_nonzero(samples.status & np.uint16(Status.NO_ANSWER) == 0))
        counts["without force"] += int(np.count_nonzero(~known))
        counts["wrenches"] += wrenches
        self.wrenches += wrenches
        self._unknown |= int(np.bitwise_or.reduce(samples.status[~known], initial=0))
        if not known.all():  # a bit that should be set and is not
            calibrated = samples.status[~known] & np.uint16(Status.CALIBRATED)
            self._unknown &= 0xFFFF if calibrated.all() else ~int(Status.CALIBRATED)
        self._doubtful |= int(np.bitwise_or.reduce(samples.status[known], initial=0))
        self._last = samples

    def status(self, state: str) -> dict[str, Any]:
        """Return the DiagnosticStatus of the period and begin the next one; ``state`` is the NMT state, if known."""
        level, message = self._judged()
        values = {"NMT state": state, **self._counts}
        if self._last is not None:
            values["force, N"] = f"{self._last.contact[-1, 0]:.3f}"
            values["status"] = f"{int(self._last.status[-1]):04X}h"
        self._begin()
        return diagnostic(self.name, self.hardware_id, level, message, values)

    def _judged(self) -> tuple[int, str]:
        counts = self._counts
        if self._last is None:
            return STALE, "no sample"
        if counts["without force"]:
            why = reasons.why(self._unknown, force_known=False, angles_known=False)
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


def of_event(name: str, hardware_id: str, kind: str, text: str, **values: str) -> dict[str, Any]:
    """Return the DiagnosticStatus of an event of a hand or a log."""
    message = f"{kind.replace('_', ' ')}: {text}"
    return diagnostic(name, hardware_id, _LEVELS.get(kind, OK), message, {"event": kind, **values})


def array(t_ns: int, status: list[dict[str, Any]]) -> bytes:
    """Serialise a DiagnosticArray."""
    return cdr.encode(DIAGNOSTICS, {"header": {"stamp": cdr.stamp(t_ns), "frame_id": ""}, "status": status})
