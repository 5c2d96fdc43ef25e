"""Where gauge readings come from: what every source offers to the application."""

from collections import namedtuple

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.core.node import Device
    from tipforce.dictionary.table import Converter

# counts: one integer per gauge; faults: bits of 2124h from 8 up; temperature: 0.01 degC or -0x8000 for unknown.
Reading = namedtuple("Reading", ("counts", "faults", "temperature"))


class Source:
    """A gauge source. ``converter``: (bits, counts per microstrain); ``count_min``, ``count_max``: its ends, saturated;
    ``faults``: bits of 2124h without a reading; ``watch_us``: how often to ``look`` without SYNC, 0: not."""

    period_us = 500
    converter: "Converter" = (16, 10.0)
    count_max, count_min = 32767, -32768
    faults = 0
    watch_us = 0
    simulated = False

    def read(self, now_us: int) -> "Reading | None":
        """The newest reading at ``now_us``; None: none since the last call. With a filter (61A0h) ``now_us`` may lie a
        little in the past, for conversions that the node's loop came too late for; it never goes back."""
        raise NotImplementedError

    def look(self, now_us: int) -> "int | None":  # noqa: ARG002
        """New bits of 2124h, None for nothing new; the next ``read`` gives what was seen here."""
        return None

    def due_us(self, now_us: int) -> int:
        """When the first conversion after ``now_us`` is there; asked for only with a filter (61A0h)."""
        return now_us + self.period_us

    def attach(self, device: "Device") -> None:
        """Called once, when the node is built: a source with objects of its own handles their access here."""

    def reset(self, device: "Device") -> None:
        """Called at each reset of the node: objects of its own return to their power-on values."""

    def close(self) -> None:
        """Release what it holds."""


def convert(exact: float, lowest: int, highest: int) -> int:
    """Round to the nearest count; a converter stays at its end beyond it, and for a signal that is no number."""
    if exact < highest:
        return lowest if exact <= lowest else round(exact)
    return highest
