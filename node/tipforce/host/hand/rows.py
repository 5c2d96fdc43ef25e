"""Rows of a hand: one row for each SYNC, with every finger's answer to it, and counts of the faults."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]

PRESENT, NO_ANSWER, DOUBTFUL, MIXED, CHANGED = range(5)
"""Values of ``Rows.reason``."""

REASONS = ("", "no response", "two values for one SYNC", "PDOs of two samples", "changed by another, not verified")


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """m rows of k fingers, in the order of the SYNCs and of the hand's node-ids.

    ``columns`` has every signal of the PDOs that the hand reads, each (m, k): measurements as float64 in the signal's
    unit, NaN if the node marks them unknown or the finger is missing; flags as bool, False if missing.
    """

    first: int
    """Number of the first row since the start of the collector; 0 in a block without rows."""
    sync_ns: npt.NDArray[np.int64]
    """(m,) receive time of each SYNC; interpolated for one that was not received."""
    numbered: BoolArray
    """(m,) the SYNC carried a number, and each answer repeats it; False: the pairing is assumed from the order."""
    counter: npt.NDArray[np.int64]
    """(m, k) 2121h: the SYNC's number, or a sample counter 0..255; -1 where missing."""
    reason: npt.NDArray[np.uint8]
    """(m, k) why the finger is missing, as an index of REASONS; PRESENT where it is not."""
    columns: dict[str, npt.NDArray[Any]]

    @property
    def missing(self) -> BoolArray:
        """(m, k) no certain, complete answer of this finger."""
        missing: BoolArray = self.reason != PRESENT
        return missing

    def __len__(self) -> int:
        return len(self.sync_ns)


def joined(rows: list[Rows]) -> Rows:
    """Return consecutive blocks of rows as one."""
    if len(rows) == 1:
        return rows[0]

    def together(name: str) -> npt.NDArray[Any]:
        return np.concatenate([getattr(one, name) for one in rows])

    columns = {name: np.concatenate([one.columns[name] for one in rows]) for name in rows[0].columns}
    return Rows(
        rows[0].first, together("sync_ns"), together("numbered"), together("counter"), together("reason"), columns
    )


@dataclass(slots=True)
class Tally:
    """Counts since the start of the collector; arrays have one element per finger."""

    node_ids: tuple[int, ...]
    rows: int = 0
    unreceived: int = 0
    """SYNCs that were not received: their numbers were left out. Each has a row, up to a bound; see ``Collector``."""
    missing: npt.NDArray[np.int64] = field(init=False)
    """Rows without a certain, complete answer."""
    delayed: npt.NDArray[np.int64] = field(init=False)
    """Answers that arrived after the next SYNC, and were assigned to their own row by its number."""
    late: npt.NDArray[np.int64] = field(init=False)
    """Answers that arrived after their row was emitted."""
    mixed: npt.NDArray[np.int64] = field(init=False)
    """Rows whose PDOs are from two samples; not possible where rows are numbered."""
    repeated: npt.NDArray[np.int64] = field(init=False)
    """Rows whose sample the node marks stale: the SYNC is faster than its converter."""
    doubtful: npt.NDArray[np.int64] = field(init=False)
    """Values discarded because another one has the same number, or because their number is that of no SYNC."""
    changed: npt.NDArray[np.int64] = field(init=False)
    """Rows whose value is not shown, because its meaning was changed and not verified since."""

    def __post_init__(self) -> None:
        zeros = np.zeros((7, len(self.node_ids)), dtype=np.int64)
        self.missing, self.delayed, self.late, self.mixed, self.repeated, self.doubtful, self.changed = zeros
