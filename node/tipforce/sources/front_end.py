"""Front end of a simulated node: bridge, amplifier, temperature, noise, conversion; only the configured parts are
built. All work on the signal in microstrain at the gauges, so volts occur only once, as counts per microstrain. Errors
are ValueErrors that name the argument: this file keeps to the subset that MicroPython supports."""

import math

from tipforce.dictionary import table
from tipforce.fingertip.source import convert

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from random import Random

    Part = Callable[[list[float], int], None]  # one part of the chain: changes the microstrain of all gauges in place
    Trajectory = float | Sequence[tuple[float, float]] | Callable[[float], float]


BITS = (16, 24)
FULL_SCALE_MICROSTRAIN = 3276.8  # of a matched gain: 10 counts per microstrain with 16 bits, 2560 with 24
REFERENCE_DEGC = 23.0
QUARTER, HALF, FULL = "quarter", "half", "full"
_ARMS = {QUARTER: 0.25, HALF: 0.5, FULL: 1.0}
PER_DECADE = 2  # first-order processes of OneOverFNoise: between its ends the ripple of the spectrum is 0.1 %


def _check(name: str, value: float, above: float = -math.inf) -> float:
    if not (value > above and value - value == 0.0):
        raise ValueError("%s: %r, allowed is a finite number%s" % (
            name, value, "" if above == -math.inf else " above %g" % above))  # fmt: skip
    return value


class Bridge:
    """A bridge of equal resistors. Volts per volt, strain e, gauge factor k: quarter k e / (4 + 2 k e), which measures
    e / (1 + k e / 2); half (neighbouring arms, opposite signs) k e / 2; full k e."""

    def __init__(self, kind: str = QUARTER, gauge_factor: float = 2.0, excitation_volts: float = 3.3) -> None:
        if kind not in _ARMS:
            raise ValueError("bridge: %r, allowed quarter, half, full" % kind)
        self.kind = kind
        self.gauge_factor = _check("gauge_factor", gauge_factor, 0.0)
        self.excitation_volts = _check("excitation_volts", excitation_volts, 0.0)
        self.volts_per_microstrain = 1e-6 * gauge_factor * _ARMS[kind] * excitation_volts

    def apply(self, microstrains: "list[float]", _now_us: int) -> None:
        """The strain that a quarter bridge measures; below -1/k (no resistance left) the lower limit."""
        half = 0.5e-6 * self.gauge_factor
        for k, microstrain in enumerate(microstrains):
            loss = 1.0 + half * microstrain
            microstrains[k] = microstrain / loss if loss > 0.0 else -math.inf


class Temperature:
    """Temperature of the tip: one number, (seconds, degC) points joined by lines, or a function of seconds."""

    def __init__(self, trajectory: "Trajectory") -> None:
        self._points: "Sequence[tuple[float, float]]" = ()
        self._function: "Callable[[float], float] | None" = None
        if callable(trajectory):
            self._function = trajectory
        elif isinstance(trajectory, (int, float)):
            self._points = [(0.0, _check("temperature", trajectory))]
        else:
            self._points = [(_check("temperature", t), _check("temperature", degC)) for t, degC in trajectory]
            times = [t for t, _degC in self._points]
            if not times or times != sorted(set(times)):
                raise ValueError("temperature: %r, allowed are points at increasing times" % (trajectory,))

    def degrees(self, now_us: int) -> float:
        """Return the temperature in degC at a time; before the first and after the last point it is constant."""
        t = 1e-6 * now_us
        if self._function is not None:
            return self._function(t)
        before = self._points[0]
        for after in self._points:
            if t < after[0]:
                if before is after:
                    break
                return before[1] + (after[1] - before[1]) * (t - before[0]) / (after[0] - before[0])
            before = after
        return before[1]

    def reading(self, now_us: int) -> int:
        """Return the reading of the node's own sensor, 0.01 degC (2122h); unknown if INTEGER16 cannot hold it."""
        hundredths = 100.0 * self.degrees(now_us)
        return round(hundredths) if -32767.5 < hundredths < 32767.5 else table.UNKNOWN_I16


