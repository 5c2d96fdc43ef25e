"""Filters and front ends at their limits: extreme constants, long runs, gaps, zero and extreme noise."""

import math
from fractions import Fraction

import numpy as np

from canopen_device.core import codes
from fingertip import finger as rig
from stability.case import Observed, refusal
from tipforce.dictionary import indices
from tipforce.fingertip import filters
from tipforce.sensor.contact import scalar
from tipforce.sources.front_end import Bridge, FrontEnd
from tipforce.sources.simulated import SILENT, SimulatedSource

_MOVING, _REPEATING, _FIRST_ORDER = filters.MOVING_AVERAGE, filters.REPEATING_AVERAGE, filters.FIRST_ORDER


def filter_constants() -> Observed:
    """61A1h = 0, 257 and 65535 for a moving average; unknown types 3, 99, 255 -> refused: 06090032h, 06090031h,
    06090030h; filter and constant stay"""
    finger = rig.filtered(_MOVING, 8)
    aborts = [finger.put("H", indices.FILTER_CONSTANT, 1, constant) for constant in (0, 257, 65535)]
    aborts += [finger.put("B", indices.FILTER_TYPE, 1, kind) for kind in (3, 99, 255)]
    kept = int(finger.get("B", indices.FILTER_TYPE, 1)), int(finger.get("H", indices.FILTER_CONSTANT, 1))
    expected = [codes.TOO_LOW, codes.TOO_HIGH, codes.TOO_HIGH]
    expected += [codes.INVALID_VALUE, codes.INVALID_VALUE, codes.TOO_HIGH]
    held = aborts == expected and kept == (_MOVING, 8)
    return held, f"{', '.join(f'{abort:08X}h' for abort in aborts)}; type and constant stay {kept}"


def filter_constant_1() -> Observed:
    """each filter type with the constant 1 -> pass: every sample is that of a node without a filter"""

    def run(finger: rig.Finger) -> list[rig.Pdos]:
        found = []
        for k in range(50):
            finger.source.load = (0.1 * k, *rig.PUSH[1:])
            found.append(finger.sync())
        return found

    plain = run(rig.finger())
    same = [run(rig.filtered(kind, 1)) == plain for kind in (_MOVING, _REPEATING, _FIRST_ORDER)]
    return all(same), f"{sum(same)} of 3 types give the same 50 samples"


def filter_first_order_65535() -> Observed:
    """the longest first-order filter, full-scale step after it has settled -> bounded: each output is within 1/256
    count of (1 - 1/65535)^k in exact arithmetic"""
    constant, worst = 65535, Fraction(0)
    running = filters.algorithm(_FIRST_ORDER, 1, constant)
    low, high = -32768, 32767
    for _ in range(constant):
        running.push((low,))
    keep, exact = 1 - 1 / Fraction(constant), 0.0
    for k in range(1, 131_071):
        running.push((high,))
        if k % 4369 == 0:
            exact = high + (low - high) * float(keep) ** k
            output = running.output()
            worst = max(worst, abs(Fraction(output[0] - exact))) if output else Fraction(99)
    return worst <= Fraction(1, 256), f"worst {float(worst) * 256:.3f}/256 count, last output {exact:.3f}"


def filter_long_run() -> Observed:
    """a moving average of 256 over 200000 full-scale 24-bit readings of random sign -> pass: the last mean is exact:
    sums are integers, nothing accumulates"""
    counts = (2**23 - 1) * np.random.default_rng(20).choice((-1, 1), 200_000)
    running = filters.algorithm(_MOVING, 1, 256)
    for count in counts.tolist():
        running.push((count,))
    output, exact = running.output(), int(counts[-256:].sum()) / 256
    return output == [exact], f"{output} counts, exact {exact:g}"


