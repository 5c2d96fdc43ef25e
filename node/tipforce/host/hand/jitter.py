"""Regularity of a SYNC: the deviations of its periods, in a histogram of bounded size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_BIN_NS, _BINS = 1000, 50_001  # up to 50 ms; the last bin is for larger ones


@dataclass(frozen=True, slots=True)
class JitterFigures:
    """Deviations of SYNC periods from the nominal one, microseconds; NaN before the first period."""

    periods: int
    mean_period_us: float
    p50_us: float
    p99_us: float
    largest_us: float


class Jitter:
    """Collect the receive times of SYNCs with the nominal period ``period_ns`` (0: unknown, the mean is used)."""

    def __init__(self, period_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._histogram = np.zeros(_BINS, dtype=np.int64)
        self._last_ns: int | None = None
        self._sum_ns = self._largest_ns = 0
        self._periods = 0

    def add(self, sync_ns: npt.NDArray[np.int64]) -> None:
        """Add the times of further SYNCs (m,), in order."""
        if self._last_ns is not None:
            sync_ns = np.append(self._last_ns, sync_ns)
        if len(sync_ns):
            self._last_ns = int(sync_ns[-1])
        periods = np.diff(sync_ns)
        if not len(periods):
            return
        self._period_ns = self._period_ns or int(np.median(periods))
        deviations = np.abs(periods - self._period_ns)
        self._histogram += np.bincount(np.minimum(deviations // _BIN_NS, _BINS - 1), minlength=_BINS)
        self._sum_ns += int(periods.sum())
        self._largest_ns = max(self._largest_ns, int(deviations.max()))
        self._periods += len(periods)

    def skip(self) -> None:
        """Restart with the next SYNC after a deliberate interruption."""
        self._last_ns = None

    def figures(self) -> JitterFigures:
        """Return the results so far; percentiles to a microsecond, rounded up."""
        if not self._periods:
            return JitterFigures(0, *[float("nan")] * 4)
        p50, p99 = (self._percentile(share) for share in (0.50, 0.99))
        return JitterFigures(self._periods, self._sum_ns / self._periods / 1e3, p50, p99, self._largest_ns / 1e3)

    def _percentile(self, share: float) -> float:
        place = int(np.searchsorted(np.cumsum(self._histogram), share * self._periods))
        return min((place + 1) * _BIN_NS, self._largest_ns) / 1e3
