"""The limits of a converter, as the data show them: one extreme reading that comes again to the last digit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray, IntArray


class Rail(NamedTuple):
    """An extreme that repeats."""

    whose: str
    """SG2 reads, or gauges read."""
    strain: float
    rows: tuple[int, ...]

    def words(self, lines: IntArray | None = None) -> str:
        """As a sentence; ``lines``: of the file, (m,), else rows from 0."""
        places = [int(row) if lines is None else int(lines[row]) for row in self.rows]
        what = "rows" if lines is None else "lines"
        return (
            f"{self.whose} exactly {self.strain * 1e6:g} microstrain, the extreme, in {len(places)} rows "
            f"({what} {', '.join(map(str, places[:5]))}{', ...' if len(places) > 5 else ''})"
        )


def rails(strain: FloatArray, loads: FloatArray, limit: FloatArray) -> list[Rail]:
    """Return the extremes that look like a limit below the stated one.

    strain: (m, n); loads: (m, 3), P, phi, theta; limit: (n,), inf where none is stated. An extreme is a rail where
    it comes in rows of different loads, or in three rows, and more often than any other reading: readings that are
    rounded, or free of noise, repeat everywhere. Looked at are both extremes of each gauge, and the largest reading
    of either sign of all together, for the gauges of one converter have one limit.
    """
    inside, loaded = np.abs(strain) < limit, loads[:, 0] > 0.0
    found = []
    for k, readings in enumerate(strain.T):
        some = readings[inside[:, k]]
        for extreme in {float(some.max(initial=0.0)), float(some.min(initial=0.0))} - {0.0}:
            same = readings == extreme
            if _repeats(np.flatnonzero(same), readings[~same & inside[:, k] & loaded], loads):
                found.append(Rail(f"SG{k + 1} reads", extreme, tuple(np.flatnonzero(same).tolist())))
    if found or not inside.any():
        return found
    size = np.abs(strain)
    largest = float(size[inside].max())
    same = size == largest
    if largest and _repeats(np.flatnonzero(same.any(axis=1)), size[inside & ~same & loaded[:, np.newaxis]], loads):
        rows = np.flatnonzero(same.any(axis=1))
        found.append(Rail("several gauges read", largest, tuple(rows.tolist())))
    return found


def _repeats(rows: IntArray, others: FloatArray, loads: FloatArray) -> bool:
    usual = int(np.unique(others, return_counts=True)[1].max(initial=1))
    different = len(np.unique(loads[rows], axis=0)) > 1
    return bool((loads[rows, 0] > 0.0).all() and len(rows) > usual and (different or len(rows) > 2))
