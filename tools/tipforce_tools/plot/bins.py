"""Reduce samples of any time span to a bounded number of bins, which keep the extremes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

BINS = 4096
"""Several for each pixel of a wide panel."""
_FIRST_WIDTH_NS = 1000

Array = npt.NDArray[Any]
Reduced = Mapping[str, tuple[np.ufunc, Any]]  # by column: reduction of a bin, and value of an empty bin


class Bins:
    """Columns of samples from ``start_ns``, reduced per bin; bins grow by powers of two with time.

    ``count`` (BINS,): number of samples in each; ``first_ns``, ``last_ns``: their times.
    """

    def __init__(self, start_ns: int, columns: Reduced) -> None:
        self.start_ns = start_ns
        self.width_ns = _FIRST_WIDTH_NS
        last = np.iinfo(np.int64)
        self._how: dict[str, tuple[np.ufunc, Any]] = {
            **columns,
            "count": (np.add, 0),
            "first_ns": (np.minimum, last.max),
            "last_ns": (np.maximum, last.min),
        }
        self._columns = {name: np.full(BINS, empty) for name, (_, empty) in self._how.items()}

    def add(self, t_ns: npt.NDArray[np.int64], **columns: Array) -> None:
        """Add samples (k,) in time order; an earlier one gets the time of its predecessor."""
        if not len(t_ns):
            return
        place = np.maximum.accumulate(np.maximum(t_ns - self.start_ns, 0))
        while place[-1] // self.width_ns >= BINS:
            self._halve()
        number = place // self.width_ns
        edges = np.concatenate(([0], np.flatnonzero(number[1:] != number[:-1]) + 1))
        chosen = number[edges]
        given = {**columns, "count": np.ones(len(t_ns), dtype=np.int64), "first_ns": t_ns, "last_ns": t_ns}
        for name, (how, _) in self._how.items():
            target = self._columns[name]
            target[chosen] = how(target[chosen], how.reduceat(given[name], edges))

    def _halve(self) -> None:
        self.width_ns *= 2
        for name, (how, empty) in self._how.items():
            pairs = self._columns[name].reshape(-1, 2)
            self._columns[name] = np.concatenate((how(pairs[:, 0], pairs[:, 1]), np.full(BINS // 2, empty)))

    def filled(self) -> dict[str, Array]:
        """Return the columns of the non-empty bins."""
        there = self._columns["count"] > 0
        return {name: column[there] for name, column in self._columns.items()}
