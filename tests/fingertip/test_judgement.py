"""Bits 12 to 15 of 2124h: contradiction, calibrated force, temperature, overload, byte for byte (docs/objects.md)."""

import struct
from itertools import pairwise

import pytest

from fingertip.finger import CALIBRATED, CONTACT, FAULT, PUSH, SATURATED, Finger, finger, record
from tipforce.sensor.contact.scalar_redundancy import chi_square_threshold

NOISE = 5e-7  # strain
CONTRADICTION, BEYOND, TEMPERATURE, OVERLOAD = 1 << 12, 1 << 13, 1 << 14, 1 << 15
ALARM = 1e-6


def redundant(n: int, model: float = 0.0, **changes: object) -> Finger:
    """A finger pushed with 1 N that checks its gauges; each force is seen by two gauges or three."""
    limit = chi_square_threshold(ALARM, n - 3)
    data = record(n, noise_strain=NOISE, validity=(0, 0, 0, 0, model), redundancy_limit=limit)
    talk = finger(n, calibrated=data, load=PUSH, noise_microstrain=1e6 * NOISE, **changes)  # type: ignore[arg-type]
    talk.take()
    return talk


def magnitude(sent: dict[int, bytes]) -> int:
    return int(struct.unpack("<h", sent[0x285][:2])[0])


def drift(talk: Finger, gauge: int, microstrain: float) -> None:
    """Add to a gauge what no force explains."""
    talk.source.offset_microstrain = [microstrain if k == gauge else 0.0 for k in range(8)]


def test_two_gauges_of_a_pair_cannot_be_told_apart() -> None:
    """Gauges 1 and 4 see F1 alone: which one drifts cannot be known, so nothing is shown."""
    talk = redundant(6, emcy=True)
    drift(talk, 3, 50.0)
    sent = talk.frames()
    assert sent[0x285][6] == CALIBRATED | FAULT
    assert sent[0x285][:6] == bytes.fromhex("008000800080")
    assert talk.get("H", 0x2124) == CONTRADICTION
    assert sent[0x85] == bytes.fromhex("3050210C00000000")
    drift(talk, 3, 0.0)
    assert talk.frames()[0x285][6] == CALIBRATED | CONTACT
    for _ in range(98):
        assert 0x85 not in talk.frames()
    # 100 ms after the last contradiction it has ended.
    ended = [talk.frames().get(0x85) for _ in range(3)]
    assert [data for data in ended if data] == [bytes.fromhex("00000030500C0000")]


def test_a_gauge_that_contradicts_two_others_is_left_out() -> None:
    """With eight gauges 1, 4 and 7 see F1: two of them agree."""
    talk = redundant(8)
    drift(talk, 3, 50.0)
    sent = talk.frames()
    assert sent[0x285][6] == CALIBRATED | CONTACT | SATURATED
    assert magnitude(sent) == pytest.approx(1000, abs=30)
    assert talk.get("H", 0x2124) == CONTRADICTION | 1 << 3
    assert talk.get("f", 0x6130, 4) == pytest.approx(1e6 * -1e-4 * talk.get("f", 0x6130, 9) + 50.0, abs=3.0)
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 9)] == [0, 0, 0, 1, 0, 0, 0, 0]
    assert talk.get("B", 0x1001) == 0x21
    assert talk.get("I", 0x1003, 1) == 0x000C5030
    assert talk.get("I", 0x1003, 2) == 0x0C045030


def test_the_limit_allows_for_the_model() -> None:
    """One per cent of 100 microstrain is 1 microstrain: what was a contradiction is within the model then."""
    for model, faults in ((0.0, CONTRADICTION), (0.2, 0)):
        talk = redundant(6, model)
        drift(talk, 2, 20.0)
        talk.frames()
        assert talk.get("H", 0x2124) == faults


def test_a_fault_below_the_limit_is_in_the_uncertainty() -> None:
    talk = redundant(6)
    for _ in range(200):  # gauges that agree
        assert talk.frames()[0x285][6] == CALIBRATED | CONTACT
    assert talk.get("H", 0x2124) == 0
    talk.quiet()
    clean = talk.get("f", 0x2107, 1)
    worst = 0.0
    drift(talk, 2, 3.0)
    for _ in range(20):
        talk.frames()
        if talk.get("H", 0x2124) == 0:
            worst = max(worst, talk.get("f", 0x2107, 1))
    assert worst > 2.0 * clean


def validity(**changes: float) -> bytes:
    """A record of three gauges: calibrated to 2 N, overload at 4 N, 10 to 30 degC, model 1 %."""
    known = {"calibrated": 2.0, "overload": 4.0, "low": 10.0, "high": 30.0, "model": 0.01}
    per_kelvin = {"offset_per_K": changes.pop("offset_per_K", 0.0), "gain_per_K": changes.pop("gain_per_K", 0.0)}
    return record(validity=tuple((known | changes).values()), **per_kelvin)  # type: ignore[arg-type]


