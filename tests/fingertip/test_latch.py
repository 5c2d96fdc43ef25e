"""The latch: one sample for all PDOs of a SYNC, what it shows unknown; the calibrated span."""

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingertip import finger as rig
from tipforce.sensor.contact import scalar, scalar_uncertainty

NORMAL = (1.0, -170.0, 10.0)  # straight into the tip
PULL_TIP = (0.015, -60.0, 60.0, 0.05, 0.02, 1)
START, END = 0x6148, 0x6149
LOAD = (4.0, 90.0, 90.0)  # F1 = 4 N, F2 = F3 = 0: gauge 1 reads 400 microstrain
ALL = (0x6130, 0x7130, 0x9130, 0x6150, 0x2120, 0x2124)
LIMITS = st.one_of(st.integers(-2, 2), st.floats(width=32, allow_nan=False, allow_infinity=False))


def test_sync_without_a_new_sample_is_stale_and_repeats_the_counter() -> None:
    talk = rig.finger(load=rig.PUSH)
    fresh = talk.sync()
    stale = talk.sync(after_us=10)
    assert (fresh.status & rig.STALE, stale.status & rig.STALE) == (0, rig.STALE)
    assert stale.counter == fresh.counter
    assert stale.gauges == stale.contact == rig.HUSHED
    assert all(math.isnan(value) for value in talk.channels())
    assert [talk.get("i", 0x9130, sub) for sub in range(1, 10)] == [-0x80000000] * 9
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 10)] == [1] * 9
    assert talk.get("h", 0x7100, 1) == rig.UNKNOWN
    assert math.isnan(talk.get("f", 0x6100, 1))
    assert (talk.get("H", 0x2123), talk.get("h", 0x2122)) == (0xFFFF, rig.UNKNOWN)
    again = talk.sync()
    assert again[:3] == fresh[:3]
    assert again.counter == (fresh.counter + 1) % 256


def test_without_sync_a_read_brings_a_sample_of_at_most_100_ms() -> None:
    talk = rig.finger(load=rig.PUSH)
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=1e-3)
    counter = talk.get("B", 0x2121)
    talk.source.load = (2.0, *rig.PUSH[1:])
    talk.advance(99_999)
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=1e-3)
    talk.advance(1)
    assert talk.get("f", 0x6130, 7) == pytest.approx(2.0, abs=2e-3)
    assert talk.get("B", 0x2121) == counter + 1
    talk.sync()
    for command in (0x81, 0x82):  # after a reset of the node, or of communication, without waiting for a SYNC
        talk.now_us += 1000
        talk.nmt(command)
        assert math.isfinite(talk.get("f", 0x6130, 1))


def test_event_driven_health_carries_the_last_latch() -> None:
    talk = rig.finger()
    talk.sync()
    assert talk.put("I", 0x1803, 1, 0x40000485) == 0
    # 23.00 degC, u(P) 1 mN, no front-end fault, 2126h: 1017h, the commit and the COB-ID.
    talk.say("< 485#FC08.0100.0000.03.00")  # a change of 2126h
    talk.say("> 000#8005\n> 000#0105\n< 485#FC08.0100.0000.03.00")
    talk.advance(999_999)
    talk.quiet()
    talk.advance(1)
    talk.say("< 485#FC08.0100.0000.03.00")


