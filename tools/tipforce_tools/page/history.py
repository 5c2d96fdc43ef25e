"""The last minutes, or a whole log: rows in a buffer of bounded size, and envelopes of any part of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from tipforce.samples.columns import Block
from tipforce.samples.reasons import NO_ANSWER
from tipforce.sensor.contact.scalar import FRONT_END_FAULT, SATURATED

MAX_BYTES = 96 << 20
MAX_ROWS = 600_000
QUANTITIES = 3
Charted = Literal["contact", "forces", "gauges"]


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """b bins of k fingers, without empty ones: minimum, maximum and number of unknown rows of q quantities.

    They are P, phi, theta; or F1, F2, F3; or the strain of each gauge.
    """

    index: npt.NDArray[np.int64]
    """(b,) number of each bin: its time is index x width."""
    low: npt.NDArray[np.float32]
    """(b, k, q) minimum; NaN where none was known."""
    high: npt.NDArray[np.float32]
    u: npt.NDArray[np.float32]
    """(b, k, q) largest standard uncertainty; NaN where none was known, and of forces and gauges."""
    unknown: npt.NDArray[np.int64]
    """(b, k) rows in which the first quantity was unknown or the finger missing."""


def row_bytes(fingers: int, gauges: int) -> int:
    """Bytes of one row."""
    return 8 + fingers * (4 * (2 * QUANTITIES + gauges) + 2)


class History:
    """Rows in the order of time. Not thread-safe: the model has the lock.

    Beyond ``capacity`` the oldest rows are dropped. A time that steps backwards (a set clock) continues from the last.
    """

    def __init__(self, fingers: int, gauges: int, capacity: int = 0) -> None:
        fits = MAX_BYTES // (2 * row_bytes(fingers, gauges))
        self.capacity = capacity or max(min(MAX_ROWS, fits), 1000)
        self.dropped = 0
        self._shift_ns = 0
        self._start = self._end = 0
        # Twice the capacity, so that the rows kept are always one slice.
        self._kept = Block.zeros(2 * self.capacity, fingers, gauges)

    def __len__(self) -> int:
        return self._end - self._start

    @property
    def rows(self) -> Block:
        """Return all rows as views: copy data that must outlive the next append."""
        return self.part(0, len(self))

    @property
    def t_ns(self) -> npt.NDArray[np.int64]:
        """(m,) rising."""
        return self._kept.t_ns[self._start : self._end]

    def part(self, first: int, last: int) -> Block:
        """Return rows first to last (exclusive) as views."""
        return self._kept.part(slice(self._start + first, self._start + last))

    def append(self, block: Block) -> None:
        """Add rows, the newest last."""
        for first in range(0, len(block), self.capacity):
            self._append(block.part(slice(first, first + self.capacity)))

    def _append(self, block: Block) -> None:
        m = len(block)
        if self._end + m > len(self._kept):
            keep = min(len(self), self.capacity)
            for array in self._kept.columns:
                array[:keep] = array[self._end - keep : self._end].copy()
            self._start, self._end = 0, keep
        place = slice(self._end, self._end + m)
        t_ns = np.maximum.accumulate(block.t_ns + self._shift_ns)
        if len(self) and t_ns[0] < self.t_ns[-1]:
            back = int(self.t_ns[-1] - t_ns[0])
            self._shift_ns += back
            t_ns = t_ns + back
        for ours, theirs in zip(self._kept.columns, (t_ns, *block.columns[1:]), strict=True):
            ours[place] = theirs
        self._end += m
        over = len(self) - self.capacity
        if over > 0:
            self._start += over
            self.dropped += over

    def widened(self, columns: npt.NDArray[np.intp], fingers: int) -> History:
        """Return the rows for more fingers: ``columns`` (k,) maps the present ones; the new ones are missing."""
        gauges = self._kept.gauges.shape[-1]
        wider = History(fingers, gauges)
        rows = self.part(max(0, len(self) - wider.capacity), len(self))
        new = Block.zeros(len(rows), fingers, gauges)
        new.t_ns[:] = rows.t_ns
        for ours, theirs in zip(new.columns[1:], rows.columns[1:], strict=True):
            ours[:] = NO_ANSWER if ours is new.status else np.nan
            ours[:, columns] = theirs
        wider.append(new)
        return wider

    def envelope(self, first_bin: int, last_bin: int, width_ns: int, what: Charted = "contact") -> Envelope:
        """Return bins first to last (inclusive) of ``width_ns``: they keep extremes and gaps at any width."""
        first, last = np.searchsorted(self.t_ns, (first_bin * width_ns, (last_bin + 1) * width_ns))
        rows = self.part(int(first), int(last))
        number = rows.t_ns // width_ns
        starts = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
        values = rows.gauges if what == "gauges" else forces(rows.contact) if what == "forces" else rows.contact
        u = rows.u if what == "contact" else np.full_like(values, np.nan)
        unknown = np.isnan(values[..., 0]) | (rows.status & NO_ANSWER != 0)
        if not len(starts):
            empty = values[:0]
            return Envelope(number, empty, empty, empty, np.zeros(unknown.shape, dtype=np.int64))
        low, high = (reduce.reduceat(values, starts, axis=0) for reduce in (np.fmin, np.fmax))
        largest_u = np.fmax.reduceat(u, starts, axis=0)
        return Envelope(number[starts], low, high, largest_u, np.add.reduceat(unknown.astype(np.int64), starts, axis=0))

    def largest(self) -> tuple[float, float]:
        """Return the largest P in newtons and the largest strain in microstrain, without sign; 0 if none is known.

        The strain of a finger with a saturated gauge or a fault is that of the converter's limit: it does not count.
        """
        rows = self.rows
        sound = (rows.status & (SATURATED | FRONT_END_FAULT) == 0)[..., np.newaxis]
        lowest, highest = (
            float(reduce(rows.gauges, axis=None, initial=0.0, where=sound))
            for reduce in (np.fmin.reduce, np.fmax.reduce)
        )
        return float(np.fmax.reduce(rows.contact[..., 0], axis=None, initial=0.0)), max(highest, -lowest)


def forces(contact: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return F1 = P sin(phi), F2 = P sin(phi - theta), F3 = P cos(phi) of (..., 3) P, phi, theta in degrees."""
    P, phi, theta = (contact[..., k] for k in range(QUANTITIES))
    return np.stack([P * np.sin(np.radians(phi)), P * np.sin(np.radians(phi - theta)), P * np.cos(np.radians(phi))], -1)