def filter_first_order_settles() -> Observed:
    """first-order filters of 2, 1000 and 65535 on a constant full-scale input -> pass: after 100000 readings the output
    equals the input to the last bit"""
    last = []
    for constant in (2, 1000, 65535):
        running = filters.algorithm(_FIRST_ORDER, 1, constant)
        for _ in range(constant // 2):
            running.push((-32768,))
        for _ in range(100_000 if constant < 65535 else 65535 * 22):
            running.push((32767,))
        last += running.output() or [math.nan]
    return last == [32767.0] * 3, f"outputs {last}"


def filter_repeating_65535() -> Observed:
    """a repeating average of 65535 conversions: 6.5 s to its first output -> flagged: until then P and gauges are
    unknown with bit 3; then the mean is right"""
    finger = rig.filtered(_REPEATING, 65535, load=rig.PUSH)
    finger.put("I", indices.SAMPLE_PERIOD_US, 1, 100)
    early = [finger.sync(50_000) for _ in range(130)]
    hushed = all(one.contact == one.gauges == rig.HUSHED and one.status & scalar.STALE for one in early)
    later = [finger.sync(1000) for _ in range(100)]
    fresh = [k for k, one in enumerate(later) if not one.status & scalar.STALE]
    seen = later[fresh[0]] if fresh else later[-1]
    held = hushed and len(fresh) == 1 and seen.contact[0] == 1000
    return held, f"unknown for {6500 + fresh[0]} ms, then once P {seen.contact[0]} mN" if fresh else "no output"


def filter_saturated() -> Observed:
    """one saturated reading inside a moving average of 256 -> flagged: that SYNC has bit 2 and P unknown, and the
    average restarts: no value contains the reading"""
    finger = rig.filtered(_MOVING, 256, load=rig.PUSH)
    for _ in range(200):
        finger.sync(rig.PERIOD_US)
    finger.source.forces = lambda _now: (40.0, 0.0, -1.0)
    hit = finger.sync(rig.PERIOD_US)
    finger.source.forces = None
    after = [finger.sync(rig.PERIOD_US) for _ in range(300)]
    held = bool(hit.status & scalar.SATURATED) and hit.contact == rig.HUSHED
    wrong = [one.contact[0] for one in after if one.contact[0] not in (1000, rig.UNKNOWN)]
    return held and not wrong, f"status {hit.status:02X}h, P of the next 300 samples wrong in {len(wrong)}"


def filter_silence() -> Observed:
    """the converter stops inside a first-order filter of 1000 -> flagged: every SYNC from then on has bit 3 and all
    unknown, after 100 ms bit 7 too"""
    finger = rig.filtered(_FIRST_ORDER, 1000, load=rig.PUSH)
    for _ in range(200):
        good = finger.sync()
    finger.break_gauge(SILENT)
    found = [finger.sync() for _ in range(150)]
    held = good.contact[0] == 1000 and all(one.contact == one.gauges == rig.HUSHED for one in found)
    held &= all(one.status & scalar.STALE for one in found) and not found[0].status & scalar.FRONT_END_FAULT
    finger.break_gauge(0)
    finger.source.load = (0.0, 0.0, 0.0)
    held &= bool(found[-1].status & scalar.FRONT_END_FAULT) and finger.sync().gauges == (0, 0, 0)
    return held, f"150 SYNCs unknown, status {found[0].status:02X}h, then {found[-1].status:02X}h"


def front_end_noise() -> Observed:
    """white noise of 1e6 microstrain, 300 times the range -> flagged: nearly every sample has a gauge at its limit: bit
    2, P unknown; the others are inside the range"""
    source = SimulatedSource(rig.strain_per_newton(), front_end=FrontEnd(white_noise=1e6, seed=21))
    finger = rig.finger(source=source)
    found = [finger.sync() for _ in range(400)]
    flagged = [bool(one.status & scalar.SATURATED) for one in found]
    held = all(flag == (max(map(abs, one.gauges)) == 32767) for flag, one in zip(flagged, found, strict=True))
    held &= all(one.contact == rig.HUSHED for one, flag in zip(found, flagged, strict=True) if flag)
    return held and sum(flagged) > 390, f"{sum(flagged)} of 400 samples flagged"


def front_end_noise_impossible() -> Observed:
    """noise of 0, negative, NaN or infinite; 1/f limits that do not rise -> refused: ValueError names the argument;
    without noise no random numbers are drawn"""
    impossible = ((name, value) for name in ("white_noise", "one_over_f") for value in (0.0, -1.0, math.nan, math.inf))
    named = [name in refusal(FrontEnd, kind=ValueError, **{name: value}) for name, value in impossible]
    named.append("highest_hz" in refusal(FrontEnd, kind=ValueError, one_over_f=(1.0, 10.0, 1.0)))
    silent = FrontEnd()
    one, other = silent.counts([1.0, 2.0, 3.0], 0), silent.counts([1.0, 2.0, 3.0], 500)
    return all(named) and not silent.parts and one == other == [10, 20, 30], f"{sum(named)} of {len(named)} refused"


def front_end_signal_not_finite() -> Observed:
    """strain of NaN, +-infinity and +-1e300 into 16 and 24 bits -> flagged: the converter is at a limit: saturated,
    never a number in between"""
    ends = []
    for bits in (16, 24):
        front_end = FrontEnd(bits=bits)
        for value in (math.nan, math.inf, -math.inf, 1e300, -1e300):
            (count,) = front_end.counts([value], 0)
            ends.append(count in (front_end.count_min, front_end.count_max) and (count > 0) == (not value < 0.0))
    finger = rig.finger()
    seen = []
    for value in (math.nan, math.inf, -math.inf):
        finger.source.forces = lambda _now, value=value: (value, 0.0, -1.0)
        seen.append(finger.sync())
    held = all(ends) and all(one.contact == rig.HUSHED and one.status & scalar.SATURATED for one in seen)
    return held, f"{sum(ends)} of {len(ends)} at an end; node: status {[f'{one.status:02X}h' for one in seen]}"


def front_end_bridge_pole() -> Observed:
    """a quarter bridge at and beyond the strain that leaves no resistance -> flagged: it shows the limit of the range,
    no change of sign, no division by zero"""
    front_end = FrontEnd(bridge=Bridge("quarter", 2.0))
    pole = -1e6  # microstrain: 1 + k e / 2 = 0
    counts = [front_end.counts([pole * (1.0 + step)], 0)[0] for step in (-1e-3, -1e-12, 0.0, 1e-12, 1.0, 1e6)]
    gentle = front_end.counts([-1000.0, 1000.0], 0)
    held = counts == [front_end.count_min] * 6 and gentle == [-10010, 9990]
    return held, f"{len(counts)} strains at and beyond the pole: {set(counts)}; +-1000 microstrain: {gentle}"


def front_end_temperature() -> Observed:
    """tip temperatures of -400 to 400 degC, NaN and infinity -> flagged: 2122h is unknown where INTEGER16 cannot hold
    it, else right within 0.005 degC"""
    wrong = []
    for degC in (-400.0, -327.68, -327.674, -0.001, 23.0, 327.674, 327.676, 400.0):
        found = FrontEnd(temperature=degC).temperature
        shown = found.reading(0) if found else 0
        inside = abs(degC) < 327.675
        if (shown == rig.UNKNOWN) == inside or (inside and abs(shown / 100.0 - degC) > 0.0051):
            wrong.append(degC)
    for value in (math.nan, math.inf):
        found = FrontEnd(temperature=lambda _s, value=value: value).temperature
        if not found or found.reading(0) != rig.UNKNOWN:
            wrong.append(value)
    return not wrong, f"10 temperatures, wrong: {wrong or 'none'}"
