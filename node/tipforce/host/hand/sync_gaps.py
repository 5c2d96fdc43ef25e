"""Estimate how many SYNCs are missing between the received ones: SYNCs that the fingers got and the host did not."""

from __future__ import annotations

from collections import deque

_INTERVALS, _ENOUGH = 15, 5
_EVER_NS = 1 << 62
UNKNOWN = 3
"""Value if nothing is known: this many may have been missed."""


class SyncGaps:
    """Track the times of SYNCs of any producer and rate.

    With ``own`` the host itself sends and receives them: a gap is a time without SYNC, unless frames were
    dropped. SYNCs of another producer are assessed only by their times.
    """

    def __init__(self, own: bool = False) -> None:
        self._own = own
        self._doubted = 0  # number of SYNC batches still in doubt
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)
        self._last_ns: int | None = None

    def drop(self) -> None:
        """Note that frames, perhaps SYNCs, were lost before, among or after the next ones."""
        self._doubted = 2

    def end_batch(self) -> None:
        """End a batch: all SYNCs that were received together have been added."""
        self._doubted = max(self._doubted - 1, 0)

    def add(self, t_ns: int) -> int:
        """Return how many SYNCs may be missing before the one at ``t_ns``; -1 if it is closer than half a period."""
        before_ns, self._last_ns = self._last_ns, t_ns
        if self._doubted or before_ns is None:
            return UNKNOWN
        if self._own:
            return 0
        self._intervals_ns.append(t_ns - before_ns)
        period_ns = self._period_ns()
        return round((t_ns - before_ns) / period_ns) - 1 if period_ns else UNKNOWN

    @property
    def horizon_ns(self) -> int:
        """Time after the last SYNC without another one for certain."""
        if self._doubted:
            return 0
        return _EVER_NS if self._own else self._period_ns()

    def _period_ns(self) -> int:
        """Return the median of the last intervals, which a few outliers do not change; 0 while it is unknown."""
        if len(self._intervals_ns) < _ENOUGH:
            return 0
        return max(sorted(self._intervals_ns)[len(self._intervals_ns) // 2], 0)
