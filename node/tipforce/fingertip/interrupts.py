"""Interrupts of CiA 404 (6133h to 6136h): a channel that changed enough sends its TPDOs; loaded when one is set."""

from tipforce.dictionary import indices

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from canopen_device.core.node import Device

_LIMITS = (indices.INTERRUPT_LOWER, indices.INTERRUPT_UPPER, indices.INTERRUPT_HYSTERESIS)
_INSIDE, _BELOW, _ABOVE, _UNKNOWN = 0, -1, 1, 2


class Interrupts:
    """Compares each latched sample with what was sent last.

    A TPDO of type 254 or 255 (or 0: with a SYNC) that maps a channel is sent when the channel moved by 6133h or more
    (0: off), left or re-entered 6134h..6135h (with hysteresis 6136h; limits at their defaults are off), or became known
    or unknown."""

    def __init__(self, device: "Device", value: "Callable[[int], float]") -> None:
        self._device = device
        self._value = value
        self._sent: "dict[int, float]" = {}
        self._zones: "dict[int, int]" = {}

    def check(self, channels: "dict[int, list[int]]") -> None:
        """Compare the present sample; request the TPDOs (their numbers by channel) of channels that changed enough."""
        for sub, numbers in channels.items():
            value = self._value(sub)
            zone = self._zone(sub, value)
            delta, last = self._setting(indices.INTERRUPT_DELTA, sub), self._sent.get(sub)
            moved = delta > 0.0 and last is not None and abs(value - last) >= delta
            if moved or zone != self._zones.get(sub):
                self._sent[sub] = value
                self._zones[sub] = zone
                for number in numbers:
                    self._device.tpdos.request(number)

    def _zone(self, sub: int, value: float) -> int:
        if value != value:  # noqa: PLR0124 (true for NaN alone)
            return _UNKNOWN
        lower, upper, hysteresis = [self._setting(index, sub) for index in _LIMITS]
        before = self._zones.get(sub, _INSIDE)
        if value < lower or (before == _BELOW and value < lower + hysteresis and value <= upper):
            return _BELOW
        if value > upper or (before == _ABOVE and value > upper - hysteresis):
            return _ABOVE
        return _INSIDE

    def _setting(self, index: int, sub: int) -> float:
        return float(self._device.od.values[index << 8 | sub])
