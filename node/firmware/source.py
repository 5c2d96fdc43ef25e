"""Gauges on converter chips as the node's gauge source: chips are polled without waiting."""

from tipforce.dictionary import table
from tipforce.fingertip.source import Reading, Source

WIRE_BREAK_US = 1000000  # a gauge at an end of the range for this time has a broken wire
CONVERSIONS_LOST = 4  # a chip without a conversion for so many periods is restarted
SUPPLY = 1 << table.FAULT_SUPPLY

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator

    Steps = Iterator[tuple[int, ...] | None]


class Chip:
    """A converter of 24 bits: ``period_us`` of a whole reading, ``faults`` of 2124h, ``temperature`` in 0.01 degC.

    A driver is the generator ``_run``: it resets the chip, and each ``yield`` ends a step, with the counts of all
    channels or None. An OSError in it, also one of the bus, starts it again after ``_retry_us``."""

    bits, count_min, count_max = 24, -0x800000, 0x7FFFFF
    channels = 1
    period_us = 0
    faults = 0
    temperature = table.UNKNOWN_I16
    _now_us = _next_us = 0  # of this step, and of the next one at the earliest
    _retry_us = 20000
    _steps: "Steps | None" = None

    def poll(self, now_us: int) -> "tuple[int, ...] | None":
        """Run one small step; return the counts of all channels if there are new ones."""
        if now_us < self._next_us:
            return None
        self._now_us = now_us
        try:
            if self._steps is None:
                self._steps = self._run()
            return next(self._steps)
        except OSError:
            self._steps, self._next_us = None, now_us + self._retry_us
        return None

    def _run(self) -> "Steps":
        raise NotImplementedError


class Gauges(Source):
    """One or more chips; the gauges are in the order of the chips and of their channels.

    ``counts_per_microstrain`` combines bridge, gauge factor, gain and reference: the default of 6122h, which a
    calibration replaces. A reading needs a new conversion of every chip; without one the core reports no data (2124h
    bit 8) after 100 ms. Raises ValueError without chips, or for chips of unequal ranges."""

    def __init__(self, chips: "list[Chip]", counts_per_microstrain: float) -> None:
        if not chips:
            raise ValueError("chips: none")
        first = chips[0]
        for chip in chips:
            if (chip.bits, chip.count_min, chip.count_max) != (first.bits, first.count_min, first.count_max):
                raise ValueError("chips: not all have one range")
        self.chips = chips
        self.n = sum([chip.channels for chip in chips])
        self.converter = (first.bits, counts_per_microstrain)
        self.count_min, self.count_max = first.count_min, first.count_max
        self.conversion_us = max([chip.period_us for chip in chips])
        self._wanted_us = self.conversion_us
        self._fresh: "list[tuple[int, ...] | None]" = [None] * len(chips)
        self._inside_us = [0] * self.n

    @property
    def period_us(self) -> int:
        """The sample period 6114h, but never shorter than the chips allow."""
        return max(self._wanted_us, self.conversion_us)

    @period_us.setter
    def period_us(self, value: int) -> None:
        self._wanted_us = value

    def poll(self, now_us: int) -> None:
        """Poll the chips; the loop calls this in each pass."""
        for k, chip in enumerate(self.chips):
            counts = chip.poll(now_us)
            if counts is not None:
                self._fresh[k] = counts

    def read(self, now_us: int) -> "Reading | None":
        """Return the newest counts of all gauges once every chip has new ones."""
        self.poll(now_us)
        counts: "list[int]" = []
        faults, temperature = 0, table.UNKNOWN_I16
        for k, chip in enumerate(self.chips):
            fresh = self._fresh[k]
            if fresh is None:
                return None
            counts += fresh
            faults |= chip.faults
            if chip.temperature != table.UNKNOWN_I16:
                temperature = chip.temperature
        for k, chip in enumerate(self.chips):
            self._fresh[k] = None
            chip.faults = 0
        for k, count in enumerate(counts):
            if self.count_min < count < self.count_max:
                self._inside_us[k] = now_us
            elif now_us - self._inside_us[k] >= WIRE_BREAK_US:
                faults |= 1 << table.FAULT_WIRE_BREAK
        return Reading(tuple(counts), faults, temperature)


def signed24(value: int) -> int:
    """Return the two's complement number of 24 bits."""
    return value - 0x1000000 if value & 0x800000 else value


def choice(name: str, value: int, allowed: "tuple[int, ...]") -> int:
    """Return the index of a setting among those of a chip. Raises ValueError that lists them."""
    if value not in allowed:
        raise ValueError("%s: %r, allowed %s" % (name, value, ", ".join([str(number) for number in allowed])))
    return allowed.index(value)
