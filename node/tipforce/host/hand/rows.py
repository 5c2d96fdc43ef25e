"""Rows of a hand: one row for each SYNC, with every finger's answer to it, and counts of the faults."""

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
    unit, NaN if the node marks them unknown or the finger is missing; flags as bool, False if missing.
    """

    first: int
    """Number of the first row since the start of the collector."""
    sync_ns: npt.NDArray[np.int64]
    """(m,) receive time of each SYNC."""
    counter: npt.NDArray[np.int64]
    """(m, k) sample counter 0..255, -1 where missing."""
    columns: dict[str, npt.NDArray[Any]]

    @property
    def missing(self) -> BoolArray:
        """(m, k) no complete answer of this finger."""
        return self.counter < 0

    def __len__(self) -> int:
        return len(self.sync_ns)


@dataclass(slots=True)
class Tally:
    """Counts since the start of the collector; arrays have one element per finger."""

    node_ids: tuple[int, ...]
    rows: int = 0
    missing: npt.NDArray[np.int64] = field(init=False)
    """Rows without a complete answer."""
    delayed: npt.NDArray[np.int64] = field(init=False)
    """Answers that arrived after the next SYNC, and were assigned to their own row."""
    late: npt.NDArray[np.int64] = field(init=False)
    """Answers that arrived after their row was emitted, or that another one in their row replaced."""
    mixed: npt.NDArray[np.int64] = field(init=False)
    """Rows whose PDOs are from two samples."""
    repeated: npt.NDArray[np.int64] = field(init=False)
    """Rows with the counter of the previous row, marked stale: the SYNC is faster than the node's converter."""
    doubtful: npt.NDArray[np.int64] = field(init=False)
    """Answers discarded because by their counter they may be old."""

    def __post_init__(self) -> None:
        zeros = np.zeros((6, len(self.node_ids)), dtype=np.int64)
        self.missing, self.delayed, self.late, self.mixed, self.repeated, self.doubtful = zeros
