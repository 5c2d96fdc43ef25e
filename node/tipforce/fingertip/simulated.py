"""A simulated gauge source: applied load -> gauge strain -> 16-bit counts, with noise, offset and faults."""

import math
import random

from tipforce.dictionary import table

from .source import COUNT_MAX, COUNT_MIN, Reading, Source

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from tipforce.device.node import Device
    from tipforce.device.object_dictionary import Value

COUNTS_PER_MICROSTRAIN = 10.0  # the defaults of 6120h-6123h: one count is 0.1 microstrain
STUCK, OPEN, SATURATED, SILENT, DRIFT = 1, 2, 3, 4, 5  # values of 2200h:1
_ROOM_TEMPERATURE = 2300  # 0.01 degC


class SimulatedSource(Source):
    """Gauges of a structure whose strain per newton is ``strain_per_newton``, (n, 3) as rows, under ``load``.

    ``noise_microstrain`` is the standard deviation of white noise on each gauge (0 draws no random numbers),
    ``offset_microstrain`` what each gauge reads unloaded. A conversion takes place every ``period_us``.
    """

    def __init__(
        self,
        strain_per_newton: "Sequence[Sequence[float]]",
        noise_microstrain: float = 0.0,
        offset_microstrain: "Sequence[float] | None" = None,
        seed: int = 0,
        temperature: int = _ROOM_TEMPERATURE,
    ) -> None:
        self.rows = [tuple([float(x) for x in row]) for row in strain_per_newton]
        self.noise_microstrain = noise_microstrain
        self.offset_microstrain = list(offset_microstrain) if offset_microstrain else [0.0] * len(self.rows)
        self.period_us = 500
        self.temperature = temperature
        self.load = (0.0, 0.0, 0.0)  # P newtons, phi degree, theta degree
        self.fault = 0
        self.fault_gauge = 1
        self.fault_magnitude = 0.0  # DRIFT: microstrain per second
        self._random = random.Random(seed) if noise_microstrain else None
        self._conversion = -1
        self._fault_since_us = 0
        self._last_counts = (0,) * len(self.rows)

    def set_fault(self, fault: int, gauge: int, magnitude: float, now_us: int) -> None:
        """Inject a fault of 2200h into ``gauge`` (from 1) from now on; 0 ends it."""
        if fault != self.fault:
            self._fault_since_us = now_us
        self.fault, self.fault_gauge, self.fault_magnitude = fault, gauge, magnitude

    def read(self, now_us: int) -> "Reading | None":
        """The newest conversion, or None when there was none since the last call."""
        conversion = now_us // self.period_us
        if conversion == self._conversion or self.fault == SILENT:
            return None
        self._conversion = conversion
        P, phi_deg, theta_deg = self.load
        phi, delta = math.radians(phi_deg), math.radians(phi_deg - theta_deg)
        force = P * math.sin(phi), P * math.sin(delta), P * math.cos(phi)
        counts = [self._count(k, force, now_us) for k in range(len(self.rows))]
        faults = 0
        hit = self.fault_gauge - 1
        if self.fault == STUCK:
            counts[hit] = self._last_counts[hit]
        elif self.fault == OPEN:
            counts[hit] = COUNT_MAX
            faults = 1 << table.FAULT_WIRE_BREAK
        elif self.fault == SATURATED:
            counts[hit] = COUNT_MAX
        self._last_counts = tuple(counts)
        return Reading(self._last_counts, faults, self.temperature)

    def _count(self, k: int, force: "tuple[float, float, float]", now_us: int) -> int:
        c1, c2, c3 = self.rows[k]
        strain = c1 * force[0] + c2 * force[1] + c3 * force[2]
        microstrain = 1e6 * strain + self.offset_microstrain[k]
        if self._random is not None:
            microstrain += self._random.gauss(0.0, self.noise_microstrain)
        if self.fault == DRIFT and self.fault_gauge == k + 1:
            microstrain += self.fault_magnitude * 1e-6 * (now_us - self._fault_since_us)
        exact = microstrain * COUNTS_PER_MICROSTRAIN
        return round(min(max(exact, COUNT_MIN), COUNT_MAX))


def own_simulation_objects(device: "Device", source: SimulatedSource) -> None:
    """Objects 2200h (fault) and 2201h (load) of a simulated node act on its source."""

    def write_fault(sub: int, value: "Value") -> int:
        fields: "list[Value]" = [device.od.values[0x220000 | k] for k in (1, 2, 3)]
        fields[sub - 1] = value
        source.set_fault(int(fields[0]), int(fields[1]), float(fields[2]), device.now_us)
        return 0

    def write_load(sub: int, value: "Value") -> int:
        load = list(source.load)
        load[sub - 1] = float(value)
        source.load = (load[0], load[1], load[2])
        return 0

    device.od.writers[0x2200] = write_fault
    device.od.writers[0x2201] = write_load
