"""What is drawn of one finger: its quantities over time with their bands, flags, lost samples; in bounded memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce_tools.plot.bins import Array, Bins

COVERAGE = 2.0
"""Standard uncertainties to either side that a band shows: 95 %."""
_TURN = 360.0
_PERIODS = 5.0  # a silence of so many periods is a gap


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A quantity, (k,) each: ``mean`` with ``low`` and ``high``; the band (NaN where its uncertainty is unknown).

    ``starts``: there is a gap, or something unknown, before. Angles go on over a full turn.
    """

    t_ns: IntArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    band_low: FloatArray
    band_high: FloatArray
    starts: npt.NDArray[np.bool_]


class Trace:
    """Collects one quantity; ``angle`` in degrees is followed over the jump from 180 to -180."""

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
        self._broken = True  # something unknown has come since
        self._start_ns = start_ns
        self._period_ns = 0.0

    def add(self, t_ns: IntArray, values: FloatArray, uncertainty: FloatArray | None = None) -> None:
        """Take samples (k,), NaN for unknown, and their standard uncertainties (k,)."""
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
        key = 2 * np.maximum(t - self._start_ns, 0) + ~gap  # the first of a bin, and whether there is a gap before it
        self._bins.add(t, low=x, high=x, total=x, band_low=low, band_high=high, key=key)

    def _unwrapped(self, x: FloatArray, gap: npt.NDArray[np.bool_]) -> FloatArray:
        start = x[0] if self._last is None or gap[0] else self._last[1]
        x = np.asarray(np.unwrap(np.concatenate(([start], x)), period=_TURN)[1:])
        # Behind each gap it starts within -180..180 again.
        run = np.cumsum(gap)
        turns = np.where(gap, np.ceil((x - _TURN / 2) / _TURN), 0.0)
        first = np.concatenate(([0.0], turns[gap]))
        return np.asarray(x - _TURN * first[run])

    def line(self) -> Line | None:
        """What there is to draw; None where no value is known."""
        found = self._bins.filled()
        if not len(found["count"]):
            return None
        has_band = np.isfinite(found["band_low"])
        return Line(
            (found["first_ns"] // 2 + found["last_ns"] // 2), found["total"] / found["count"],
            found["low"], found["high"],
            np.where(has_band, found["band_low"], np.nan), np.where(has_band, found["band_high"], np.nan),
            found["key"] % 2 == 0,
        )  # fmt: skip


class Flags:
    """Collects when flags are set: at most 63, by name."""

    def __init__(self, start_ns: int) -> None:
        self._bins = Bins(start_ns, {"set": (np.bitwise_or, 0)})
        self._names: list[str] = []

    def add(self, t_ns: IntArray, flags: Mapping[str, npt.NDArray[np.bool_]]) -> None:
        """Take samples (k,) of flags."""
        bits = np.zeros(len(t_ns), dtype=np.int64)
        for name, is_set in flags.items():
            if name not in self._names:
                self._names.append(name)
            bits |= is_set.astype(np.int64) << self._names.index(name)
        self._bins.add(t_ns, set=bits)

    def bars(self) -> dict[str, list[tuple[int, int]]]:
        """By name, for those that were ever set: from when to when, in nanoseconds."""
        found = self._bins.filled()
        if not len(found["count"]):
            return {}
        first, last = found["first_ns"], found["last_ns"]
        usual_ns = (last[-1] - first[0]) / max(int(found["count"].sum()) - 1, 1)
        # A flag holds until the next sample, unless that comes late.
        until = np.append(first[1:], last[-1])
        until = np.where(until - last > np.maximum(_PERIODS * usual_ns, self._bins.width_ns), last, until)
        bars = {}
        for number, name in enumerate(self._names):
            is_set = (found["set"] >> number & 1).astype(np.bool_)
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
    """Collects lost samples: where, and how many in all."""

    def __init__(self, start_ns: int) -> None:
        self.total = 0
        self._bins = Bins(start_ns, {"lost": (np.add, 0)})
        self._last: int | None = None

    def add(self, t_ns: IntArray, counter: IntArray) -> None:
        """Take the counters (k,) of samples that follow SYNC, unwrapped."""
        if not len(counter):
            return
        missing = np.maximum(np.diff(counter, prepend=counter[0] if self._last is None else self._last) - 1, 0)
        self._last = int(counter[-1])
        there = missing > 0
        self.total += int(missing.sum())
        self._bins.add(t_ns[there], lost=missing[there])

    def times_ns(self) -> IntArray:
        """When the first sample behind each loss came; losses close together count as one."""
        return np.asarray(self._bins.filled()["first_ns"])