@pytest.mark.parametrize(
    ("load", "changes", "set_", "unknown"),
    [
        (rig.PUSH, {}, rig.CALIBRATED | rig.CONTACT, ()),
        ((0.0, 0.0, 0.0), {}, rig.CALIBRATED | rig.UNRESOLVED, (1, 2)),  # no contact: no direction
        ((0.04, 175.0, 10.0), {}, rig.CALIBRATED, (1, 2)),  # above contact-off, never above contact-on
        ((1.0, -110.0, 70.0), {}, rig.CALIBRATED | rig.CONTACT | rig.OUTSIDE, ()),  # outside the pad hides nothing
        ((1.0, 10.0, 10.0), {"tip": PULL_TIP}, rig.CALIBRATED | rig.CONTACT, ()),
        # Noise of 1 N makes the angle worthless, not the force.
        (NORMAL, {"noise_strain": 1e-4}, rig.CALIBRATED | rig.CONTACT | rig.UNRESOLVED, (2,)),
    ],
)
def test_status_bits_and_what_they_make_unknown(
    load: tuple[float, float, float], changes: dict[str, Any], set_: int, unknown: tuple[int, ...]
) -> None:
    talk = rig.finger(calibrated=rig.record(**changes), load=load)
    pdos = talk.sync()
    assert pdos.status == set_
    assert pdos.contact[0] == pytest.approx(1000 * load[0], abs=2)
    for k in range(3):
        assert (pdos.contact[k] == rig.UNKNOWN) == (k in unknown)
        assert math.isnan(talk.get("f", 0x6130, 7 + k)) == (k in unknown)
        assert talk.get("B", 0x6150, 7 + k) == (k in unknown)
    assert rig.UNKNOWN not in pdos.gauges


def test_contact_has_a_hysteresis() -> None:
    talk = rig.finger()
    present = []
    for P in (0.0, 0.04, 0.06, 0.04, 0.03, 0.01, 0.04, 0.06):
        talk.source.load = (P, *NORMAL[1:])
        present.append(talk.sync().status & rig.CONTACT)
    assert present == [0, 0, 1, 1, 1, 0, 0, 1]
    pdos = rig.finger(calibrated=rig.record(tip=(0.0, 0.0, 0.0, 0.0, 0.0, 0))).sync()  # contact-on zero, and no load
    assert pdos.status & (rig.CONTACT | rig.FAULT) == rig.CONTACT
    assert pdos.contact == (0, rig.UNKNOWN, rig.UNKNOWN)


@pytest.mark.parametrize("gap", ["stale", "saturated"])
def test_hysteresis_goes_on_over_a_sample_that_cannot_tell(gap: str) -> None:
    talk = rig.finger(load=NORMAL)
    assert talk.sync().status & rig.CONTACT
    if gap == "saturated":
        talk.source.offset_microstrain[0] = 5000.0
        assert talk.sync().status & (rig.CONTACT | rig.SATURATED) == rig.SATURATED
        talk.source.offset_microstrain[0] = 0.0
    else:
        assert talk.sync(after_us=1).status & (rig.CONTACT | rig.STALE) == rig.STALE
    talk.source.load = (0.03, *NORMAL[1:])
    assert talk.sync().status & rig.CONTACT


@pytest.mark.parametrize("load", [NORMAL, rig.PUSH, (7.5, -150.0, 35.0), (0.3, 100.0, -60.0)])
@pytest.mark.parametrize("pull", [0, 1])
def test_uncertainty_is_that_of_the_sensor_model(load: tuple[float, float, float], pull: int) -> None:
    sigma = 1e-6
    talk = rig.finger(
        calibrated=rig.record(noise_strain=sigma, tip=(0.015, -180.0, 180.0, 0.05, 0.02, pull)), load=load
    )
    talk.sync()
    F = [talk.get("f", 0x6130, sub) for sub in (4, 5, 6)]
    variance = struct.unpack("<f", struct.pack("<f", sigma**2))[0] * rig.matrix()[0][0] ** 2
    u_P, u_phi, u_theta = scalar_uncertainty.uncertainty(
        F[0], F[1], F[2], (variance, 0, 0, variance, 0, variance), bool(pull)
    )
    assert talk.get("f", 0x2107, 1) == pytest.approx(u_P, rel=1e-5)
    assert talk.get("f", 0x2107, 2) == pytest.approx(math.degrees(u_phi), rel=1e-5)
    assert talk.get("f", 0x2107, 3) == pytest.approx(math.degrees(u_theta), rel=1e-4)
    assert talk.get("H", 0x2123) == round(1000 * u_P) == 10
    P, phi, theta, _miss = scalar.contact(F[0], F[1], F[2], bool(pull))
    for sub, value in ((7, P), (8, math.degrees(phi)), (9, math.degrees(theta))):
        assert talk.get("f", 0x6130, sub) == pytest.approx(value, rel=1e-5, abs=1e-4)


