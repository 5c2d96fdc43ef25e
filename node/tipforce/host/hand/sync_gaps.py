"""How many SYNCs seem to lack between those that were received, by their times."""

from __future__ import annotations

from collections import deque

_INTERVALS, _ENOUGH = 15, 5
UNKNOWN = 3
"""Said while the period is not known yet: so many may have been missed."""


class SyncGaps:
    """Follows the times of SYNCs, whoever sends them and how often."""

    def __init__(self) -> None:
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)
        self._last_ns: int | None = None

    def add(self, t_ns: int) -> int:
        """The SYNC received at ``t_ns``: how many lack before it; -1 where it is closer than half a period."""
        before_ns, self._last_ns = self._last_ns, t_ns
        if before_ns is None:
            return UNKNOWN
        self._intervals_ns.append(t_ns - before_ns)
        period_ns = self.period_ns
        return round((t_ns - before_ns) / period_ns) - 1 if period_ns > 0 else UNKNOWN

    @property
    def period_ns(self) -> int:
        """The median of the last intervals, which a few odd ones do not change; 0 as long as it is not known."""
        if len(self._intervals_ns) < _ENOUGH:
            return 0
        return max(sorted(self._intervals_ns)[len(self._intervals_ns) // 2], 0)
