"""Gauges on Linux Industrial I/O converters as a node's source: counts, or a fault (2124h), and never a stale value.

No data (bit 8): a device that is removed, does not respond or has another scale than at first, or scans that do not
arrive; it is opened again when it returns. Frozen (bit 9): time stamps do not increase. Wire break (bit 10): a gauge
stays at an end of the range. Supply (bit 11): a channel outside its tolerance. Another board: by iiod, with a limit."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

from canopen_device.running.loop import now_us
from tipforce.dictionary import table
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.fingertip.source import Reading, Source
from tipforce.sources.iio_sysfs import PolledDevice, TimestampError

_LOG = logging.getLogger(__name__)
WATCH_US = 40_000  # between two checks if no SYNC takes samples
SILENT_US = 80_000  # time-out of a buffer that delivers no scan
RETRY_US = 100_000  # between two attempts to open a lost device again
WIRE_BREAK_US = 1_000_000  # a gauge at an end of the range for this time has a broken wire
TEMPERATURE_US = 1_000_000
NO_DATA, FROZEN = 1 << table.FAULT_NO_DATA, 1 << table.FAULT_FROZEN
WIRE_BREAK, SUPPLY = 1 << table.FAULT_WIRE_BREAK, 1 << table.FAULT_SUPPLY


class IioSource(Source):
    """The channels of devices, in the order of the gauges; counts lie between ``ends``. ``supply_fault`` is called
    every 40 ms: whether the supply is out of tolerance. ``clock`` measures the duration of a read."""

    watch_us = WATCH_US

    def __init__(
        self, parts: Sequence[PolledDevice], gauges: int, converter: table.Converter, ends: tuple[int, int],
        supply_fault: Callable[[], bool] | None = None, scan_period_us: int = 0, clock: Callable[[], int] = now_us,
    ) -> None:  # fmt: skip
        self.parts = list(parts)
        self.converter = converter
        self.count_min, self.count_max = ends
        self._polled = all(part.polled for part in parts)
        self._silent_us = max(SILENT_US, 3 * scan_period_us)
        self._supply_fault = supply_fault
        self._clock = clock
        self._done_us = 0
        self._conversion = -1
        self._fresh: list[tuple[int, ...] | None] = [None] * len(parts)
        self._retry_us: list[int | None] = [None] * len(parts)  # of a lost device: when to retry
        self._held: Reading | None = None
        self._read_us: int | None = None
        self._inside_us: list[int | None] = [None] * gauges
        self._temperature, self._temperature_us = table.UNKNOWN_I16, -TEMPERATURE_US
        self._supply, self._supply_us = 0, -WATCH_US

    def read(self, now_us: int) -> Reading | None:
        """Return the counts of all gauges once every device has new ones; else None, with the reason in ``faults``."""
        held, self._held = self._held, None
        if self._polled:
            conversion = now_us // self.period_us
            if conversion == self._conversion:
                return held
            self._conversion = conversion
        counts = self._counts(now_us)
        self._done_us = self._clock()
        if counts is None:
            return None if self.faults else held
        self._read_us, self.faults = now_us, 0
        if self._supply_fault is not None and now_us - self._supply_us >= WATCH_US:
            self._supply_us = now_us
            self._supply = SUPPLY if self._supply_fault() else 0
        faults = self._supply | self._wire_state(counts, now_us)
        if now_us - self._temperature_us >= TEMPERATURE_US:  # of the first sensor: some converters pause for it
            self._temperature_us = now_us
            known = (value for part in self.parts if (value := part.temperature()) != table.UNKNOWN_I16)
            self._temperature = next(known, table.UNKNOWN_I16)
        return Reading(counts, faults, self._temperature)

    def due_us(self, now_us: int) -> int:
        """Return the time of the next conversion, not before the end of the last read: slow reads must not queue up."""
        return max(now_us + self.period_us, self._done_us)

    def look(self, now_us: int) -> int | None:
        """Return the present faults, saturated gauges included; None if there is nothing new. The reading is kept."""
        reading = self.read(now_us)
        if reading is None:
            return self.faults or None
        self._held = reading
        at_end = [not self.count_min < count < self.count_max for count in reading.counts]
        return int(reading.faults) | sum(saturated << k for k, saturated in enumerate(at_end))

    def close(self) -> None:
        """Stop all captures."""
        for part in self.parts:
            part.close()

    def _counts(self, now_us: int) -> tuple[int, ...] | None:
        if self._read_us is None:
            self._read_us = now_us  # the time-out starts with the first call
        faults = 0
        for k, fresh in enumerate(self._fresh):
            if fresh is None or self._polled:
                faults |= self._ask(k, now_us)
        if any(fresh is None for fresh in self._fresh):
            silent = now_us - self._read_us > self._silent_us
            self.faults = faults or self.faults & FROZEN or (NO_DATA if silent else 0)
            if faults:
                self._fresh = [None] * len(self.parts)  # counts of the other devices are stale when this device returns
            return None
        counts = tuple([count for fresh in self._fresh if fresh is not None for count in fresh])
        self._fresh = [None] * len(self.parts)
        return counts

    def _ask(self, k: int, now_us: int) -> int:
        part = self.parts[k]
        self._fresh[k] = None
        lost_until_us = self._retry_us[k]
        try:
            if lost_until_us is not None:
                if now_us < lost_until_us:
                    return NO_DATA
                part.reopen()
            fresh = part.read(now_us)
            if now_us - self._temperature_us >= TEMPERATURE_US:
                part.check_scales()
            self._fresh[k] = fresh
        except TimestampError as error:
            if not self.faults & FROZEN:
                _LOG.warning("%s: %s; its readings are not used", part.name, error.strerror)
            return FROZEN
        except OSError as error:
            if lost_until_us is None:
                _LOG.warning("%s: %s; the node continues when the device is back", part.name, error.strerror or error)
            self._retry_us[k] = now_us + RETRY_US
            return NO_DATA
        if lost_until_us is not None:
            _LOG.warning("%s: back", part.name)
            self._retry_us[k] = None
        return 0

    def _wire_state(self, counts: Sequence[int], now_us: int) -> int:
        broken = 0
        for k, (count, since_us) in enumerate(zip(counts, self._inside_us, strict=True)):
            if since_us is None or self.count_min < count < self.count_max:
                self._inside_us[k] = now_us
            elif now_us - since_us >= WIRE_BREAK_US:
                broken = WIRE_BREAK
        return broken


TIMEOUT_MS = 50


class RemoteDevice(PolledDevice):
    """Channels of one device of a remote context. Raises EnvironmentLackError without pylibiio or a response."""

    def __init__(self, uri: str, device: str, channels: Sequence[str]) -> None:
        self.name = f"{uri}/{device}"
        self._uri, self._device, self.channels = uri, device, tuple(channels)
        self._inputs: dict[str, Any] = {}
        self._scales = {}
        try:
            self._connect()
        except OSError as error:
            raise EnvironmentLackError(
                f"iio {uri}: {error.strerror or error}; check that iiod runs there: `iio_info -u {uri}`"
            ) from error

    def reopen(self) -> None:
        """Connect again. Raises OSError while that fails, or while the device or a channel is missing."""
        try:
            self._connect()
        except InputError as error:
            raise FileNotFoundError(2, str(error)) from None

    def _connect(self) -> None:
        try:
            import iio
        except (ImportError, OSError) as error:  # the binding raises OSError without the C library
            raise EnvironmentLackError(
                "iio:ip:...: needs pylibiio and libiio: `pip install 'tipforce[iio]'` and `apt-get install libiio0`"
            ) from error
        context = iio.Context(self._uri)
        context.set_timeout(TIMEOUT_MS)
        device = context.find_device(self._device)
        if device is None:
            there = ", ".join(str(present.name or present.id) for present in context.devices) or "none"
            raise InputError(f"iio {self.name}: no such device; allowed: {there}")
        inputs = {channel.id: channel for channel in device.channels if not channel.output}
        names = self.channels or tuple(sorted(name for name in inputs if name.startswith("voltage")))
        missing = [name for name in names if name not in inputs]
        if missing or not names:
            raise InputError(f"iio {self.name}: no channel {missing or 'voltage'}; allowed: {', '.join(inputs)}")
        self._inputs, self.channels = inputs, names
        self._temperature = next((name for name in sorted(inputs) if name.startswith("temp")), None)

    def read(self, _now_us: int) -> tuple[int, ...] | None:
        """Return the counts of all channels. Raises OSError, also for a value that is no number."""
        try:
            return tuple([int(self._inputs[name].attrs["raw"].value) for name in self.channels])
        except ValueError:
            raise OSError(5, "raw holds no number") from None

    def attribute(self, channel: str, name: str) -> float | None:
        """Return such as ``scale`` of a channel, None if it has none. Raises OSError."""
        attrs = self._inputs[channel].attrs
        try:
            return float(attrs[name].value) if name in attrs else None
        except ValueError:
            raise OSError(5, f"{name} holds no number") from None

    def close(self) -> None:
        """Close the connection."""
        self._inputs, self._temperature = {}, None