def test_uncertainty_and_real32_values_may_be_mapped() -> None:
    talk = rig.finger(load=NORMAL, calibrated=rig.record(noise_strain=1e-6))
    assert talk.put("I", 0x1802, 1, 0xC0000385) == talk.put("B", 0x1A02, 0, 0) == 0
    assert talk.put("I", 0x1A02, 1, 0x21070120) == talk.put("I", 0x1A02, 2, 0x61300720) == 0
    assert talk.put("B", 0x1A02, 0, 2) == talk.put("I", 0x1802, 1, 0x40000385) == 0
    for _ in range(2):
        u_P, P = struct.unpack("<ff", talk.frames()[0x385])
        assert (u_P, P) == (pytest.approx(0.01, rel=1e-4), pytest.approx(1.0, abs=1e-3))
    assert all(math.isnan(value) for value in struct.unpack("<ff", talk.frames(0)[0x385]))  # stale


def test_slow_syncs_alone_latch_whatever_else_is_read_or_sent() -> None:
    """SYNC at 2 Hz with the health PDO on: 31 samples, none lost; a self-latch between two SYNCs would count as one."""
    talk = rig.finger(load=rig.PUSH)
    talk.source.watch_us = 100_000
    assert talk.put("I", 0x1803, 1, 0x40000485) == 0
    counters = []
    for _ in range(31):
        for _ in range(5):
            talk.advance(100_000)
            talk.get("f", 0x6130, 7)
        talk.take()
        counters.append(talk.sync(after_us=0).counter)
    assert np.diff(counters).tolist() == [1] * 30
    before = talk.get("B", 0x2121)
    talk.advance(1_499_999)  # three intervals after the last SYNC
    assert talk.get("B", 0x2121) == before
    talk.advance(1)
    assert talk.get("B", 0x2121) == before + 1


def test_numbered_sync_gives_its_number_to_the_sample() -> None:
    talk = rig.finger(load=rig.PUSH)
    assert talk.put("B", 0x1019, 0, 240) == 0
    for number, after_us, stale in ((7, 1000, 0), (8, 10, rig.STALE), (240, 1000, 0), (1, 1000, 0)):
        *_, status, counter = struct.unpack("<hhhBB", talk.frames(after_us, bytes((number,)))[0x285])
        assert (counter, status & rig.STALE) == (number, stale)
    talk.advance(1_100_000)
    talk.get("f", 0x6130, 7)
    assert talk.get("B", 0x2121) == 0  # no SYNC's latch


def test_tare_between_slow_syncs_uses_a_reading_of_its_own_time() -> None:
    talk = rig.finger(load=rig.PUSH)
    talk.sync()
    talk.source.load = (2.0, *rig.PUSH[1:])
    talk.advance(400_000)
    assert talk.put("H", 0x2130, 0, 1) == 0
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=1e-3)  # the SYNC's latch, of before the tare
    pdos = talk.sync(after_us=1)  # the converter has no further reading yet: that of the tare is new to this SYNC
    assert not pdos.status & rig.STALE
    assert pdos.contact[0] == 0


def shown(talk: rig.Finger, n: int = 3) -> dict[tuple[int, int], bytes | int]:
    """Everything that an SDO client reads of a sample."""
    return {(index, sub): talk.upload(index, sub) for index in ALL for sub in range(n + 7) if sub or index < 0x6000}


