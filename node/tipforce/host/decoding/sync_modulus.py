"""Modulus of the sample counter (2121h) by the SYNCs of a log: numbers 1 to 1019h, or samples counted modulo 256."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from canopen_device.core.codes import SYNC_COB_ID
from tipforce.arrays import occurring
from tipforce.host.frames.frame_array import FrameArray

SAMPLES = 256
"""Modulus without numbers."""

_LARGEST_NUMBER = 240
_NONE = -1


class SyncModulus:
    """Follow the SYNCs of each channel. ``of`` has the modulus by channel number; SAMPLES for one that it lacks."""

    def __init__(self, state: Iterable[tuple[int, int, int, int]] = ()) -> None:
        """``state`` as a property of that name returned it."""
        self.of: dict[int, int] = {}
        self._numbers: dict[int, tuple[int, int]] = {}  # the largest number since the numbers began, and the last
        for channel, modulus, largest, last in state:
            self.of[channel] = modulus
            if largest != _NONE:
                self._numbers[channel] = largest, last

    @property
    def state(self) -> list[tuple[int, int, int, int]]:
        """By channel: its number, the modulus, the largest and the last number, -1 for none."""
        return [(k, modulus, *self._numbers.get(k, (_NONE, _NONE))) for k, modulus in self.of.items()]

    @property
    def settled(self) -> bool:
        """Whether the numbers of each channel that has them were seen up to the largest one."""
        return all(self.of[k] == max(largest, 2) for k, (largest, _) in self._numbers.items())

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
        for channel in occurring(frames["channel"][at]):
            mine = at[frames["channel"][at] == channel]
            numbered = (frames["length"][mine] == 1).astype(np.int8)
            before = np.int8(self.of.get(channel, SAMPLES) != SAMPLES)
            found += mine[np.diff(numbered, prepend=before) != 0].tolist()
        return sorted(found)

    def look(self, frames: FrameArray) -> None:
        """Take the numbers of SYNCs without a cut among them; they are numbered if the last one is."""
        syncs = frames[frames["can_id"] == SYNC_COB_ID]
        for channel in occurring(syncs["channel"]):
            mine = syncs[syncs["channel"] == channel]
            if mine["length"][-1] != 1:
                self.of[channel] = SAMPLES
                self._numbers.pop(channel, None)
                continue
            number = mine["data"][:, 0].astype(np.int64)
            largest, last = self._numbers.get(channel, (0, int(number[0])))
            wraps = bool((np.diff(number, prepend=last) < 0).any())
            largest = max(largest, int(number.max()))
            self._numbers[channel] = largest, int(number[-1])
            if wraps or largest > self.of.get(channel, 0) or self.of[channel] == SAMPLES:
                self.of[channel] = max(largest, 2) if wraps else _LARGEST_NUMBER
