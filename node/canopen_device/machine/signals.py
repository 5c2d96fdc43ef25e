"""Values that change on their own: constant, ramp, sine, random walk, recorded in a CSV, or following another value."""

from __future__ import annotations

import bisect
import csv
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from canopen_device.core.object_dictionary import REAL32_MAX
from canopen_device.errors import InputError
from canopen_device.types import Value

if TYPE_CHECKING:
    from canopen_device.eds.description import Entry
    from canopen_device.machine.device import SimulatedDevice


@dataclass
class Signal:
    """A number as a function of time; ``period_s`` is how often it is set."""

    period_s: ClassVar[float] = 0.01

    def _at(self, t_s: float, _device: SimulatedDevice) -> float:
        """Return the value ``t_s`` seconds after the start of the device."""
        raise NotImplementedError


@dataclass
class Ramp(Signal):
    """From ``start`` to ``end`` in ``duration_s``; then it stays, or begins again where ``repeats``."""

    start: float = 0.0
    end: float = 1.0
    duration_s: float = 1.0
    repeats: bool = False

    def _at(self, t_s: float, _device: SimulatedDevice) -> float:
        part = t_s / self.duration_s
        part = part % 1.0 if self.repeats else min(part, 1.0)
        return self.start + (self.end - self.start) * part


@dataclass
class Sine(Signal):
    """``offset`` + ``amplitude`` sin(2 pi (t / ``cycle_s`` + ``phase_deg`` / 360))."""

    amplitude: float = 1.0
    offset: float = 0.0
    cycle_s: float = 1.0
    phase_deg: float = 0.0

    def _at(self, t_s: float, _device: SimulatedDevice) -> float:
        return self.offset + self.amplitude * math.sin(math.tau * (t_s / self.cycle_s + self.phase_deg / 360.0))


@dataclass
class RandomWalk(Signal):
    """Steps of standard deviation ``step``, one each ``every_s``, reflected at ``low`` and ``high``; seeded."""

    start: float = 0.0
    step: float = 1.0
    low: float = -100.0
    high: float = 100.0
    every_s: float = 0.1
    seed: int = 0
    _value: float = field(init=False, repr=False)
    _steps: int = field(init=False, default=0, repr=False)

    def __post_init__(self) -> None:
        self._random, self._value = random.Random(self.seed), self.start

    def _at(self, t_s: float, _device: SimulatedDevice) -> float:
        while self._steps < int(t_s / self.every_s):
            self._steps += 1
            moved = self._value + self._random.gauss(0.0, self.step)
            if moved > self.high:
                moved = 2.0 * self.high - moved
            elif moved < self.low:
                moved = 2.0 * self.low - moved
            self._value = min(max(moved, self.low), self.high)
        return self._value


@dataclass
class Recorded(Signal):
    """Rows of time and value; between two rows the earlier one holds, after the last it stays or begins again."""

    t_s: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    repeats: bool = False

    def _at(self, t_s: float, _device: SimulatedDevice) -> float:
        if self.repeats and self.t_s[-1] > 0.0:
            t_s %= self.t_s[-1]
        return self.values[max(0, bisect.bisect_right(self.t_s, t_s) - 1)]


@dataclass
class Follows(Signal):
    """``gain`` x another value + ``offset``, delayed as a first-order lag of ``lag_s``; limited to the type's range."""

    key: int | tuple[int, int] | str = 0
    gain: float = 1.0
    offset: float = 0.0
    lag_s: float = 0.0
    _value: float = field(init=False, default=math.nan, repr=False)
    _t_s: float = field(init=False, default=0.0, repr=False)

    def _at(self, t_s: float, _device: SimulatedDevice) -> float:
        source = _device[self.key]
        if not isinstance(source, int | float):
            raise InputError(f"follows {self.key!r}: {source!r} is no number")
        target = self.gain * source + self.offset
        if self.lag_s <= 0.0 or math.isnan(self._value):
            self._value = target
        else:
            self._value += (target - self._value) * -math.expm1(-(t_s - self._t_s) / self.lag_s)
        self._t_s = t_s
        return self._value


def _extremes(signal: Signal) -> Sequence[float]:
    """Return the lowest and the highest value, and perhaps others; nothing where the device limits it."""
    match signal:
        case Ramp():
            return signal.start, signal.end
        case Sine():
            return signal.offset - abs(signal.amplitude), signal.offset + abs(signal.amplitude)
        case RandomWalk():
            return signal.low, signal.high
        case Recorded():
            return signal.values
    return ()


class Driver:
    """One entry of a device and the signal that sets it. Raises InputError where they do not fit."""

    def __init__(self, device: SimulatedDevice, entry: Entry, signal: Signal) -> None:
        self._device, self.entry, self.signal = device, entry, signal
        if entry.type.python not in (int, float):
            raise InputError(f"{entry.place} {entry.name!r} is {entry.type.name}: a signal sets numbers only")
        most = REAL32_MAX if entry.letter == "f" else math.inf
        low, high = entry.type.limits or (-most, most)
        self._low, self._high = low, high
        for name, above in (("duration_s", 0.0), ("cycle_s", 0.0), ("every_s", 1e-5)):  # more steps would take all time
            if not getattr(signal, name, 1.0) > above:
                given = getattr(signal, name)
                raise InputError(f"{entry.place} {entry.name!r}: {name} {given}: allowed is above {above:g}")
        ends = _extremes(signal)
        if ends and not (low <= min(ends) and max(ends) <= high):
            raise InputError(
                f"{entry.place} {entry.name!r}: the signal runs from {min(ends):g} to {max(ends):g}; "
                f"{entry.type.name} holds {low} to {high}"
            )
        if isinstance(signal, Follows):
            signal._at(0.0, device)

    def apply(self) -> None:
        """Set the entry to the present value of the signal; an integer has no NaN, and keeps its value."""
        number = min(max(self.signal._at(self._device.now_s, self._device), self._low), self._high)
        is_integer = self.entry.type.python is int
        if is_integer and math.isnan(number):
            return
        value: Value = round(number) if is_integer else float(number)
        self._device.set_value(self.entry, value)


def recorded(path: str | Path, column: str, time_column: str = "t_s", repeats: bool = False) -> Recorded:
    """Return a column of a CSV with a header. Raises InputError for what is missing, or times that go back."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if not rows:
        raise InputError(f"{path}: no row below the header")
    for name in (time_column, column):
        if name not in rows[0]:
            raise InputError(f"{path}: no column {name!r}; there are {', '.join(rows[0])}")
    track = Recorded(repeats=repeats)
    for number, row in enumerate(rows, 2):
        try:
            time_s, value = float(row[time_column]), float(row[column])
        except (TypeError, ValueError):
            raise InputError(
                f"{path}:{number}: {row[time_column]!r}, {row[column]!r}: two numbers are needed"
            ) from None
        if not (math.isfinite(time_s) and math.isfinite(value)) or (track.t_s and time_s < track.t_s[-1]):
            raise InputError(f"{path}:{number}: time {time_s:g}, value {value:g}: finite, and no time before the last")
        track.t_s.append(time_s)
        track.values.append(value)
    return track