def _apparent_strain(temperature: Temperature, microstrain_per_degC: "float | Sequence[float]") -> "Part":
    """Apparent strain: per degC away from 23 degC. Raises ValueError for another number of gauges than of values."""
    given = microstrain_per_degC
    each = None if isinstance(given, (int, float)) else [_check("apparent_strain", value) for value in given]
    same = 0.0 if each is not None else _check("apparent_strain", given)  # type: ignore[arg-type]

    def apply(microstrains: "list[float]", now_us: int) -> None:
        away = temperature.degrees(now_us) - REFERENCE_DEGC
        if each is not None and len(each) != len(microstrains):
            raise ValueError("apparent_strain: %d numbers for %d gauges" % (len(each), len(microstrains)))
        for k in range(len(microstrains)):
            microstrains[k] += away * (same if each is None else each[k])

    return apply


def _gain_drift(temperature: Temperature, ppm_per_degC: float) -> "Part":
    """An amplifier whose gain drifts by this many parts per million per degC away from 23 degC."""
    per_degC = 1e-6 * _check("gain_drift_ppm", ppm_per_degC)

    def apply(microstrains: "list[float]", now_us: int) -> None:
        gain = 1.0 + per_degC * (temperature.degrees(now_us) - REFERENCE_DEGC)
        for k in range(len(microstrains)):
            microstrains[k] *= gain

    return apply


def _white_noise(microstrain: float, random: "Random") -> "Part":
    """White noise, independent for each conversion, normal with this standard deviation in microstrain."""
    sigma = _check("white_noise", microstrain, 0.0)

    def apply(microstrains: "list[float]", _now_us: int) -> None:
        for k in range(len(microstrains)):
            microstrains[k] += random.gauss(0.0, sigma)

    return apply


class OneOverFNoise:
    """Noise of density ``a`` / sqrt(f) microstrain per square root of hertz, one-sided, ``a`` the density at 1 Hz.

    A sum of first-order (Ornstein-Uhlenbeck) processes of equal variance with ``PER_DECADE`` corner frequencies per
    decade from ``lowest_hz`` to ``highest_hz``. One of variance s^2 and corner f_c has the spectrum (2 s^2 / (pi f_c))
    / (1 + (f / f_c)^2); corners a factor q apart add up to s^2 / (ln(q) f) between the ends, so s^2 = a^2 ln(q). A
    decade inside either end the spectrum is 3 % below 1/f, below ``lowest_hz`` it is flat, above ``highest_hz`` it
    falls with 1/f^2. Each process is stepped exactly from one conversion to the next, for any time between them, and
    starts stationary."""

    def __init__(
        self, microstrain_at_1_hz: float, random: "Random", lowest_hz: float = 1e-3, highest_hz: float = 100.0
    ) -> None:
        a = _check("one_over_f", microstrain_at_1_hz, 0.0)
        _check("lowest_hz", lowest_hz, 0.0)
        _check("highest_hz", highest_hz, lowest_hz)
        decades = math.log(highest_hz / lowest_hz) / math.log(10.0)
        count = max(2, round(PER_DECADE * decades) + 1)
        step = math.log(highest_hz / lowest_hz) / (count - 1)
        self.corners_hz = [lowest_hz * math.exp(step * i) for i in range(count)]
        self._sigma = a * math.sqrt(step)
        self._random = random
        self._states: "list[list[float]]" = []  # of each gauge, in standard deviations
        self._now_us = 0
        self._gap_us = -1
        self._steps: "list[tuple[float, float]]" = []

    def apply(self, microstrains: "list[float]", now_us: int) -> None:
        """Step the processes to ``now_us`` and add their sum."""
        gauss = self._random.gauss
        if len(self._states) != len(microstrains):
            self._states = [[gauss(0.0, 1.0) for _ in self.corners_hz] for _ in microstrains]
        elif now_us > self._now_us:
            gap_us = now_us - self._now_us
            if gap_us != self._gap_us:  # of each process the part that remains, and the deviation of the new part
                self._gap_us = gap_us
                kept = [math.exp(-2e-6 * math.pi * f * gap_us) for f in self.corners_hz]
                self._steps = [(keep, math.sqrt(1.0 - keep * keep)) for keep in kept]
            for states in self._states:
                for i in range(len(states)):
                    keep, fresh = self._steps[i]
                    states[i] = keep * states[i] + fresh * gauss(0.0, 1.0)
        self._now_us = now_us
        for k in range(len(microstrains)):
            microstrains[k] += self._sigma * sum(self._states[k])


