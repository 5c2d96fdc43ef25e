"""Where gauge readings come from: what every source offers to the application."""

from collections import namedtuple

# counts: one integer per gauge; faults: bits of 2124h from 8 up; temperature: 0.01 degC or -0x8000 for unknown.
Reading = namedtuple("Reading", ("counts", "faults", "temperature"))


class Source:
    """A gauge source, by default with a 16-bit converter of 10 counts per microstrain.

    ``period_us`` is the time between its conversions, set by 6114h. ``converter`` is (bits, counts per microstrain):
    what the node's dictionary follows (see ``dictionary.table``). A reading at ``count_max`` or ``count_min``, the
    converter's ends, is saturated.
    """

    period_us = 500
    converter = (16, 10.0)
    count_max, count_min = 32767, -32768

    def read(self, now_us: int) -> "Reading | None":
        """The newest reading at ``now_us``, or None when there was none since the last call.

        With a filter (61A0h) ``now_us`` may lie a little in the past, where the node makes up for conversions that
        its loop came too late for; it never goes back.
        """
        raise NotImplementedError

    def due_us(self, now_us: int) -> int:
        """When the first conversion after ``now_us`` is there; asked for only with a filter (61A0h)."""
        return now_us + self.period_us


def convert(exact: float, lowest: int, highest: int) -> int:
    """Round to the nearest count; a converter stays at its end beyond it, and for a signal that is no number."""
    if exact < highest:
        return lowest if exact <= lowest else round(exact)
    return highest
