"""Counts per message while frames become rows; the counts of the parts of a recording add up to those of the whole."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.decoder import Samples, lost_samples
from tipforce.host.decoding.sync_modulus import SAMPLES

Place = tuple[str, int, str]
"""Channel, node-id, message name."""
TallyRow = tuple[str, int, str, int, int | None, int | None, int | None, int, int]
"""A place and the fields of its MessageCount."""


@dataclass(slots=True)
class MessageCount:
    """Frames of one message, and the samples lost between them (None: its PDO does not follow SYNC)."""

    frames: int = 0
    lost: int | None = None
    first: int | None = None
    last: int | None = None
    moduli: tuple[int, int] = (SAMPLES, SAMPLES)
    """Of the first and of the last counter."""

    def add(self, frames: int, counter: npt.NDArray[np.uint8] | None, modulus: int) -> None:
        """Count frames with their counters, of ``modulus``; None if their counter cannot show losses."""
        self.frames += frames
        if counter is not None and modulus != SAMPLES:
            counter = counter[counter > 0]  # 0 is no SYNC's latch, see lost_samples
        if counter is None or not len(counter):
            return
        inside = 0 if (np.diff(counter) == 1).all() else lost_samples(counter, modulus)
        self._join(int(counter[0]), int(counter[-1]), inside, (modulus, modulus))

    def append(self, other: MessageCount) -> None:
        """Add the count of the next part."""
        self.frames += other.frames
        if other.first is None:
            return
        assert other.last is not None
        self._join(other.first, other.last, other.lost or 0, other.moduli)

    def _join(self, first: int, last: int, lost: int, moduli: tuple[int, int]) -> None:
        """Add counters from ``first`` to ``last``; where the modulus is another one the count begins again."""
        if self.last is not None and self.moduli[1] == moduli[0]:
            lost += lost_samples([self.last, first], moduli[0])
        self.lost = (self.lost or 0) + lost
        self.moduli = (moduli[0] if self.first is None else self.moduli[0]), moduli[1]
        self.first = first if self.first is None else self.first
        self.last = last


@dataclass(slots=True)
class Tally:
    """``messages`` by place; ``short`` frames that were shorter than their mapping."""

    messages: dict[Place, MessageCount] = field(default_factory=dict)
    short: dict[Place, int] = field(default_factory=dict)

    def add(
        self, channel: str, samples: Samples, kept: npt.NDArray[np.bool_] | slice, cyclic: bool, modulus: int
    ) -> None:
        """Count the ``kept`` of some samples."""
        place = channel, samples.node_id, samples.message.name
        count = self.messages.setdefault(place, MessageCount())
        rows = samples.row[kept]
        count.add(len(rows), samples.columns["counter"][kept] if cyclic else None, modulus)

    def append(self, other: Tally) -> None:
        """Add the counts of the next part."""
        for place, count in other.messages.items():
            self.messages.setdefault(place, MessageCount()).append(count)
        for place, frames in other.short.items():
            self.short[place] = self.short.get(place, 0) + frames

    def rows(self) -> tuple[list[TallyRow], list[tuple[str, int, str, int]]]:
        """Return both counts as rows."""
        rows = [
            (*place, count.frames, count.lost, count.first, count.last, *count.moduli)
            for place, count in self.messages.items()
        ]
        return rows, [(*place, frames) for place, frames in self.short.items()]

    def set_rows(self, messages: Iterable[TallyRow], short: Iterable[tuple[str, int, str, int]]) -> None:
        """Set both counts from ``rows``."""
        for channel, node, name, frames, lost, first, last, *moduli in messages:
            self.messages[channel, node, name] = MessageCount(frames, lost, first, last, (moduli[0], moduli[1]))
        self.short |= {(channel, node, name): frames for channel, node, name, frames in short}

    def lost(self) -> dict[tuple[str, int], int]:
        """Return lost samples by channel and node: the maximum over its messages, which have one counter."""
        found: dict[tuple[str, int], int] = {}
        for (channel, node, _), count in self.messages.items():
            if count.lost is not None:
                found[channel, node] = max(found.get((channel, node), 0), count.lost)
        return found
