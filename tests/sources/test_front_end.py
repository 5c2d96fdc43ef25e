"""The simulated front end: each part by an independent formula, and nothing of what is not named."""

import math
import random

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fingertip.finger import PUSH, SATURATED, Finger, record, strain_per_newton
from tipforce.dictionary import table
from tipforce.dictionary.eds import eds_text, file_name
from tipforce.fingertip import fingertip_node
from tipforce.host import Identity
from tipforce.sources import Bridge, DynamicForces, DynamicLoad, FrontEnd, OneOverFNoise, SimulatedSource, Temperature

STATE = 0x08000022
NO_OBJECT = 0x06020000


def behind(front_end: FrontEnd | None, load: tuple[float, float, float] = PUSH, calibrated: bool = True) -> Finger:
    source = SimulatedSource(strain_per_newton(), front_end=front_end)
    source.load = load
    talk = Finger(fingertip_node(5, source), source)
    if calibrated:
        talk.stage(record())
        assert talk.commit() == 0
    return talk


def test_nothing_named_is_the_ideal_converter() -> None:
    plain, named = behind(None), behind(FrontEnd())
    assert named.source.front_end is not None
    assert named.source.front_end.parts == []
    for k in range(200):
        plain.source.load = named.source.load = (0.17 * k, -180.0 + 3.0 * k, 5.0)  # to the ends and beyond
        assert plain.sync() == named.sync()


def arms(kind: str, change: float) -> float:
    """The output of a bridge per volt by Kirchhoff: two dividers, the active resistors changed."""
    up = 1.0 + change
    down = 1.0 - change if kind != "quarter" else 1.0
    left = up / (up + down)
    right = down / (up + down) if kind == "full" else 0.5
    return left - right


@pytest.mark.parametrize("kind", ["quarter", "half", "full"])
@pytest.mark.parametrize("microstrain", [-3000.0, -20.0, 0.0, 1.0, 2500.0])
def test_bridge_is_that_of_its_resistors(kind: str, microstrain: float) -> None:
    bridge, gain = Bridge(kind, gauge_factor=2.1, excitation_volts=5.0), 50.0
    (counts,) = FrontEnd(24, bridge, gain, reference_volts=2.5).counts([microstrain], 0)
    volts = arms(kind, 2.1e-6 * microstrain) * 5.0 * gain
    assert counts == pytest.approx(volts / 2.5 * 2**23, abs=0.51)


def test_matched_gain_has_the_same_full_scale_for_all() -> None:
    for bits, converter in ((16, table.CONVERTER_16), (24, table.CONVERTER_24)):
        assert FrontEnd(bits).converter == converter == FrontEnd(bits, Bridge("half", 2.0)).converter


def test_default_scaling_follows_a_named_gain() -> None:
    front_end = FrontEnd(16, Bridge("half"), gain=128.0)
    talk = behind(front_end)
    assert talk.get("f", 0x6122, 1) == pytest.approx(1000.0 * front_end.converter[1], rel=1e-6)
    expected = behind(None).sync()
    # A count is 0.24 microstrain here instead of 0.1.
    assert talk.sync().contact == pytest.approx(expected.contact, abs=20)


@given(st.floats(), st.sampled_from([16, 24]))
def test_conversion_never_raises_and_stays_within_the_ends(microstrain: float, bits: int) -> None:
    front_end = FrontEnd(bits)
    (count,) = front_end.counts([microstrain], 0)
    exact = microstrain * front_end.converter[1]
    if front_end.count_min <= exact <= front_end.count_max:
        assert abs(count - exact) <= 0.5
    else:
        assert count == (front_end.count_min if exact < 0 else front_end.count_max)


def test_24_bits_on_the_node() -> None:
    talk = behind(FrontEnd(24), (1.0, 90.0, 0.0))
    talk.source.offset_microstrain[0] = 0.00123
    talk.sync()
    assert talk.get("i", 0x9100, 1) == talk.get("f", 0x6100, 1) == round(100.00123 * 2560)
    assert talk.get("f", 0x6130, 1) == pytest.approx(100.00123, abs=0.5 / 2560)
    assert talk.get("f", 0x6122, 1) == 2_560_000.0
    assert talk.get("i", 0x9122, 1) == 2_560_000
    for index in (0x7100, 0x7120, 0x7122):
        assert talk.upload(index, 1) == NO_OBJECT  # INTEGER16 cannot hold these counts
    assert talk.get("h", 0x7130, 1) == 1000
    product = int(talk.get("I", 0x1018, 2))
    assert product == 0x54500303
    identity = Identity(0, product, 0, 0)
    assert (identity.is_fingertip, identity.gauges, identity.simulated) == (True, 3, True)


def test_24_bits_saturate_at_their_own_ends() -> None:
    talk = behind(FrontEnd(24), (0.0, 0.0, 0.0))
    for load, value, status in ((32.76, 32760, 0), (32.769, 32767, 3), (-32.769, -32767, 5)):
        talk.source.load = (load, 90.0, 0.0)
        pdos = talk.sync()
        assert pdos.gauges[0] == value
        assert bool(pdos.status & SATURATED) == bool(status)
        assert talk.get("B", 0x6150, 1) == status


