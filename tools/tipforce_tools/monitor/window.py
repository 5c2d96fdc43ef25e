"""The last seconds of something that repeats: rates, periods and loads are taken from here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tipforce.arrays import IntArray

WINDOW_NS = 2_000_000_000
_LEAST_NS = 100_000_000  # a shorter time says little of a rate
MOST = 65_536  # events kept: a full bus for more than the window


@dataclass(frozen=True, slots=True)
class Periods:
    """Times between events in milliseconds: the middle, the 99th percentile, the longest."""

    p50_ms: float
    p99_ms: float
    max_ms: float


class Window:
    """Times of events, and with each ``columns`` numbers, within WINDOW_NS before the newest of them."""

    def __init__(self, columns: int = 0) -> None:
        self._t_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._numbers: IntArray = np.zeros((columns, 0), dtype=np.int64)

    def add(self, t_ns: IntArray, *numbers: IntArray) -> None:
        """Take events (k,) and their numbers (k,). A clock that jumped back by more than the window starts anew."""
        if not len(t_ns):
            return
        if len(self._t_ns) and t_ns[-1] < self._t_ns[-1] - WINDOW_NS:
            self.clear()
        times = np.concatenate((self._t_ns, t_ns))[-MOST:]
        kept = times > times[-1] - WINDOW_NS
        self._t_ns = times[kept]
        if numbers:
            self._numbers = np.concatenate((self._numbers, np.stack(numbers)), axis=1)[:, -MOST:][:, kept]

    def clear(self) -> None:
        """Forget all."""
        self._t_ns = self._t_ns[:0]
        self._numbers = self._numbers[:, :0]

    @property
    def last_ns(self) -> int | None:
        """The newest event."""
        return int(self._t_ns[-1]) if len(self._t_ns) else None

    def rate_hz(self, now_ns: int) -> float:
        """Events per second: by their periods while they go on, falling to 0 once they end."""
        recent = self._t_ns[self._t_ns > now_ns - WINDOW_NS]
        if len(recent) < 2 or recent[-1] <= recent[0]:
            return 0.0
        period_ns = float(recent[-1] - recent[0]) / (len(recent) - 1)
        silence_ns = now_ns - float(recent[-1])
        span_ns = float(recent[-1] - recent[0]) + (silence_ns if silence_ns > 3.0 * period_ns else 0.0)
        return (len(recent) - 1) * 1e9 / span_ns

    def periods(self) -> Periods | None:
        """How regular the events are; None for fewer than two. Times that go back by a little count as 0."""
        if len(self._t_ns) < 2:
            return None
        periods = np.maximum(np.diff(self._t_ns), 0) * 1e-6
        return Periods(*(float(value) for value in (*np.percentile(periods, (50, 99)), periods.max())))

    def sums(self, now_ns: int) -> list[float]:
        """The numbers per second, over what was seen of the window before ``now_ns``."""
        recent = self._t_ns > now_ns - WINDOW_NS
        if not recent.any():
            return [0.0] * len(self._numbers)
        seen_ns = max(now_ns - int(self._t_ns[recent][0]), _LEAST_NS)
        return [float(row[recent].sum()) * 1e9 / seen_ns for row in self._numbers]
