"""Modulus of the sample counter (2121h) by the SYNCs of a log: numbers 1 to 1019h, or samples counted modulo 256."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from canopen_device.core.codes import SYNC_COB_ID
from tipforce.arrays import occurring
from tipforce.host.frames.frame_array import FrameArray

SAMPLES = 256
"""Modulus without numbers."""

_LARGEST_NUMBER = 240


_NONE = -1


class Syncs(NamedTuple):
    """SYNCs of one channel that follow each other. Without numbers the others mean nothing."""

    channel: int
    numbered: bool
    first: int
    last: int
    largest: int
    wraps: bool
    """The numbers begin again among them."""


class SyncModulus:
    """Follow the SYNCs of each channel. ``of`` has the modulus by channel number; SAMPLES for one that it lacks."""

    def __init__(self, state: Iterable[tuple[int, int, int, int]] = ()) -> None:
        """``state`` as a property of that name returned it."""
        self.of: dict[int, int] = {}
        self._largest: dict[int, int] = {}  # number since the count was seen to begin again
        self._last: dict[int, int] = {}
        for channel, modulus, largest, last in state:
            self.of[channel] = modulus
            if largest != _NONE:
                self._largest[channel], self._last[channel] = largest, last

    @property
    def state(self) -> list[tuple[int, int, int, int]]:
        """By channel: its number, the modulus, the largest and the last number, -1 for none."""
        return [(k, modulus, self._largest.get(k, _NONE), self._last.get(k, _NONE)) for k, modulus in self.of.items()]

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

    def look(self, frames: FrameArray) -> list[Syncs]:
        """Take the numbers of SYNCs without a cut among them; return what was taken."""
        found = syncs_of(frames)
        for seen in found:
            self.take(seen)
        return found

    def take(self, seen: Syncs) -> None:
        """Take the numbers of some SYNCs."""
        channel = seen.channel
        if not seen.numbered:
            self.of[channel] = SAMPLES
            self._largest.pop(channel, None)
            self._last.pop(channel, None)
            return
        wraps = seen.wraps or seen.first < self._last.get(channel, seen.first)
        largest = max(self._largest.get(channel, 0), seen.largest)
        self._largest[channel], self._last[channel] = largest, seen.last
        if wraps or largest > self.of.get(channel, 0) or self.of[channel] == SAMPLES:
            self.of[channel] = max(largest, 2) if wraps else _LARGEST_NUMBER


def syncs_of(frames: FrameArray) -> list[Syncs]:
    """Return the SYNCs among frames (k,) by channel; they are numbered if the last one is."""
    syncs = frames[frames["can_id"] == SYNC_COB_ID]
    found = []
    for channel in occurring(syncs["channel"]):
        mine = syncs[syncs["channel"] == channel]
        if mine["length"][-1] != 1:
            found.append(Syncs(channel, False, 0, 0, 0, False))
            continue
        number = mine["data"][:, 0].astype(np.int64)
        wraps = bool((np.diff(number) < 0).any())
        found.append(Syncs(channel, True, int(number[0]), int(number[-1]), int(number.max()), wraps))
    return found