class FrontEnd:
    """Convert microstrain to counts (``bits`` 16 or 24) by the configured parts, in signal order. Raises ValueError.

    ``bridge``, ``gain`` and ``reference_volts`` (None: the excitation) set the counts per microstrain; without ``gain``
    the full scale is 3276.8. ``temperature`` (degC; 2122h), which ``apparent_strain`` (microstrain per degC) and
    ``gain_drift_ppm`` (per degC) need; ``white_noise`` (microstrain); ``one_over_f``: at 1 Hz, or (that, lowest Hz,
    highest Hz)."""

    def __init__(
        self, bits: int = 16, bridge: "Bridge | None" = None, gain: "float | None" = None,
        reference_volts: "float | None" = None, temperature: "Trajectory | None" = None,
        apparent_strain: "float | Sequence[float] | None" = None, gain_drift_ppm: "float | None" = None,
        white_noise: "float | None" = None, one_over_f: "float | tuple[float, float, float] | None" = None,
        seed: int = 0,
    ) -> None:  # fmt: skip
        if bits not in BITS:
            raise ValueError("bits: %r, allowed 16 and 24" % bits)
        self.count_max, self.count_min = (1 << bits - 1) - 1, -(1 << bits - 1)
        self.converter = (bits, _counts_per_microstrain(bits, bridge, gain, reference_volts))
        self.temperature = None if temperature is None else Temperature(temperature)
        self.parts: "list[Part]" = []
        if apparent_strain is not None:
            self.parts.append(_apparent_strain(self._needed("apparent_strain"), apparent_strain))
        if bridge is not None and bridge.kind == QUARTER:
            self.parts.append(bridge.apply)
        if gain_drift_ppm is not None:
            self.parts.append(_gain_drift(self._needed("gain_drift_ppm"), gain_drift_ppm))
        if white_noise is None and one_over_f is None:
            return
        import random  # imported only if there is noise

        chance = random.Random(seed)
        if white_noise is not None:
            self.parts.append(_white_noise(white_noise, chance))
        if one_over_f is not None:
            given = (one_over_f,) if isinstance(one_over_f, (int, float)) else one_over_f
            self.parts.append(OneOverFNoise(given[0], chance, *given[1:]).apply)

    def _needed(self, name: str) -> Temperature:
        if self.temperature is None:
            raise ValueError("%s: needs temperature" % name)
        return self.temperature

    def counts(self, microstrains: "list[float]", now_us: int) -> "list[int]":
        """Return the counts of one conversion. Changes ``microstrains``, one per gauge."""
        for part in self.parts:
            part(microstrains, now_us)
        per_microstrain = self.converter[1]
        return [convert(m * per_microstrain, self.count_min, self.count_max) for m in microstrains]


def _counts_per_microstrain(
    bits: int, bridge: "Bridge | None", gain: "float | None", reference_volts: "float | None"
) -> float:
    if gain is None:
        if reference_volts is not None:
            raise ValueError("reference_volts: needs gain")
        return float(1 << bits - 1) / FULL_SCALE_MICROSTRAIN
    if bridge is None:
        raise ValueError("gain: needs a bridge")
    reference = bridge.excitation_volts if reference_volts is None else _check("reference_volts", reference_volts, 0.0)
    counts = bridge.volts_per_microstrain * _check("gain", gain, 0.0) / reference * (1 << bits - 1)
    if not 1e-9 <= counts <= 1e9:
        raise ValueError("gain: %r makes %g counts per microstrain, allowed 1e-09 to 1e+09" % (gain, counts))
    return counts
