"""Counts per message while frames become rows; the counts of the parts of a recording add up to those of the whole."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.decoder import Samples, lost_samples

Place = tuple[str, int, str]
"""Channel, node-id, message name."""


@dataclass(slots=True)
class MessageCount:
    """Frames of one message, and the samples lost between them (None: its PDO does not follow SYNC)."""

    frames: int = 0
    lost: int | None = None
    first: int | None = None
    last: int | None = None

    def add(self, frames: int, counter: npt.NDArray[np.uint8] | None) -> None:
        """Count frames with their counters; None if their counter cannot show losses."""
        self.frames += frames
        if counter is None or not len(counter):
            return
        inside = 0 if (np.diff(counter) == 1).all() else lost_samples(counter)
        between = 0 if self.last is None else lost_samples([self.last, int(counter[0])])
        self.lost = (self.lost or 0) + inside + between
        self.first = int(counter[0]) if self.first is None else self.first
        self.last = int(counter[-1])

    def append(self, other: MessageCount) -> None:
        """Add the count of the next part."""
        self.frames += other.frames
        if other.first is None:
            return
        between = 0 if self.last is None else lost_samples([self.last, other.first])
        self.lost = (self.lost or 0) + (other.lost or 0) + between
        self.first = other.first if self.first is None else self.first
        self.last = other.last


@dataclass(slots=True)
class Tally:
    """``messages`` by place; ``short`` frames that were shorter than their mapping."""

    messages: dict[Place, MessageCount] = field(default_factory=dict)
    short: dict[Place, int] = field(default_factory=dict)

    def add(self, channel: str, samples: Samples, kept: npt.NDArray[np.bool_] | slice, cyclic: bool) -> None:
        """Count the ``kept`` of some samples."""
        place = channel, samples.node_id, samples.message.name
        count = self.messages.setdefault(place, MessageCount())
        rows = samples.row[kept]
        count.add(len(rows), samples.columns["counter"][kept] if cyclic else None)

    def append(self, other: Tally) -> None:
        """Add the counts of the next part."""
        for place, count in other.messages.items():
            self.messages.setdefault(place, MessageCount()).append(count)
        for place, frames in other.short.items():
            self.short[place] = self.short.get(place, 0) + frames

    def lost(self) -> dict[tuple[str, int], int]:
        """Return lost samples by channel and node: the maximum over its messages, which have one counter."""
        found: dict[tuple[str, int], int] = {}
        for (channel, node, _), count in self.messages.items():
            if count.lost is not None:
                found[channel, node] = max(found.get((channel, node), 0), count.lost)
        return found
