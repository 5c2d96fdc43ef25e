"""Detect babbling: an identifier that is received far more often than the SYNC.

Frames and time in, events out. SDO and LSS are excluded: their rate depends on the requests.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from tipforce.device import codes
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.events import Event

WINDOW_S = 0.2
TIMES_SYNC = 4.0
_BEYOND = codes.STANDARD_MASK + 1
_SDO_LAST = codes.SDO_REQUEST_BASE | codes.NODE_ID_MASK
_BEYOND_HEARTBEATS = codes.HEARTBEAT_BASE + codes.NODE_ID_MASK + 1  # LSS


class BabbleWatch:
    """Count every 11-bit identifier over WINDOW_S and compare with TIMES_SYNC times the rate of the SYNC.

    ``sync_hz`` 0: the rate of the received SYNCs is used.
    """

    def __init__(self, sync_hz: float) -> None:
        self._sync_hz = sync_hz
        self._ids: list[npt.NDArray[np.uint32]] = []
        self._since_s: float | None = None
        self._first_ns = self._last_ns = 0
        self._babbling: set[int] = set()

    def add(self, frames: FrameArray, now_s: float) -> list[Event]:
        """Process received frames, FRAME (n,), and the time; yield the starts and ends of babbling."""
        if self._since_s is None:
            self._since_s = now_s
        if len(frames):
            if not self._ids:
                self._first_ns = int(frames["t_ns"][0])
            self._last_ns = int(frames["t_ns"][-1])
            self._ids.append(frames["can_id"].copy())
        if now_s - self._since_s < WINDOW_S:
            return []
        # Frames that waited in the buffer are read together, but their time stamps differ.
        seconds = max(now_s - self._since_s, (self._last_ns - self._first_ns) * 1e-9)
        events = list(self._judge(seconds, now_s))
        self._ids, self._since_s, self._first_ns, self._last_ns = [], now_s, 0, 0
        return events

    def _judge(self, seconds: float, now_s: float) -> Iterator[Event]:
        ids = np.concatenate(self._ids) if self._ids else np.zeros(0, dtype=np.uint32)
        counts = np.bincount(np.minimum(ids, _BEYOND), minlength=_BEYOND + 1)[:_BEYOND]
        sync_hz = self._sync_hz or counts[codes.SYNC_COB_ID] / seconds
        counts[codes.SDO_RESPONSE_BASE : _SDO_LAST + 1] = counts[_BEYOND_HEARTBEATS:] = 0
        limit = TIMES_SYNC * sync_hz * seconds
        over = {int(n) for n in np.flatnonzero(counts > limit)} if sync_hz else set()
        # An end requires half the limit: an identifier near the limit would otherwise be reported repeatedly.
        over |= {n for n in self._babbling if counts[n] > limit / 2}
        for can_id in sorted(over - self._babbling):
            rate_hz = counts[can_id] / seconds
            yield Event(now_s, _node(can_id), "babbling", f"0x{can_id:03X} received {rate_hz:.0f} times/s", can_id)
        for can_id in sorted(self._babbling - over):
            yield Event(now_s, _node(can_id), "babbling_end", f"0x{can_id:03X} is below the limit again", can_id)
        self._babbling = over


def _node(can_id: int) -> int:
    """Return the node-id by the predefined connection set; 0 for an identifier of no node."""
    return can_id & codes.NODE_ID_MASK if can_id > codes.SYNC_COB_ID else 0