@pytest.mark.parametrize("converter", [table.CONVERTER_24, (16, 2.5)])
def test_the_eds_follows_the_converter(converter: tuple[int, float]) -> None:
    text = eds_text(3, True, converter)
    assert f"FileName={file_name(3, True, bits=converter[0])}" in text
    assert ("[7100]" in text, "[9100]" in text) == (converter[0] == 16, True)
    assert f"DefaultValue={1000.0 * converter[1]}" in text


def drawn(front_end: FrontEnd, gauges: int, count: int, period_us: int = 500) -> npt.NDArray[np.float64]:
    """Noise of gauges without load in microstrain, (count, gauges), from a 24-bit converter."""
    found = [front_end.counts([0.0] * gauges, k * period_us) for k in range(count)]
    return np.array(found) / front_end.converter[1]


def test_white_noise() -> None:
    noise = drawn(FrontEnd(24, white_noise=2.0, seed=3), 4, 5000)
    assert noise.std() == pytest.approx(2.0, rel=0.03)
    assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 0.05
    assert abs(np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]) < 0.05


def test_equal_seeds_give_equal_noise() -> None:
    first, second, other = (drawn(FrontEnd(24, white_noise=1.0, one_over_f=1.0, seed=s), 3, 50) for s in (1, 1, 2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def one_over_f(f: npt.NDArray[np.float64], part: OneOverFNoise, a: float) -> npt.NDArray[np.float64]:
    """The density that its docstring states: a sum of first-order spectra of equal variance."""
    corners = np.array(part.corners_hz)[:, None]
    variance = a**2 * math.log(corners[1, 0] / corners[0, 0])
    return np.asarray(np.sum(2 * variance / (math.pi * corners) / (1 + (f / corners) ** 2), axis=0))


def test_the_sum_of_first_order_processes_is_one_over_f() -> None:
    part = OneOverFNoise(2.0, random.Random(1), 1e-3, 1e3)
    f = np.logspace(-1, 1, 200)
    relative = one_over_f(f, part, 2.0) * f / 4.0
    assert np.all(np.abs(relative - 1) < 0.01)  # two decades inside the ends
    assert np.ptp(relative[95:105]) < 1e-3
    assert one_over_f(np.array([1e-2, 1e2]), part, 2.0) * [1e-2, 1e2] / 4.0 == pytest.approx(0.967, abs=0.001)


def test_spectrum_of_one_over_f_noise() -> None:
    """Periodograms of eight gauges, averaged over a third of an octave, against the stated density."""
    a, gauges, count, rate_hz = 5.0, 8, 16_384, 2000.0
    part = OneOverFNoise(a, random.Random(11), 0.05, 100.0)
    noise = drawn(FrontEnd(24, one_over_f=(a, 0.05, 100.0), seed=11), gauges, count)
    window = np.hanning(count)[:, None]
    power = np.abs(np.fft.rfft(noise * window, axis=0)) ** 2 * 2 / (rate_hz * np.sum(window**2))
    f = np.fft.rfftfreq(count, 1 / rate_hz)
    for low in np.geomspace(1.0, 50.0, 12):
        band = (f >= low) & (f < low * 2 ** (1 / 3) + 0.5)
        wanted = np.mean(one_over_f(f[band], part, a))
        lines = gauges * np.count_nonzero(band) / 1.5  # of the window's equivalent bandwidth
        assert np.mean(power[band]) == pytest.approx(wanted, rel=4.5 / math.sqrt(lines))
    bands = [(f >= low) & (f < 3 * low) for low in (1.0, 10.0)]
    assert math.log10(np.mean(power[bands[1]]) / np.mean(power[bands[0]])) == pytest.approx(-1.0, abs=0.15)


def test_one_over_f_noise_does_not_hang_on_how_often_it_is_read() -> None:
    """The variance of the difference over 50 ms is that of one step of 50 ms, and that of a hundred of 0.5 ms."""
    spread = []
    for period_us in (50_000, 500):
        noise = drawn(FrontEnd(24, one_over_f=(5.0, 0.1, 100.0), seed=2), 40, 50_000 // period_us * 6 + 1, period_us)
        spread.append(np.diff(noise[:: 50_000 // period_us], axis=0).std())
    assert spread[0] == pytest.approx(spread[1], rel=0.2)


def test_one_over_f_noise_after_a_long_gap_or_time_that_stands_still() -> None:
    front_end = FrontEnd(24, one_over_f=1.0)
    first = front_end.counts([0.0], 0)
    assert front_end.counts([0.0], 0) == first
    assert front_end.counts([0.0], 10**18) != first


def test_temperature_trajectories() -> None:
    points = Temperature([(1.0, 20.0), (3.0, 40.0), (4.0, 40.0)])
    assert [points.degrees(t) for t in (0, 1_000_000, 1_500_000, 3_000_000, 9_000_000)] == [20, 20, 25, 40, 40]
    assert Temperature(21.5).reading(0) == 2150
    assert Temperature(lambda t_s: 20.0 + t_s).degrees(2_500_000) == 22.5


def test_apparent_strain_and_gain_drift() -> None:
    front_end = FrontEnd(24, temperature=33.0, apparent_strain=[1.0, -2.0, 0.0], gain_drift_ppm=100.0)
    counts = front_end.counts([100.0, 100.0, 100.0], 0)
    assert np.array(counts) / 2560 == pytest.approx([110 * 1.001, 80 * 1.001, 100 * 1.001], abs=1e-3)


def test_the_node_shows_the_temperature_of_the_front_end() -> None:
    talk = behind(FrontEnd(temperature=[(0.0, 20.0), (10.0, 120.0)]))
    talk.sync()
    assert talk.get("h", 0x2122) == 3000 + 1  # at 1.001 s
    assert talk.source.front_end.parts == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bits": 12}, "bits: 12, allowed 16 and 24"), ({"gain": 2.0}, "gain: needs a bridge"),
        ({"reference_volts": 2.0}, "reference_volts: needs gain"),
        ({"apparent_strain": 1.0}, "apparent_strain: needs temperature"),
        ({"gain_drift_ppm": 1.0}, "gain_drift_ppm: needs temperature"),
        ({"temperature": math.nan}, "temperature: nan"),
        ({"bridge": Bridge("full"), "gain": 1e-300}, "gain: 1e-300 makes .* counts per microstrain, allowed 1e-09 to"),
        ({"temperature": [(1.0, 20.0), (0.0, 20.0)]}, "points at increasing times"),
        ({"temperature": []}, "points at increasing times"),
        ({"temperature": 20.0, "apparent_strain": [1.0, 2.0]}, "2 numbers for 3 gauges"),
        ({"kind": "third"}, "bridge"),
        ({"gauge_factor": 0.0}, "gauge_factor: 0.0, allowed is a finite number above 0"),
        ({"excitation_volts": math.inf}, "excitation_volts"),
    ],
)  # fmt: skip
def test_what_is_not_allowed(options: dict[str, object], message: str) -> None:
    kind = Bridge if {"kind", "gauge_factor", "excitation_volts"} & options.keys() else FrontEnd
    with pytest.raises(ValueError, match=message):
        kind(**options).counts([0.0] * 3, 0)  # type: ignore[arg-type, union-attr]


def test_forces_replace_the_load_at_the_time_of_the_conversion() -> None:
    asked: list[int] = []
    source = SimulatedSource(strain_per_newton(), forces=lambda now_us: (asked.append(now_us) or 2.0, 0.0, -1.0))  # type: ignore[func-returns-value]
    talk = Finger(fingertip_node(5, source), source)
    assert talk.sync(after_us=1234).gauges == (2000, 0, -1000)
    assert asked == [1_001_000]  # the conversion that 1.001234 s finds
    assert talk.put("f", 0x2201, 1, 1.0) == STATE


def oscillator(frequency_hz: float, step_s: float) -> DynamicLoad:
    """One undamped mode that sees F1: exact for a load that is linear during a step."""
    w, angle = 2 * math.pi * frequency_hz, 2 * math.pi * frequency_hz * step_s
    c, s = math.cos(angle), math.sin(angle)
    # z'' + w^2 z = w^2 f, with f = a + (b - a) t / step: z = f - (b - a) sin(w t) / (w step) + free motion.
    start, end = -c + s / angle, 1.0 - s / angle
    hold = (c, s / w, -w * s, c, start, end, w * s - (1 - c) / step_s, (1 - c) / step_s)
    return DynamicLoad((((1.0, 0.0, 0.0), hold, (1.0, 0.0, 0.0)),))


def test_dynamic_forces_are_the_motion_whatever_is_read() -> None:
    """A step of load rings: every conversion by the closed form, also where the node reads only some of them."""
    step_us, frequency_hz = 500, 100.0

    def applied(now_us: int) -> tuple[float, float, float]:
        return (min(max((now_us - 10_000) / 500, 0.0), 1.0), 0.0, 0.0)  # a ramp of one step

    every, few = (DynamicForces(oscillator(frequency_hz, step_us * 1e-6), applied, step_us) for _ in range(2))
    w = 2 * math.pi * frequency_hz
    for k in range(200):
        t = (k * step_us - 10_000) * 1e-6
        exact = 0.0 if t <= 0 else 1.0 - (math.sin(w * t) - math.sin(w * (t - 5e-4))) / (w * 5e-4)
        assert every(k * step_us)[0] == pytest.approx(exact, abs=1e-9)
        if k % 7 == 0:
            assert few(k * step_us) == every(k * step_us)
    assert every(0) == every(199 * step_us)  # time that goes back changes nothing
    with pytest.raises(ValueError, match="step_us: 0"):
        DynamicForces(oscillator(frequency_hz, 5e-4), applied, 0)
