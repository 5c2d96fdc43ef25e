"""What a hand gives: one row for each SYNC, with what every finger answered to it, and a count of what went wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """m rows of k fingers, in the order of the SYNCs and of the hand's node-ids.

    ``columns`` has every signal of the PDOs that the hand reads, each (m, k): measurements as float64 in the signal's
    unit, NaN where the node marks them unknown or the finger is missing; flags as bool, False where missing.
    """

    first: int
    """Number of the first row since the collector began."""
    sync_ns: npt.NDArray[np.int64]
    """(m,) receive time of each SYNC."""
    counter: npt.NDArray[np.int64]
    """(m, k) sample counter 0..255, -1 where missing."""
    columns: dict[str, npt.NDArray[Any]]

    @property
    def missing(self) -> BoolArray:
        """(m, k) no whole answer of this finger."""
        return self.counter < 0

    def __len__(self) -> int:
        return len(self.sync_ns)


@dataclass(slots=True)
class Tally:
    """What was counted since the collector began; arrays have one element per finger."""

    node_ids: tuple[int, ...]
    rows: int = 0
    missing: npt.NDArray[np.int64] = field(init=False)
    """Rows without a whole answer."""
    delayed: npt.NDArray[np.int64] = field(init=False)
    """Answers that came after the next SYNC, and still into their own row."""
    late: npt.NDArray[np.int64] = field(init=False)
    """Answers that came after their row was given out, or that another one in their row replaced."""
    mixed: npt.NDArray[np.int64] = field(init=False)
    """Rows whose PDOs were of two samples."""
    repeated: npt.NDArray[np.int64] = field(init=False)
    """Rows with the counter of the row before, marked stale: the SYNC came faster than the node's converter."""
    doubtful: npt.NDArray[np.int64] = field(init=False)
    """Answers that were not shown because their counter says that they may be old."""

    def __post_init__(self) -> None:
        zeros = np.zeros((6, len(self.node_ids)), dtype=np.int64)
        self.missing, self.delayed, self.late, self.mixed, self.repeated, self.doubtful = zeros
