"""The state of a hand as diagnostic_msgs: once a second, and at each event."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tipforce.host.decoding import status_words
from tipforce.host.decoding.contacts import Status
from tipforce_tools.ros2 import cdr
from tipforce_tools.ros2.definitions import DIAGNOSTICS
from tipforce_tools.ros2.messages import TipSamples

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
        self._last: TipSamples | None = None

    def add(self, samples: TipSamples) -> None:
        """Add samples of this period."""
        if not len(samples):
            return
        known = np.isfinite(samples.contact[:, 0])
        counts = self._counts
        counts["samples"] += int(np.count_nonzero(samples.status & np.uint16(Status.NO_ANSWER) == 0))
        counts["without force"] += int(np.count_nonzero(~known))
        counts["wrenches"] += int(np.count_nonzero(samples.known))
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
            why = ", ".join(status_words.why_no_force(self._unknown)) or status_words.UNKNOWN_TO_THE_NODE
            rows = max(counts["samples"], counts["without force"])
            return ERROR, f"{why} ({counts['without force']} of {rows} samples)"
        doubts = status_words.doubts(self._doubtful)
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
