"""Modulus of the sample counter (2121h) by the SYNCs of a log: numbers 1 to 1019h, or samples counted modulo 256."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tipforce.device.codes import SYNC_COB_ID
from tipforce.host.frames.frame_array import FrameArray

SAMPLES = 256
"""Modulus without numbers."""

_LARGEST_NUMBER = 240


class SyncModulus:
    """Follow the SYNCs of each channel. ``of`` has the modulus by channel number; SAMPLES for one that it lacks."""

    def __init__(self) -> None:
        self.of: dict[int, int] = {}
        self._largest: dict[int, int] = {}  # number since the count was seen to begin again
        self._last: dict[int, int] = {}

    @property
    def modulus(self) -> int:
        """That of frames from one channel."""
        return next(iter(self.of.values()), SAMPLES)

    def parts(self, frames: FrameArray) -> Iterator[FrameArray]:
        """Split frames (k,) at ``cuts``; ``of`` holds for the part just yielded."""
        start = 0
        for end in [*self.cuts(frames), len(frames)]:
            self.look(frames[start:end])
            yield frames[start:end]
            start = end

    def cuts(self, frames: FrameArray) -> list[int]:
        """Return the indices of the SYNCs at which numbers begin or end."""
        at = np.flatnonzero(frames["can_id"] == SYNC_COB_ID)
        found: list[int] = []
        for channel in np.unique(frames["channel"][at]).tolist():
            mine = at[frames["channel"][at] == channel]
            numbered = (frames["length"][mine] == 1).astype(np.int8)
            before = np.int8(self.of.get(channel, SAMPLES) != SAMPLES)
            found += mine[np.diff(numbered, prepend=before) != 0].tolist()
        return sorted(found)

    def look(self, frames: FrameArray) -> None:
        """Take the numbers of SYNCs without a cut among them."""
        syncs = frames[frames["can_id"] == SYNC_COB_ID]
        for channel in np.unique(syncs["channel"]).tolist():
            mine = syncs[syncs["channel"] == channel]
            if mine["length"][-1] != 1:
                self.of[channel] = SAMPLES
                self._largest.pop(channel, None)
                self._last.pop(channel, None)
                continue
            number = mine["data"][:, 0].astype(np.int64)
            wraps = (np.diff(number, prepend=self._last.get(channel, number[0])) < 0).any()
            largest = max(self._largest.get(channel, 0), int(number.max()))
            self._largest[channel], self._last[channel] = largest, int(number[-1])
            if wraps or largest > self.of.get(channel, 0) or self.of[channel] == SAMPLES:
                self.of[channel] = max(largest, 2) if wraps else _LARGEST_NUMBER
