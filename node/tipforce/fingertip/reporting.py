"""What a node reports by itself: EMCY for each fault, TPDOs on a change of 2124h and of 2126h (docs/objects.md)."""

from canopen_device.core import emcy
from canopen_device.core.codes import EVENT_DRIVEN
from tipforce.dictionary import indices, table

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.core.node import Device

    from .sample import Sample


_ON_SYNC_AFTER_EVENT = 0  # a transmission type
_CHANNEL_VALUES = table.forms(indices.PROCESS_VALUE)


def interrupted(device: "Device") -> "dict[int, list[int]]":
    """Return the channels whose interrupts (6133h to 6135h) are set, and the numbers of the event-driven TPDOs that
    carry them."""
    channels: "dict[int, list[int]]" = {}
    limits = indices.INTERRUPT_LOWER, indices.INTERRUPT_UPPER
    for number, transmission, keys in device.tpdos.mapped():
        if transmission == _ON_SYNC_AFTER_EVENT or transmission >= EVENT_DRIVEN:
            for index, sub in keys:
                if index in _CHANNEL_VALUES:
                    low, high = [float(device.od.default(limit, sub)) for limit in limits]
                    delta, lower, upper = [
                        float(device.od.values[index << 8 | sub]) for index in (indices.INTERRUPT_DELTA,) + limits
                    ]
                    if delta > 0.0 or lower != low or upper != high:
                        channels.setdefault(sub, []).append(number)
    return channels


COLDEST, HOTTEST = -2000, 8000  # 0.01 degC; outside, glue and coefficients of the gauges are not specified
HOLD_US = 100000  # a contradiction ends when none was seen for so long: at its limit it comes and goes with the noise
FAULTS_PERIOD_US = 10000  # between two TPDOs that a change of 2124h sends
_CONTRADICTION = 1 << table.FAULT_CONTRADICTION
_GAUGES_TEMPERATURE = 16  # in place of a bit of 2124h
_BY_BIT = {
    table.FAULT_CONTRADICTION: (table.EMCY_FRONT_END, emcy.PROFILE),
    table.FAULT_TEMPERATURE: (table.EMCY_TEMPERATURE, emcy.TEMPERATURE),
    table.FAULT_OVERLOAD: (table.EMCY_OVERLOAD, emcy.PROFILE),
    _GAUGES_TEMPERATURE: (table.EMCY_TEMPERATURE, emcy.TEMPERATURE),
}


class Reports:
    """EMCY and event-driven TPDOs of one node; ``counter`` is 2126h."""

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.reset()
        device.od.changed = self.changed
        device.od.readers[indices.CONFIGURATION_COUNTER] = lambda _sub: self.counter

    def reset(self) -> None:
        """Boot: no error is raised yet, and the counter begins again."""
        self.counter = 0
        self._raised: "dict[int, tuple[int, int]]" = {}  # bit of 2124h -> (code, detail) of its EMCY
        self._contradicted_us = -HOLD_US
        self._next_us = 0

    def changed(self) -> None:
        """What is sent, or what it means, is another thing now: count, and say so before the first PDO of it."""
        self.counter = (self.counter + 1) & 0xFF
        self._device.tpdos.announce(indices.CONFIGURATION_COUNTER)

    def sampled(self, sample: "Sample", before: int) -> None:
        """A sample was latched; ``before`` is 2124h of the one before."""
        faults, reading = sample.faults, sample.reading
        if reading is None or reading.temperature == table.UNKNOWN_I16:
            out_of_range = _GAUGES_TEMPERATURE in self._raised  # as it was
        else:
            out_of_range = not COLDEST <= reading.temperature <= HOTTEST
        if out_of_range:
            faults |= 1 << _GAUGES_TEMPERATURE
        if faults or self._raised:
            self._report(sample, faults)
        if sample.faults != before:
            self._request_faults()

    def _report(self, sample: "Sample", faults: int) -> None:
        now_us = self._device.now_us
        if faults & _CONTRADICTION:
            self._contradicted_us = now_us
        held = now_us - self._contradicted_us < HOLD_US
        left = 0 if sample.judgement is None else sample.judgement.left_out
        for bit in range(_GAUGES_TEMPERATURE + 1):
            raised = self._raised.get(bit)
            error = _error(bit, sample) if faults >> bit & 1 else None
            if error is None and held and raised is not None and not left:
                if table.FAULT_CONTRADICTION in (bit, raised[1] >> 8):
                    continue  # where another gauge is left out now, that one ends at once
            if raised == error:
                continue
            if raised is not None:
                del self._raised[bit]
                self._device.emcy.cure(raised[0], raised[1])
            if error is not None:
                self._raised[bit] = error
                register = _BY_BIT[bit][1] if bit in _BY_BIT else emcy.PROFILE
                self._device.emcy.raise_error(error[0], register, error[1])

    def _request_faults(self) -> None:
        """Send the TPDOs that map 2124h, at most every FAULTS_PERIOD_US; those of type 0 with the next SYNC."""
        now_us = self._device.now_us
        due_us = self._next_us - FAULTS_PERIOD_US  # the one that is due already, or else was the last
        if due_us <= now_us:
            due_us = max(now_us, self._next_us)
        for number, _transmission, keys in self._device.tpdos.mapped():
            if (indices.FAULTS, 0) in keys:
                self._device.tpdos.request(number, due_us)
                self._next_us = due_us + FAULTS_PERIOD_US


def _error(bit: int, sample: "Sample") -> "tuple[int, int] | None":
    """(EMCY code, detail) of a bit of 2124h. Of a gauge left out: its number, and above it the bit that says why."""
    if bit < table.FAULT_NO_DATA:
        if sample.overloads and sample.overloads[bit]:
            return table.EMCY_GAUGE_SATURATED, bit + 1
        why = table.FAULT_FROZEN if sample.frozen >> bit & 1 else table.FAULT_CONTRADICTION
        return table.EMCY_FRONT_END, why << 8 | bit + 1
    if bit == table.FAULT_BEYOND_CALIBRATED:
        return None
    return (_BY_BIT[bit][0] if bit in _BY_BIT else table.EMCY_FRONT_END), bit % _GAUGES_TEMPERATURE
