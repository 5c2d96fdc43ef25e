"""Recorded counts as a gauge source, at the recorded speed or at another."""

from bisect import bisect_right

from tipforce.dictionary import table
from tipforce.fingertip.source import Reading, Source

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from tipforce.dictionary.table import Converter


class ReplaySource(Source):
    """Rows of counts (None: no reading) at increasing microseconds from the first ``read`` on; ``temperatures`` in 0.01
    degC; ``loop``: again after the median step. Raises ValueError for no rows, a wrong order or speed."""

    def __init__(
        self, times_us: "Sequence[int]", rows: "Sequence[tuple[int, ...] | None]", converter: "Converter",
        ends: "tuple[int, int]", speed: float = 1.0, loop: bool = False, temperatures: "Sequence[int] | None" = None,
    ) -> None:  # fmt: skip
        if not rows or len(rows) != len(times_us):
            raise ValueError("replay: %d rows at %d times" % (len(rows), len(times_us)))
        steps = [times_us[k] - times_us[k - 1] for k in range(1, len(times_us))]
        late = [row for row, step_us in enumerate(steps, 2) if step_us <= 0]
        if late:
            raise ValueError("replay: times that do not increase, first at row %d" % late[0])
        steps.sort()
        if not 0.0 < speed <= 1e9:
            raise ValueError("replay: speed %r, allowed is a positive number up to 1e9" % speed)
        self.converter = converter
        self.count_min, self.count_max = ends
        self._times_us = [time_us - times_us[0] for time_us in times_us]
        self._rows = rows
        self._temperatures = temperatures
        self._length_us = self._times_us[-1] + (steps[len(steps) // 2] if steps else 1000)
        self._speed = speed
        self._loop = loop
        self._start_us = -1
        self._place = (0, -1)  # number of repetitions, and the last returned row

    @property
    def over(self) -> bool:
        """True after the last row if nothing follows."""
        return not self._loop and self._place[1] == len(self._rows) - 1

    def read(self, now_us: int) -> "Reading | None":
        """Return the present row, once."""
        if self._start_us < 0:
            self._start_us = now_us
        played_us = int((now_us - self._start_us) * self._speed)
        times, in_turn_us = divmod(played_us, self._length_us) if self._loop else (0, played_us)
        row = bisect_right(self._times_us, in_turn_us) - 1
        if (times, row) <= self._place:
            return None
        self._place = (times, row)
        counts = self._rows[row]
        if counts is None:
            return None
        return Reading(counts, 0, self._temperatures[row] if self._temperatures else table.UNKNOWN_I16)
