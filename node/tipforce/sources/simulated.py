"""A simulated gauge source: applied load -> gauge strain -> counts, with noise, offset, a front end and faults."""

import math

from canopen_device.core import codes
from tipforce.dictionary import indices, table
from tipforce.fingertip.source import Reading, Source, convert

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from canopen_device.core.node import Device
    from canopen_device.core.object_dictionary import Value

    from .front_end import FrontEnd

    Forces = tuple[float, float, float]  # F1, F2, F3 in newtons

STUCK, OPEN, SATURATED, SILENT, DRIFT = 1, 2, 3, 4, 5  # values of 2200h:1
_ROOM_TEMPERATURE = 2300  # 0.01 degC


class SimulatedSource(Source):
    """Gauges of a structure, ``strain_per_newton`` (n, 3) as rows, under ``load``, or under ``forces``: F1, F2, F3 in
    newtons at a conversion, then 2201h is rejected. Without noise no random numbers; temperature in 0.01 degC."""

    simulated = True

    def __init__(
        self, strain_per_newton: "Sequence[Sequence[float]]", noise_microstrain: float = 0.0,
        offset_microstrain: "Sequence[float] | None" = None, seed: int = 0, temperature: int = _ROOM_TEMPERATURE,
        front_end: "FrontEnd | None" = None, forces: "Callable[[int], Forces] | None" = None,
    ) -> None:  # fmt: skip
        self.rows = [tuple([float(x) for x in row]) for row in strain_per_newton]
        self.noise_microstrain = noise_microstrain
        self.offset_microstrain = list(offset_microstrain) if offset_microstrain else [0.0] * len(self.rows)
        self.temperature = temperature
        self.load = (0.0, 0.0, 0.0)  # P newtons, phi degree, theta degree
        self.fault = 0
        self.fault_gauge = 1
        self.fault_magnitude = 0.0  # DRIFT: microstrain per second
        self._fault_by_bus = False  # by 2200h
        self._load_by_bus: "tuple[float, float, float] | None" = None  # by 2201h, in place of ``_own_load``
        self._own_load = self.load
        self.forces = forces
        self.front_end = front_end
        if front_end is not None:
            self.converter = front_end.converter
            self.count_max, self.count_min = front_end.count_max, front_end.count_min
        self._gauss: "Callable[[float, float], float]" = lambda _mean, _deviation: 0.0
        if noise_microstrain:
            import random  # imported only if there is noise

            self._gauss = random.Random(seed).gauss
        self._conversion = -1
        self._fault_since_us = 0
        self._last_counts = (0,) * len(self.rows)
        self._resolved = self.load, self._strained(force_of(self.load))

    def set_fault(self, fault: int, gauge: int, magnitude: float, now_us: int) -> None:
        """Inject a fault of 2200h into ``gauge`` (from 1) from now on; fault 0 ends it."""
        if fault != self.fault:
            self._fault_since_us = now_us
        self._fault_by_bus = False
        self.fault, self.fault_gauge, self.fault_magnitude = fault, gauge, magnitude

    def read(self, now_us: int) -> "Reading | None":
        """Return the newest conversion, or None if there was none since the last call."""
        conversion = now_us // self.period_us
        if conversion == self._conversion or self.fault == SILENT:
            return None
        self._conversion = conversion
        converted_us = conversion * self.period_us
        if self.forces is not None:
            strained = self._strained(self.forces(converted_us))
        else:  # of the present load, resolved once
            if self._resolved[0] is not self.load:
                self._resolved = self.load, self._strained(force_of(self.load))
            strained = self._resolved[1]
        gauss, noise, temperature = self._gauss, self.noise_microstrain, self.temperature
        microstrains = [
            microstrain + offset + gauss(0.0, noise)
            for microstrain, offset in zip(strained, self.offset_microstrain)  # noqa: B905 (not in MicroPython)
        ]
        if self.fault == DRIFT and 0 < self.fault_gauge <= len(microstrains):
            microstrains[self.fault_gauge - 1] += self.fault_magnitude * 1e-6 * (now_us - self._fault_since_us)
        if self.front_end is None:
            per_microstrain, low, high = self.converter[1], self.count_min, self.count_max
            counts = []
            for microstrain in microstrains:
                exact = per_microstrain * microstrain
                counts.append(round(exact) if low < exact < high else convert(exact, low, high))
        else:
            counts = self.front_end.counts(microstrains, converted_us)
            if self.front_end.temperature is not None:
                temperature = self.front_end.temperature.reading(converted_us)
        faults = self._break(counts) if self.fault else 0
        self._last_counts = tuple(counts)
        return Reading(self._last_counts, faults, temperature)

    def _strained(self, force: "Forces") -> "list[float]":
        f1, f2, f3 = force
        return [1e6 * (c1 * f1 + c2 * f2 + c3 * f3) for c1, c2, c3 in self.rows]

    def _break(self, counts: "list[int]") -> int:
        hit = self.fault_gauge - 1
        if self.fault == STUCK:
            counts[hit] = self._last_counts[hit]
        elif self.fault in (OPEN, SATURATED):
            counts[hit] = self.count_max
        return 1 << table.FAULT_WIRE_BREAK if self.fault == OPEN else 0

    def due_us(self, now_us: int) -> int:
        """Return the end of the sample period that contains ``now_us``."""
        return (now_us // self.period_us + 1) * self.period_us

    def attach(self, device: "Device") -> None:
        """Connect objects 2200h (fault) and 2201h (load) to this source; with a load history, 2201h is rejected."""

        def write_fault(sub: int, value: "Value") -> int:
            fields: "list[Value]" = [device.od.values[indices.SIMULATED_FAULT << 8 | k] for k in (1, 2, 3)]
            fields[sub - 1] = value
            self.set_fault(int(fields[0]), int(fields[1]), float(fields[2]), device.now_us)
            self._fault_by_bus = True
            return 0

        def write_load(sub: int, value: "Value") -> int:
            if self.forces is not None:
                return codes.DEVICE_STATE
            if self.load is not self._load_by_bus:
                self._own_load = self.load
            load = list(self.load)
            load[sub - 1] = float(value)
            self.load = self._load_by_bus = (load[0], load[1], load[2])
            return 0

        device.od.writers[indices.SIMULATED_FAULT] = write_fault
        device.od.writers[indices.SIMULATED_LOAD] = write_load
        device.od.readers[indices.SIMULATED_LOAD] = lambda sub: self.load[sub - 1]

    def reset(self, device: "Device") -> None:
        """Undo what 2200h and 2201h set; a fault and a load that the program set stay."""
        device.od.restore_defaults(indices.SIMULATED_FAULT, indices.SIMULATED_FAULT)
        if self._fault_by_bus:
            self.set_fault(0, 1, 0.0, device.now_us)
        if self.load is self._load_by_bus:
            self.load = self._own_load


def force_of(load: "Forces") -> "Forces":
    """Return F1, F2, F3 in newtons of a load P newtons, phi and theta degrees: equation (16)."""
    P, phi_deg, theta_deg = load
    phi, delta = math.radians(phi_deg), math.radians(phi_deg - theta_deg)
    return P * math.sin(phi), P * math.sin(delta), P * math.cos(phi)
