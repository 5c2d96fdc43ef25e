"""The channel objects of CiA 404 (6xxxh, 7xxxh, 9xxxh): one value each, in three forms."""

import struct
from math import sqrt

from canopen_device.core import codes
from canopen_device.core.object_dictionary import encode, real32
from tipforce.dictionary import indices, table
from tipforce.sensor.contact import scalar

from .sample import outside

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from canopen_device.core.object_dictionary import ObjectDictionary, Value

    from .calibration import Active
    from .node import Fingertip

MAX_I16, MAX_I32 = 0x7FFF, 0x7FFFFFFF
NOT_VALID, OVERLOAD_HIGH, OVERLOAD_LOW = 1, 3, 5  # 6150h
_HALF_TURN = 18000  # of an angle, in 0.01 degree
# Of the integer forms: from the REAL32 index to that of the form, and its range.
_FORMS = ((table.INT16_FORM, MAX_I16, table.UNKNOWN_I16), (table.INT32_FORM, MAX_I32, table.UNKNOWN_I32))
_STATUS_AND_COUNTER = [(indices.STATUS, 0), (indices.COUNTER, 0)]
_INT16_VALUE = indices.PROCESS_VALUE + table.INT16_FORM
_SCALING = (
    indices.SCALING_1_FIELD, indices.SCALING_1_PROCESS, indices.SCALING_2_FIELD, indices.SCALING_2_PROCESS,
    indices.PROCESS_OFFSET,
)  # fmt: skip
_INTERRUPTS = (
    indices.INTERRUPT_DELTA, indices.INTERRUPT_LOWER, indices.INTERRUPT_UPPER, indices.INTERRUPT_HYSTERESIS,
)  # fmt: skip
_SPAN = (indices.SPAN_START, indices.SPAN_END)
_FIELD_SETTINGS = (indices.SCALING_1_FIELD, indices.SCALING_2_FIELD)  # in counts: no decimal digits in integer forms
_FILTER = (indices.FILTER_TYPE, indices.FILTER_CONSTANT)


