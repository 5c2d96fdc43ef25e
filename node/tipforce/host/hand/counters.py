"""Decide by the node's 8-bit sample counter (2121h) whether an answer belongs to its row.

The counter of a node that answers every SYNC increments by one per row. A counter that lags behind the rows is from a
late answer, or from a node that missed a SYNC; one answer alone does not show which. So it is doubtful until CONFIRMED
answers over CONFIRMED_S lag by the same amount, which is unlikely for late ones. A counter that is ahead means SYNCs
that did not reach the host, which leave a gap between those that did; a counter ahead by more than the gap is more
likely a babbler's frame before the node's own, or a rebooted node. After a long absence CONFIRMED answers are needed.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

CONFIRMED, CONFIRMED_S = 4, 1.0
FORGOTTEN_ROWS = 100
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


class CounterCheck:
    """Track the counters of k fingers from row to row."""

    def __init__(self, fingers: int) -> None:
        self._base = np.full(fingers, -1, dtype=np.int64)  # the last accepted counter
        self._rows = np.zeros(fingers, dtype=np.int64)  # rows since then
        self._gaps = np.zeros(fingers, dtype=np.int64)  # periods since then without a SYNC
        self._seen = np.full(fingers, -1, dtype=np.int64)
        self._lag = np.zeros(fingers, dtype=np.int64)
        self._run = np.zeros(fingers, dtype=np.int64)  # answers that lag by it
        self._since_ns = np.zeros(fingers, dtype=np.int64)  # receive time of the first of them
        self._silent_rows = np.zeros(fingers, dtype=np.int64)

    def expected(self) -> npt.NDArray[np.int64]:
        """Return the expected counter of each finger's answer to the next SYNC (k,), -1 if it is unknown."""
        known = (self._base >= 0) & (self._rows < FORGOTTEN_ROWS) & (self._gaps == 0)
        return np.where(known, (self._base + self._rows + 1) % 256, -1)

    def forget(self, finger: int) -> None:
        """Restart after a boot-up: the counter restarts, and any next value is accepted."""
        self._base[finger] = self._seen[finger] = -1
        self._rows[finger] = self._gaps[finger] = self._run[finger] = 0

    def check(
        self, counter: IntArray, stale: BoolArray, proved: BoolArray, gaps: IntArray, t_ns: IntArray
    ) -> tuple[BoolArray, BoolArray]:
        """Check the counters (m, k) of the next m rows, -1 for no answer.

        ``proved`` (m, k): known to be in its row, whatever its counter. ``gaps`` (m,): number of SYNCs probably
        missing before each, ``t_ns`` (m,) its receive time. Returns two masks (m, k): repeated, the sample of the
        previous row, marked stale; doubtful, an answer that may belong to another SYNC.
        """
        repeated = np.zeros(counter.shape, dtype=np.bool_)
        doubtful = np.zeros(counter.shape, dtype=np.bool_)
        for row in range(len(counter)):
            self._gaps += gaps[row]
            repeated[row], doubtful[row] = self._row(counter[row], stale[row], proved[row], int(t_ns[row]))
        return repeated, doubtful

    def _row(self, now: IntArray, stale: BoolArray, proved: BoolArray, t_ns: int) -> tuple[BoolArray, BoolArray]:
        here = now >= 0
        again = here & stale & (now == self._seen)
        repeated = again & (proved | (now == self._base))  # after a doubtful one nothing more is known
        judged = here & ~again
        lag = (self._rows + 1 - (now - self._base) + 128) % 256 - 128
        # After so many rows an 8-bit counter no longer distinguishes ahead from behind.
        odd = judged & (self._base >= 0) & ((lag > 0) | (lag < -self._gaps) | (self._rows >= FORGOTTEN_ROWS))
        odd &= ~proved
        same = odd & (lag == self._lag) & (self._run > 0)
        begins_ns = np.where(self._silent_rows >= FORGOTTEN_ROWS, t_ns - int(CONFIRMED_S * 1e9), t_ns)
        self._since_ns = np.where(odd & ~same, begins_ns, self._since_ns)
        self._run = np.where(odd, np.where(same, self._run + 1, 1), self._run)
        self._lag = np.where(odd, lag, self._lag)
        confirmed = (self._run >= CONFIRMED) & (t_ns - self._since_ns >= CONFIRMED_S * 1e9)
        trusted = judged & (~odd | confirmed)
        trusted |= again & proved
        self._base = np.where(trusted, now, self._base)
        self._rows = np.where(trusted, 0, np.where(again, self._rows, self._rows + 1))
        self._gaps = np.where(trusted, 0, self._gaps)
        self._run = np.where(trusted, 0, self._run)
        self._silent_rows = np.where(here, 0, self._silent_rows + 1)
        self._seen = np.where(here, now, self._seen)
        return repeated, here & ~trusted & ~repeated
