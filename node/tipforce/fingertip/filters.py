"""The filters of the gauges (61A0h, 61A1h), loaded with the first that is set. One serves all gauges: a force from
gauges with different delays would be wrong while it changes. Sums are integers: no error accumulates."""

from array import array

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from .node import Fingertip
    from .source import Reading

MOVING_AVERAGE, REPEATING_AVERAGE, FIRST_ORDER = 1, 2, 100  # 61A0h
LONGEST_WINDOW = 256  # of a moving average, the one filter that keeps values: 8 gauges take 8 kB then
GAP_US = 100000  # conversions so long past are no longer what an average of now is made of
_ONE = 256  # of the first-order filter's state, which is exact to 1/256 count


class Average:
    """What the filters share: sums of ``n`` gauges, and how many conversions are in them."""

    def __init__(self, n: int, constant: int) -> None:
        self._n, self._constant = n, constant
        self.restart()

    def restart(self) -> None:
        """Forget all conversions, and the last output."""
        self._sums = [0] * self._n
        self._filled = 0

    def output(self) -> "list[float] | None":
        """The mean of each gauge in counts; None while there is none."""
        return [total / self._filled for total in self._sums] if self._filled else None


class MovingAverage(Average):
    """The mean of the last ``constant`` conversions; of as many as there are, while they are fewer."""

    def __init__(self, n: int, constant: int) -> None:
        Average.__init__(self, n, constant)
        self._ring = array("i", bytes(4 * n * constant))
        self._at = 0

    def push(self, counts: "Sequence[int]") -> bool:
        """Take a conversion; True when there is a new output."""
        ring, sums, place = self._ring, self._sums, self._at * self._n
        full = self._filled == self._constant
        for k in range(self._n):
            sums[k] += counts[k] - (ring[place + k] if full else 0)
            ring[place + k] = counts[k]
        if not full:
            self._filled += 1
        self._at = (self._at + 1) % self._constant
        return True


class RepeatingAverage(Average):
    """The mean of ``constant`` conversions, then of the next ``constant``: one output for so many conversions."""

    def restart(self) -> None:
        """Forget all conversions, and the last output."""
        Average.restart(self)
        self._mean: "list[float] | None" = None

    def push(self, counts: "Sequence[int]") -> bool:
        """Take a conversion; True when there is a new output."""
        for k in range(self._n):
            self._sums[k] += counts[k]
        self._filled += 1
        if self._filled < self._constant:
            return False
        self._mean = Average.output(self)
        Average.restart(self)
        return True

    def output(self) -> "list[float] | None":
        """The mean of each gauge in counts over the last full block; None before the first one."""
        return self._mean


class FirstOrder(Average):
    """y += (x - y) / constant at each conversion; the mean of fewer than ``constant``. The state constant * y is an
    integer in 1/256 count: exact on a constant input, within 1/256 count of the real-valued filter."""

    def push(self, counts: "Sequence[int]") -> bool:
        """Take a conversion; True when there is a new output."""
        full = self._filled == self._constant
        if not full:
            self._filled += 1
        for k, state in enumerate(self._sums):  # a mean's sum is already the state with which the filter goes on
            self._sums[k] = state + counts[k] * _ONE - (state // self._constant if full else 0)
        return True

    def output(self) -> "list[float] | None":
        """y of each gauge in counts; None while there is none."""
        return [state // self._filled / _ONE for state in self._sums] if self._filled else None


def offered(kind: int, constant: int) -> bool:
    """True for a filter type and constant that a node can run."""
    return kind in (REPEATING_AVERAGE, FIRST_ORDER) or (kind == MOVING_AVERAGE and constant <= LONGEST_WINDOW)


def algorithm(kind: int, n: int, constant: int) -> "MovingAverage | RepeatingAverage | FirstOrder":
    """The filter of a type that is offered, for n gauges."""
    if kind == MOVING_AVERAGE:
        return MovingAverage(n, constant)
    return RepeatingAverage(n, constant) if kind == REPEATING_AVERAGE else FirstOrder(n, constant)


class Filtering:
    """Between source and samples: takes every conversion. A gauge at its end or frozen and a front-end fault show at
    once, as unfiltered; when they end, and after ``GAP_US`` without a conversion, the filter restarts."""

    def __init__(self, fingertip: "Fingertip", kind: int, constant: int, now_us: int) -> None:
        self._fingertip = fingertip
        self.algorithm = algorithm(kind, fingertip.n, constant)
        self.reading: "Reading | None" = None  # the newest, as it came
        self.faults = 0  # of the front end, as the newest reading shows them
        self._bad = 0
        self.fresh = False  # there is an output that no sample carries yet
        self.due_us = self._put_us = now_us  # begins with the conversion that is there now

    def _restart(self) -> None:
        self.algorithm.restart()
        self.fresh = False

    def news(self) -> bool:
        """There is something to latch: a new output, a fault, or that there is no output any more."""
        return self.fresh or self._bad != 0 or self.algorithm.output() is None

    def take(self, now_us: int) -> None:
        """Every conversion that there was up to now, also those that the node's loop came too late for."""
        source = self._fingertip.source
        if now_us - self.due_us > max(GAP_US, 2 * source.period_us):
            self.due_us = now_us  # too late for all of them
        while self.due_us <= now_us:
            reading = source.read(self.due_us)
            if reading is not None:
                self._put(reading, self.due_us)
            self.due_us = source.due_us(self.due_us)

    def _put(self, reading: "Reading", now_us: int) -> None:
        fingertip = self._fingertip
        if now_us - self._put_us > max(GAP_US, 2 * fingertip.source.period_us):
            self._restart()
        self._put_us = now_us
        self.faults = fingertip.watch(reading, self.reading, now_us)
        bad = fingertip.frozen | reading.faults
        lowest, highest = fingertip.ends
        for k in range(fingertip.n):
            if not lowest < reading.counts[k] < highest:
                bad |= 1 << k
        if self._bad & ~bad:
            self._restart()
        self._bad = bad
        self.reading = reading
        if self.algorithm.push(reading.counts):
            self.fresh = True
