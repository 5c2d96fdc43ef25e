"""How many SYNCs may lack between those that were received: ones that the fingers heard and the host did not."""

from __future__ import annotations

from collections import deque

_INTERVALS, _ENOUGH = 15, 5
_EVER_NS = 1 << 62
UNKNOWN = 3
"""Said where nothing is known: so many may have been missed."""


class SyncGaps:
    """Follows the times of SYNCs, whoever sends them and how often.

    With ``own`` the host sends them itself, and sees what it sends: a gap is a time in which there was none, unless
    frames were dropped. Somebody else's are judged by their times alone.
    """

    def __init__(self, own: bool = False) -> None:
        self._own = own
        self._doubted = 0  # how many batches of SYNCs yet
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)
        self._last_ns: int | None = None

    def drop(self) -> None:
        """Frames were lost on the way to the host, perhaps SYNCs: before, among or after the next that it gets."""
        self._doubted = 2

    def end_batch(self) -> None:
        """The SYNCs that were received together were all added."""
        self._doubted = max(self._doubted - 1, 0)

    def add(self, t_ns: int) -> int:
        """The SYNC received at ``t_ns``: how many may lack before it; -1 where it is closer than half a period."""
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
        """For how long after the last SYNC there was surely no other one."""
        if self._doubted:
            return 0
        return _EVER_NS if self._own else self._period_ns()

    def _period_ns(self) -> int:
        """The median of the last intervals, which a few odd ones do not change; 0 as long as it is not known."""
        if len(self._intervals_ns) < _ENOUGH:
            return 0
        return max(sorted(self._intervals_ns)[len(self._intervals_ns) // 2], 0)
