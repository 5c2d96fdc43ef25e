"""Where gauge readings come from: what every source offers to the application."""

from collections import namedtuple

# counts: one integer per gauge; faults: bits of 2124h from 8 up; temperature: 0.01 degC or -0x8000 for unknown.
Reading = namedtuple("Reading", ("counts", "faults", "temperature"))

COUNT_MAX, COUNT_MIN = 32767, -32768  # a 16-bit converter; a reading at either end is saturated


class Source:
    """A gauge source; ``period_us`` is the time between its conversions, set by 6114h."""

    period_us = 500

    def read(self, now_us: int) -> "Reading | None":
        """The newest reading, or None when there was none since the last call."""
        raise NotImplementedError