class Channels:
    """Process values, status and settings of each channel. ``spans`` is empty where no gauge can leave its span."""

    def __init__(self, od: "ObjectDictionary", n: int, fingertip: "Fingertip") -> None:
        self._od = od
        self._n = n
        self._fingertip = fingertip
        self._per_unit = [10.0 ** channel[3] for channel in table.channels(n)]
        self.scaling: "list[tuple[float, float]]" = []
        self.spans: "list[tuple[float, float]]" = []
        od.readers[indices.PROCESS_VALUE] = self.exact
        od.packer = self.packer
        od.readers[indices.CHANNEL_STATUS] = self._status
        od.readers[indices.FIELD_VALUE] = lambda sub: self._counts(sub, scalar.NAN)
        for beyond, highest, unknown in _FORMS:
            # The live integer objects of this form: views of the REAL32 values.
            od.readers[beyond + indices.FIELD_VALUE] = lambda sub, u=unknown: self._counts(sub, u)  # type: ignore[misc]
            od.readers[beyond + indices.PROCESS_VALUE] = lambda sub, h=highest, u=unknown: (  # type: ignore[misc]
                self._integer(self.exact(sub), sub, h, u)
            )
        od.views = self._read_view, self._write_view
        for index in _SCALING + _SPAN:
            od.writers[index] = self._writer(index, self.load)
        for index in _INTERRUPTS:
            od.writers[index] = self._writer(index, fingertip.on_settings)
        od.writers[indices.SAMPLE_PERIOD_US] = self._write_period
        od.writers[indices.AUTOZERO] = lambda sub, value: (
            fingertip.zero([sub - 1]) if value == table.SIGNATURE_ZERO else codes.NOT_TRANSFERRED
        )
        for index in _FILTER:
            od.writers[index] = lambda _sub, value, i=index: self._write_filter(i, value)  # type: ignore[misc]
        self.load()

    def _counts(self, sub: int, unknown: "int | float") -> "int | float":
        """x100h: what the converter gave last, saturated or not; unknown once it is stale."""
        reading = self._fingertip.sample.reading
        if reading is None or self._fingertip.sample.stale:
            return unknown
        counts: "tuple[int, ...]" = reading.counts
        return counts[sub - 1]

    def exact(self, sub: int) -> float:
        """The value of a channel in the unit of 6131h, in double precision; NaN where it may not be shown."""
        sample = self._fingertip.sample
        return (sample.values if sub <= len(sample.values) else sample.find_values(sub))[sub - 1]

    def _overload(self, sub: int) -> int:
        sample = self._fingertip.sample
        live = sub <= self._n and not sample.unknown_early() & scalar.UNKNOWN_GAUGES
        return sample.overloads[sub - 1] if live else 0

    def packer(self, keys: "list[tuple[int, int]]") -> "Callable[[], bytes] | None":
        """Return what packs three consecutive channels as INTEGER16 with 2120h and 2121h; None for other mappings."""
        index, first = keys[0] if keys else (0, 0)
        if index != _INT16_VALUE or keys != [(index, first + k) for k in range(3)] + _STATUS_AND_COUNTER:
            return None
        fingertip, unknown = self._fingertip, table.UNKNOWN_I16
        start, second, third, last = first - 1, first, first + 1, first + 2
        unit_1, unit_2, unit_3 = self._per_unit[start:last]
        # No angle that would be rounded to -180 degrees, which is 180.
        low_1, low_2, low_3 = [0.5 - _HALF_TURN if k > self._n + 4 else -MAX_I16 for k in (first, first + 1, last)]

        def pack() -> bytes:  # a closure over what does not change: two of these fill the PDOs of each SYNC
            sample = fingertip.sample
            status = sample.known_status
            if status < 0:
                status = sample.status()
            values = sample.values
            if len(values) < last:
                values = sample.find_values(last)
            x, y, z = values[start] * unit_1, values[second] * unit_2, values[third] * unit_3
            if low_1 < x < MAX_I16 and low_2 < y < MAX_I16 and low_3 < z < MAX_I16:
                x, y, z = round(x), round(y), round(z)
            else:
                x, y, z = [self._integer(values[k], k + 1, MAX_I16, unknown) for k in range(start, last)]
            return struct.pack("<hhhBB", x, y, z, status, sample.counter)

        return pack

    def _integer(self, value: float, sub: int, highest: int, unknown: int) -> int:
        if value == value:  # noqa: PLR0124 (false for NaN alone)
            raw = self._to_integer(value, self._per_unit[sub - 1], highest)
            # An angle lies in (-180, 180]: one that rounding brings to -180 is 180.
            return -raw if raw == -_HALF_TURN and sub > self._n + 4 else raw
        over = self._overload(sub)
        return highest * over if over else unknown

    def _to_integer(self, value: float, per_unit: float, highest: int) -> int:
        scaled = value * per_unit
        if scaled >= highest:
            return highest
        return -highest if scaled <= -highest else round(scaled)

    def _status(self, sub: int) -> int:
        """6150h: valid, or why not. A value outside its span, or that INTEGER16 cannot hold, counts as an overload."""
        value, sample = self.exact(sub), self._fingertip.sample
        if value == value:  # noqa: PLR0124
            scaled = value * self._per_unit[sub - 1]
            over = (scaled > MAX_I16) - (scaled < -MAX_I16) or outside(value, *self._span(sub))
            if not over and sub <= self._n and sample.lost >> sub - 1 & 1:
                return NOT_VALID  # a gauge that is left out: its reading is shown all the same
            return (0, OVERLOAD_HIGH, OVERLOAD_LOW)[over]
        if sample.overloaded and self._n < sub <= self._n + 4 and not sample.hidden():
            force = sample.force()[sub - self._n - 1] if sub <= self._n + 3 else 1.0
            return OVERLOAD_LOW if force < 0.0 else OVERLOAD_HIGH
        return (NOT_VALID, OVERLOAD_HIGH, OVERLOAD_LOW)[self._overload(sub)]

    def load(self) -> None:
        """Take scaling (6120h-6124h) and span of the gauges, and set the sample period of the source."""
        values, gains = self._od.values, []
        for sub in range(1, self._n + 1):
            if values[indices.SCALING_1_FIELD << 8 | sub] == values[indices.SCALING_2_FIELD << 8 | sub]:
                # No write leaves two scaling points at one field value, but a store of another making may.
                for index in _SCALING[:4]:
                    values[index << 8 | sub] = self._od.default(index, sub)
            f1, p1, f2, p2, offset = [values[index << 8 | sub] for index in _SCALING]
            gain = (p2 - p1) / (f2 - f1)  # type: ignore[operator]
            gains.append((gain, p1 - gain * f1 + offset))  # type: ignore[operator]
        self.scaling = gains
        self.spans = [self._span(sub) for sub in range(1, self._n + 1)]
        lowest, highest = self._fingertip.ends
        reach = [
            outside(gain * counts + bias, start, end)
            for (gain, bias), (start, end) in zip(gains, self.spans)  # noqa: B905 (not in MicroPython)
            for counts in (lowest + 1, highest - 1)
        ]
        if not any(reach):
            self.spans = []  # nothing is outside but what is at the converter's end, which is saturated anyway
        self._fingertip.source.period_us = values[indices.SAMPLE_PERIOD_US << 8 | 1]  # type: ignore[assignment]

    def _span(self, sub: int) -> "tuple[float, float]":
        start, end = [self._od.values[index << 8 | sub] for index in _SPAN]
        return start, end  # type: ignore[return-value]

    def one_filter(self) -> None:
        """No write leaves a filter that is not offered or not that of all gauges, but a store of another making may."""
        values = self._od.values
        for index in _FILTER:
            for sub in range(2, self._n + 1):
                values[index << 8 | sub] = values[index << 8 | 1]
        kind, constant = [values[index << 8 | 1] for index in _FILTER]
        if self._filter_abort(kind, constant):  # type: ignore[arg-type]
            for index in _FILTER:
                for sub in range(1, self._n + 1):
                    values[index << 8 | sub] = self._od.default(index, sub)

    def noise_counts(self, gauge: int, active: "Active | None") -> float:
        """Standard deviation of a gauge's noise in counts as the calibration states it; 0 when unknown."""
        if active is None:
            return 0.0
        diagonal = gauge * self._n - gauge * (gauge - 1) // 2
        variance = active.noise[diagonal]
        strain_per_count = abs(self.scaling[gauge][0] * 1e-6)  # 0 where both scaling points have one process value
        return sqrt(variance) / strain_per_count if variance > 0.0 and strain_per_count > 0.0 else 0.0

    def zero(self, gauges: "range | list[int]", counts: "Sequence[float]") -> int:
        """Choose the offsets x124h with which gauges (from 0) read zero at ``counts``; all of them, or none."""
        offsets: "dict[int, float]" = {}
        for k in gauges:
            gain, bias = self.scaling[k]
            key = indices.PROCESS_OFFSET << 8 | k + 1
            before: float = self._od.values[key]  # type: ignore[assignment]
            offsets[key] = offset = real32(before - (gain * counts[k] + bias))
            if offset - offset != 0.0:
                return codes.DEVICE_STATE  # with this scaling no REAL32 brings the gauge to zero
        self._od.values.update(offsets)
        self._od.edited = True
        self.load()
        return 0

    def _writer(self, index: int, apply: "Callable[[], None]") -> "Callable[[int, Value], int]":
        other = _FIELD_SETTINGS[index == _FIELD_SETTINGS[0]]

        def write(sub: int, value: "Value") -> int:
            if index in _FIELD_SETTINGS and value == self._od.values[other << 8 | sub]:
                return codes.INVALID_VALUE  # two scaling points at one field value make no line
            self._od.values[index << 8 | sub] = value
            apply()
            return 0

        return write

    def _read_view(self, index: int, sub: int) -> "Value":
        real, per_unit = self._real(index, sub)
        value: float = self._od.values[real << 8 | sub]  # type: ignore[assignment]
        return self._to_integer(value, per_unit, MAX_I16 if index - real == table.INT16_FORM else MAX_I32)

    def _write_view(self, index: int, sub: int, value: "Value") -> int:
        if value == self._read_view(index, sub):
            return 0  # what a client read: the digits that this form does not show stay
        real, per_unit = self._real(index, sub)
        return self._od.download(real, sub, encode("f", float(value) / per_unit))

    def _real(self, index: int, sub: int) -> "tuple[int, float]":
        real = index & 0xFFF | indices.FIELD_VALUE & 0xF000
        return real, 1.0 if real in _FIELD_SETTINGS else self._per_unit[sub - 1]

    def _write_period(self, _sub: int, value: "Value") -> int:
        # One converter serves all gauges: the period of one channel is that of all.
        for sub in range(1, self._n + 7):
            self._od.values[indices.SAMPLE_PERIOD_US << 8 | sub] = value
        self._fingertip.source.period_us = value  # type: ignore[assignment]
        if self._fingertip.filtering is not None:
            self._fingertip.load_filter()
        return 0

    def _write_filter(self, index: int, value: "Value") -> int:
        # A force from gauges that are filtered differently would be wrong while it changes: one filter for all.
        kind, constant = [value if index == of else self._od.values[of << 8 | 1] for of in _FILTER]
        abort = self._filter_abort(kind, constant)  # type: ignore[arg-type]
        if abort:
            return abort if index == indices.FILTER_TYPE else codes.TOO_HIGH
        for sub in range(1, self._n + 1):
            self._od.values[index << 8 | sub] = value
        self._fingertip.load_filter()
        return 0

    def _filter_abort(self, kind: int, constant: int) -> int:
        if not kind:
            return 0
        from . import filters  # a node without a filter does without

        return 0 if filters.offered(kind, constant) else codes.INVALID_VALUE
