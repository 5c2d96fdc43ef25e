"""The numbers that SYNCs carry (CiA 301, 7.2.5.3): the distance between two of them, and where a count restarts."""

from __future__ import annotations

LARGEST = 240
"""Largest value of 1019h: the numbers are 1 to 1019h."""

RESTARTED = 0


class SyncNumbers:
    """Compare the numbers of consecutive SYNCs. ``modulus`` is the producer's overflow value, as far as it is known.

    With ``own`` the host itself sends the SYNC: its count never restarts, so a gap means SYNCs that were not received.
    """

    def __init__(self, own: bool = False) -> None:
        self._own = own
        self.modulus = LARGEST
        self.number = 0
        """Number of the last SYNC; 0 for one without a number, and before the first."""
        self.last_ns = 0
        self._period_ns = 0

    @property
    def window(self) -> int:
        """An answer may be less than this many SYNCs late: half the numbers, so that late and early differ."""
        return self.modulus // 2

    def step(self, number: int, t_ns: int) -> int:
        """Return the distance of the SYNC with ``number`` (0: none) at ``t_ns`` from the last; RESTARTED if unknown."""
        before, gap_ns = self.number, t_ns - self.last_ns
        number = number if number <= LARGEST else 0
        self.number, self.last_ns = number, t_ns
        if not number or not before:
            return 1 if number == before else RESTARTED
        periods = round(gap_ns / self._period_ns) if self._period_ns else 1
        if number > self.modulus:
            self.modulus = LARGEST
            return RESTARTED
        if number == 1 and before != self.modulus and before > 1 and periods == 1 and not self._own:
            self.modulus = before  # the end of its count, or a restart
            return RESTARTED
        steps = (number - before) % self.modulus
        if steps == 1:
            self._period_ns = gap_ns
        elif not self._own and (not 1 < steps <= self.window or abs(periods - steps) > max(1, steps // 4)):
            return RESTARTED
        return steps or RESTARTED
