"""Traces of one finger, in bounded memory: quantities over time with bands, flags, lost samples, by bins that keep
the extremes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray

COVERAGE = 2.0
"""Half width of a band in standard uncertainties: 95 %."""
_TURN = 360.0
_PERIODS = 5.0  # a pause of this many periods is a gap


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A quantity, (k,) each: ``mean`` with ``low`` and ``high``; the band (NaN where its uncertainty is unknown).

    ``starts``: preceded by a gap or an unknown value. Angles are unwrapped.
    """

    t_ns: IntArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    band_low: FloatArray
    band_high: FloatArray
    starts: npt.NDArray[np.bool_]


class Trace:
    """Collects one quantity; an ``angle`` in degrees is unwrapped at the jump from 180 to -180."""

    def __init__(self, start_ns: int, *, angle: bool = False) -> None:
        self.unknown = 0
        self.banded = False
        self._angle = angle
        self._bins = Bins(
            start_ns,
            {
                "low": (np.minimum, np.inf), "high": (np.maximum, -np.inf), "total": (np.add, 0.0),
                "band_low": (np.minimum, np.inf), "band_high": (np.maximum, -np.inf),
                "key": (np.minimum, np.iinfo(np.int64).max),
            },
        )  # fmt: skip
        self._last: tuple[int, float] | None = None  # the last known value
        self._broken = True  # an unknown value has arrived since
        self._start_ns = start_ns
        self._period_ns = 0.0

    def add(self, t_ns: IntArray, values: FloatArray, uncertainty: FloatArray | None = None) -> None:
        """Add samples (k,), NaN for unknown, and their standard uncertainties (k,)."""
        known = np.flatnonzero(np.isfinite(values))
        self.unknown += len(values) - len(known)
        if len(t_ns) > 1:
            self._period_ns = float(np.median(np.diff(t_ns)))
        if not len(known):
            self._broken = self._broken or len(values) > 0
            return
        gap = np.diff(known, prepend=-1) > 1
        gap[0] |= self._broken
        self._broken = bool(known[-1] < len(values) - 1)
        t, x = t_ns[known], values[known]
        before_ns = self._last[0] if self._last is not None else int(t[0])
        if self._period_ns > 0:
            gap |= np.diff(t, prepend=before_ns) > _PERIODS * self._period_ns
        if self._angle:
            x = self._unwrapped(x, gap)
        self._last = int(t[-1]), float(x[-1])
        u = np.full(len(x), np.nan) if uncertainty is None else COVERAGE * uncertainty[known]
        self.banded = self.banded or bool(np.isfinite(u).any())
        low, high = np.where(np.isfinite(u), x - u, np.inf), np.where(np.isfinite(u), x + u, -np.inf)
        key = 2 * np.maximum(t - self._start_ns, 0) + ~gap  # the first of a bin, and whether a gap precedes it
        self._bins.add(t, low=x, high=x, total=x, band_low=low, band_high=high, key=key)

    def _unwrapped(self, x: FloatArray, gap: npt.NDArray[np.bool_]) -> FloatArray:
        start = x[0] if self._last is None or gap[0] else self._last[1]
        x = np.asarray(np.unwrap(np.concatenate(([start], x)), period=_TURN)[1:])
        # After each gap it starts within -180..180 again.
        run = np.cumsum(gap)
        turns = np.where(gap, np.ceil((x - _TURN / 2) / _TURN), 0.0)
        first = np.concatenate(([0.0], turns[gap]))
        return np.asarray(x - _TURN * first[run])

    def line(self) -> Line | None:
        """Return the trace to draw; None without a known value."""
        bins = self._bins.filled()
        if not len(bins["count"]):
            return None
        has_band = np.isfinite(bins["band_low"])
        return Line(
            (bins["first_ns"] // 2 + bins["last_ns"] // 2), bins["total"] / bins["count"],
            bins["low"], bins["high"],
            np.where(has_band, bins["band_low"], np.nan), np.where(has_band, bins["band_high"], np.nan),
            bins["key"] % 2 == 0,
        )  # fmt: skip


class Flags:
    """Collects the times of set flags: at most 63, by name."""

    def __init__(self, start_ns: int) -> None:
        self._bins = Bins(start_ns, {"set": (np.bitwise_or, 0)})
        self._names: list[str] = []

    def add(self, t_ns: IntArray, flags: Mapping[str, npt.NDArray[np.bool_]]) -> None:
        """Add samples (k,) of flags."""
        bits = np.zeros(len(t_ns), dtype=np.int64)
        for name, is_set in flags.items():
            if name not in self._names:
                self._names.append(name)
            bits |= is_set.astype(np.int64) << self._names.index(name)
        self._bins.add(t_ns, set=bits)

    def bars(self) -> dict[str, list[tuple[int, int]]]:
        """Return by name, for flags that were set: start and end times in nanoseconds."""
        bins = self._bins.filled()
        if not len(bins["count"]):
            return {}
        first, last = bins["first_ns"], bins["last_ns"]
        usual_ns = (last[-1] - first[0]) / max(int(bins["count"].sum()) - 1, 1)
        # A flag holds until the next sample, unless that is late.
        until = np.append(first[1:], last[-1])
        until = np.where(until - last > np.maximum(_PERIODS * usual_ns, self._bins.width_ns), last, until)
        bars = {}
        for number, name in enumerate(self._names):
            is_set = (bins["set"] >> number & 1).astype(np.bool_)
            if is_set.any():
                bars[name] = _runs(is_set, first, until)
        return bars


def _runs(is_set: npt.NDArray[np.bool_], first: Array, until: Array) -> list[tuple[int, int]]:
    starts = np.flatnonzero(is_set & ~np.concatenate(([False], is_set[:-1] & (until[:-1] >= first[1:]))))
    ends = np.append(starts[1:], len(is_set))
    bars = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        inside = np.flatnonzero(is_set[start:end])
        bars.append((int(first[start]), int(until[start + inside[-1]])))
    return bars


class Lost:
    """Collects lost samples: times, and total number."""

    def __init__(self, start_ns: int) -> None:
        self.total = 0
        self._bins = Bins(start_ns, {"lost": (np.add, 0)})
        self._last: int | None = None

    def add(self, t_ns: IntArray, counter: IntArray) -> None:
        """Add the unwrapped counters (k,) of samples that follow SYNC."""
        if not len(counter):
            return
        missing = np.maximum(np.diff(counter, prepend=counter[0] if self._last is None else self._last) - 1, 0)
        self._last = int(counter[-1])
        there = missing > 0
        self.total += int(missing.sum())
        self._bins.add(t_ns[there], lost=missing[there])

    def times_ns(self) -> IntArray:
        """Return the time of the first sample after each loss; losses close together count as one."""
        return np.asarray(self._bins.filled()["first_ns"])


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
