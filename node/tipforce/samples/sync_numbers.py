"""The numbers that SYNCs carry (CiA 301, 7.2.5.3): the distance between two of them, and where a count restarts."""

LARGEST = 240
"""Largest value of 1019h: the numbers are 1 to 1019h."""

RESTARTED = 0


class SyncNumbers:
    """Compare the numbers of consecutive SYNCs. ``modulus``: the producer's overflow value, as far as known. The count
    of an ``own`` SYNC never restarts; another's may, with 1, among SYNCs that were not received: the time tells."""

    def __init__(self, own: bool = False) -> None:
        self._own = own
        self.modulus = LARGEST
        self.number = 0
        """Number of the last SYNC; 0 for one without a number, and before the first."""
        self.last_ns = 0
        self.gap_periods = 0
        """Between the last two SYNCs, by their times; LARGEST and more: any number of SYNCs was not received."""
        self.period_ns = 0
        self._ended = 0  # the number before an unexpected 1: the second time it is the overflow value

    @property
    def window(self) -> int:
        """An answer may be less than this many SYNCs late: half the numbers, so that late and early differ."""
        return self.modulus // 2

    def reachable(self, t_ns: int) -> int:
        """Return the number that a count which restarted after the last SYNC can have reached at a time; 0: none."""
        if self._own or not self.period_ns:
            return 0
        return round((t_ns - self.last_ns) / self.period_ns)

    def step(self, number: int, t_ns: int) -> int:
        """Return the distance of the SYNC with ``number`` (0: none) at ``t_ns`` from the last; RESTARTED if unknown."""
        before, gap_ns = self.number, t_ns - self.last_ns
        number = number if number <= LARGEST else 0
        self.number, self.last_ns = number, t_ns
        self.gap_periods = LARGEST
        if not number or not before:
            return 1 if number == before else RESTARTED
        steps = (number - before) % self.modulus
        if self.period_ns or steps == 1:
            self.gap_periods = round(gap_ns / (self.period_ns or gap_ns or 1))
        if steps == 1:
            self.period_ns = gap_ns
        if number > self.modulus:
            self.modulus = LARGEST
            return RESTARTED
        if self._own:
            return steps or RESTARTED
        # A count that restarted within the gap has reached at most the periods of the gap.
        restart, periods = number <= self.gap_periods + 1, self.gap_periods
        in_time = abs(periods - steps) <= (0 if restart else max(1, steps // 4))
        if 1 <= steps <= max(self.window, 1) and (in_time or (steps == 1 and not restart)):
            return steps
        if number == 1 and periods == 1 and before > 1:
            if before == self._ended:
                self.modulus = before
            self._ended = before
        return RESTARTED