def test_beyond_the_calibrated_force_the_values_stay_and_the_model_part_grows() -> None:
    talk = finger(calibrated=validity(overload=0.0), load=PUSH)
    talk.sync()
    inside = talk.get("f", 0x2107, 1)
    assert talk.get("H", 0x2124) == 0
    talk.source.load = (3.0, *PUSH[1:])
    assert talk.sync().contact[0] == pytest.approx(3000, abs=2)
    assert talk.get("H", 0x2124) == BEYOND
    # 1 % of each gauge's strain, and half as much again beyond 2 N.
    assert talk.get("f", 0x2107, 1) == pytest.approx(inside * 3.0 * 1.5, rel=0.01)
    talk.quiet()  # no EMCY


def test_overload_hides_the_force_until_it_is_5_percent_below() -> None:
    talk = finger(calibrated=validity(), load=(4.1, *PUSH[1:]), emcy=True)
    sent = talk.frames()
    assert sent[0x285] == bytes.fromhex("008000800080") + bytes((CALIBRATED | SATURATED, sent[0x185][7]))
    assert sent[0x85] == bytes.fromhex("205021") + struct.pack("<HHx", 15, 0)
    assert (talk.get("H", 0x2124), talk.put("H", 0x2130, 0, 3)) == (OVERLOAD | BEYOND, 0x08000022)  # no zero under it
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 8)] == [0, 0, 0, 3, 3, 5, 3]
    talk.source.load = (3.9, *PUSH[1:])
    assert (talk.frames()[0x285][6] & SATURATED, talk.put("H", 0x2130, 0, 1)) == (SATURATED, 0x08000022)  # nor a tare
    talk.source.load = (3.7, *PUSH[1:])
    sent = talk.frames()
    assert sent[0x85] == bytes.fromhex("000000") + struct.pack("<HHx", 0x5020, 15)
    assert magnitude(sent) == pytest.approx(3700, abs=2)


def test_temperature_outside_of_the_calibration() -> None:
    talk = finger(calibrated=validity(), load=PUSH, emcy=True)
    talk.frames()
    talk.source.temperature = 3100
    sent = talk.frames()
    assert magnitude(sent) == pytest.approx(1000, abs=2)
    assert talk.get("H", 0x2124) == TEMPERATURE
    assert sent[0x85] == bytes.fromhex("104209") + struct.pack("<HHx", 14, 0)
    talk.source.temperature = 3000
    assert talk.frames()[0x85] == bytes.fromhex("000000") + struct.pack("<HHx", 0x4210, 14)


def test_temperature_is_compensated_where_it_is_known() -> None:
    """8 K above the reference of 23 degC: 16 microstrain on each gauge, and 1 % of the force for each kelvin."""
    talk = finger(calibrated=validity(offset_per_K=2e-6, gain_per_K=0.01), load=PUSH)
    talk.source.temperature = 2300
    cold = talk.sync().contact
    forces = [talk.get("f", 0x6130, sub) for sub in (4, 5, 6)]
    talk.source.temperature = 2700
    talk.sync()
    warm = [talk.get("f", 0x6130, sub) for sub in (4, 5, 6)]
    assert warm == pytest.approx([(f - 4 * 2e-6 * 1e4) / 1.04 for f in forces], abs=1e-6)
    assert cold[0] == pytest.approx(1000, abs=2)
    assert talk.get("H", 0x2124) == 0


def test_a_temperature_that_is_needed_and_not_known_is_an_uncertainty() -> None:
    talk = finger(calibrated=validity(offset_per_K=2e-6, model=0.0), load=PUSH)
    talk.sync()
    known = talk.get("f", 0x2107, 1)
    talk.source.temperature = -0x8000
    talk.sync()
    assert talk.get("H", 0x2124) == TEMPERATURE
    # Uniform from 10 to 30 degC about 23: rms 6.5 K, times 2 microstrain/K, 0.01 N/microstrain on F1 and F3.
    f1, f3 = talk.get("f", 0x6130, 4), talk.get("f", 0x6130, 6)
    share = (f1 + f3) / (f1 * f1 + f3 * f3) ** 0.5
    rms = ((13 * 13 - 13 * 7 + 7 * 7) / 3) ** 0.5
    expected = (known**2 + (rms * 2e-6 * 1e4 * share) ** 2) ** 0.5
    assert talk.get("f", 0x2107, 1) == pytest.approx(expected, rel=1e-3)


def test_health_is_sent_on_a_change_at_most_every_10_ms() -> None:
    talk = finger(calibrated=validity(), load=PUSH)
    assert talk.put("I", 0x1803, 1, 0x40000485) == 0
    talk.take()
    talk.advance(20_000)
    talk.take()
    sent = []
    for k in range(40):  # the temperature leaves and re-enters the range at each SYNC, every millisecond
        talk.source.temperature = 3100 if k % 2 else 2900
        if 0x485 in talk.frames():
            sent.append(k)
    assert sent[:1] == [1]
    assert [b - a for a, b in pairwise(sent)] == [10] * (len(sent) - 1)
    assert len(sent) == 4
    assert talk.put("I", 0x1803, 1, 0xC0000485) == talk.put("B", 0x1803, 2, 0) == talk.put("I", 0x1803, 1, 0x40000485)
    sent = [0x485 in talk.frames() for talk.source.temperature in (2900, 2900, 3100, 3100, 2900)]
    assert sent[1:] == [False, True, False, True]  # of type 0: with the SYNC of the change
