"""CiA 404 interrupts (6133h to 6136h): which channels changed enough to send an event-driven TPDO."""

from tipforce.dictionary import indices, table

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from tipforce.device.node import Device

_ON_SYNC_AFTER_EVENT, _EVENT_DRIVEN = 0, 254
_CHANNEL_VALUES = (
    indices.PROCESS_VALUE,
    indices.PROCESS_VALUE + table.INT16_FORM,
    indices.PROCESS_VALUE + table.INT32_FORM,
)
_LIMITS = (indices.INTERRUPT_LOWER, indices.INTERRUPT_UPPER, indices.INTERRUPT_HYSTERESIS)
_INSIDE, _BELOW, _ABOVE, _UNKNOWN = 0, -1, 1, 2


class Interrupts:
    """Compares each latched sample with what was sent last.

    A TPDO of type 254 or 255 (or 0: with a SYNC) that maps a channel is sent when the channel moved by 6133h or more
    (0: off), left or re-entered 6134h..6135h (with hysteresis 6136h; limits at their defaults are off), or became
    known or unknown.
    """

    __slots__ = ("_device", "_sent", "_value", "_zones", "watched")

    def __init__(self, device: "Device", value: "Callable[[int], float]") -> None:
        self._device = device
        self._value = value
        self.watched: "dict[int, list[int]]" = {}  # channel -> numbers of the TPDOs that carry it
        self._sent: "dict[int, float]" = {}
        self._zones: "dict[int, int]" = {}

    def load(self) -> None:
        """Find the channels to watch; called when settings or PDOs may have changed."""
        self.watched = {}
        for number, transmission, keys in self._device.tpdos.mapped():
            if transmission == _ON_SYNC_AFTER_EVENT or transmission >= _EVENT_DRIVEN:
                for index, sub in keys:
                    if index in _CHANNEL_VALUES and self._configured(sub):
                        self.watched.setdefault(sub, []).append(number)

    def check(self) -> None:
        """Compare the present sample; ask for the TPDOs of the channels that have something to say."""
        for sub, numbers in self.watched.items():
            value = self._value(sub)
            zone = self._zone(sub, value)
            moved = self._moved(sub, value)
            if moved or zone != self._zones.get(sub):
                self._sent[sub] = value
                self._zones[sub] = zone
                for number in numbers:
                    self._device.tpdos.request(number)

    def _moved(self, sub: int, value: float) -> bool:
        delta = self._setting(indices.INTERRUPT_DELTA, sub)
        last = self._sent.get(sub)
        return delta > 0.0 and last is not None and abs(value - last) >= delta

    def _zone(self, sub: int, value: float) -> int:
        """Where a value lies; a value inside by less than the hysteresis stays where it was."""
        if value != value:  # noqa: PLR0124 (true for NaN alone)
            return _UNKNOWN
        lower, upper, hysteresis = [self._setting(index, sub) for index in _LIMITS]
        before = self._zones.get(sub, _INSIDE)
        if value < lower or (before == _BELOW and value < lower + hysteresis):
            return _BELOW
        if value > upper or (before == _ABOVE and value > upper - hysteresis):
            return _ABOVE
        return _INSIDE

    def _configured(self, sub: int) -> bool:
        low, high = [self._device.od.default(index, sub) for index in _LIMITS[:2]]
        delta, (lower, upper, _) = self._setting(indices.INTERRUPT_DELTA, sub), [self._setting(k, sub) for k in _LIMITS]
        return delta > 0.0 or lower > low or upper < high  # type: ignore[operator]

    def _setting(self, index: int, sub: int) -> float:
        return float(self._device.od.values[index << 8 | sub])