@pytest.mark.parametrize(("index", "limit", "load"), [(END, 399.0, 4.0), (START, -399.0, -4.0)])
def test_a_gauge_outside_its_span_is_lost_and_comes_back(index: int, limit: float, load: float) -> None:
    sign, status = (1, 3) if index == END else (-1, 5)
    talk = rig.finger(load=(load, *LOAD[1:]), emcy=True)
    reading = struct.pack("<h", 4000 * sign).hex()
    pad = talk.sync()
    assert pad.gauges == (4000 * sign, 0, 0)
    assert talk.put("f", index, 1, limit) == 0
    talk.now_us += 1000
    end = struct.pack("<h", 32767 * sign).hex()
    talk.say(f"""
        > 080#
        < 185#{end}.0000.0000.06.{pad.counter + 1:02X}
        < 285#0080.0080.0080.06.{pad.counter + 1:02X}
        < 085#1050.21.0100.0000.00  EMCY 5010h of gauge 1
    """)
    assert math.isnan(talk.get("f", 0x6130, 1))
    assert talk.get("i", 0x9130, 1) == sign * 0x7FFFFFFF
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 10)] == [status, 0, 0] + [1] * 6
    assert talk.get("H", 0x2124) == 1
    assert talk.put("I", 0x6139, 4, 0x61726174) == talk.put("I", 0x6125, 1, 0x6F72657A) == 0x08000022
    assert talk.put("f", index, 1, 400.0 * sign) == 0  # equal is inside
    sent = talk.frames()
    assert sent[0x185].hex() == f"{reading}00000000{pad.status:02x}{pad.counter + 2:02x}"
    assert sent[0x85] == bytes.fromhex("0000001050010000")  # cured


def test_with_more_gauges_one_outside_its_span_is_left_out() -> None:
    talk = rig.finger(5, load=(1.0, 175.0, 10.0))
    whole = talk.sync()
    assert talk.put("f", END, 1, 1.0) == 0
    spared = talk.sync()
    assert spared.gauges[0] == 32767
    assert spared.contact == pytest.approx(whole.contact, abs=2)
    assert spared.status == rig.CALIBRATED | rig.CONTACT | rig.SATURATED
    assert talk.get("H", 0x2124) == 1
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 12)] == [3] + [0] * 10


@given(st.integers(1, 9), LIMITS, LIMITS, st.floats(0.0, 30.0), st.floats(-180.0, 180.0))
@settings(max_examples=60)
def test_6130h_is_compared_as_it_is_read(sub: int, start: float, end: float, P: float, phi: float) -> None:
    """A span anywhere, or as many REAL32 steps beside the value as an integer says, which may be none. Where no gauge
    is lost, 6150h alone changes."""
    talk = rig.finger(load=(P, phi, phi - 10.0))
    value = talk.get("f", 0x6130, sub)
    bits = struct.unpack("<i", struct.pack("<f", 0.0 if math.isnan(value) else value))[0]
    span = [struct.unpack("<f", struct.pack("<i", bits + v))[0] if isinstance(v, int) and bits > 9 else v
            for v in (start, end)]  # fmt: skip
    before = shown(talk)
    low, high = (float(np.float32(limit)) for limit in span)
    for index, limit, kept in zip((START, END), span, (low, high), strict=True):
        assert talk.put("f", index, sub, limit) == 0
        assert talk.get("f", index, sub) == kept
    talk.sync()
    if math.isnan(value):
        return
    over = value > high or -(value < low)
    status = bytes(((0, 3, 5)[over],)) if over else before[0x6150, sub]
    lost = bool(over) and sub <= 3
    assert lost or shown(talk) == before | {(0x6150, sub): status}
    assert talk.upload(0x6150, sub) == status
    assert math.isnan(talk.get("f", 0x6130, sub)) == lost
    assert bool(talk.get("H", 0x2124)) == bool(talk.get("B", 0x1001)) == lost
    assert bool(int(talk.get("B", 0x2120)) & rig.SATURATED) == lost


@given(st.integers(1, 9), st.integers(-32767, 32767), st.sampled_from([START, END]), st.sampled_from([0x1000, 0x3000]))
@settings(max_examples=40)
def test_the_integer_forms_are_the_same_span(sub: int, digits: int, index: int, form: int) -> None:
    written, same = rig.finger(load=LOAD), rig.finger(load=LOAD)
    kind = "h" if form == 0x1000 else "i"
    per_unit = 10.0 ** same.get("B", 0x6132, sub)
    assert written.put(kind, index + form, sub, digits) == same.put("f", index, sub, digits / per_unit) == 0
    assert written.upload(index, sub) == same.upload(index, sub)
    assert written.get("h", index + 0x1000, sub) == written.get("i", index + 0x3000, sub) == digits
    written.sync()
    same.sync()
    assert shown(written) == shown(same)
