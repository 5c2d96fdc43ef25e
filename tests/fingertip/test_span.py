"""The span of a channel (CiA 404 6148h/6149h): a gauge outside it is lost, any other channel only says so in 6150h."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingertip.finger import CALIBRATED, CONTACT, SATURATED, Finger, finger

START, END = 0x6148, 0x6149
LOAD = (4.0, 90.0, 90.0)  # F1 = 4 N, F2 = F3 = 0: gauge 1 reads 400 microstrain
ALL = (0x6130, 0x7130, 0x9130, 0x6150, 0x2120, 0x2124)


def real32(value: float) -> float:
    """The nearest REAL32."""
    nearest: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return nearest


def shown(talk: Finger, n: int = 3) -> dict[tuple[int, int], bytes | int]:
    """Everything that an SDO client reads of a sample."""
    return {(index, sub): talk.upload(index, sub) for index in ALL for sub in range(n + 7) if sub or index < 0x6000}


@pytest.mark.parametrize(("index", "limit", "load"), [(END, 399.0, 4.0), (START, -399.0, -4.0)])
def test_a_gauge_outside_its_span_is_lost_and_comes_back(index: int, limit: float, load: float) -> None:
    sign, status = (1, 3) if index == END else (-1, 5)
    talk = finger(load=(load, *LOAD[1:]), emcy=True)
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
    talk = finger(5, load=(1.0, 175.0, 10.0))
    whole = talk.sync()
    assert talk.put("f", END, 1, 1.0) == 0
    spared = talk.sync()
    assert spared.gauges[0] == 32767
    assert spared.contact == pytest.approx(whole.contact, abs=2)
    assert spared.status == CALIBRATED | CONTACT | SATURATED
    assert talk.get("H", 0x2124) == 1
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 12)] == [3] + [0] * 10


@pytest.mark.parametrize("sub", range(4, 10))
@pytest.mark.parametrize(("index", "beyond", "status"), [(END, -1e-3, 3), (START, 1e-3, 5)])
def test_of_any_other_channel_only_6150h_changes(sub: int, index: int, beyond: float, status: int) -> None:
    talk = finger(load=(1.0, 175.0, 10.0))
    before = shown(talk)
    value = talk.get("f", 0x6130, sub)
    assert talk.put("f", index, sub, value) == 0
    assert shown(talk) == before  # equal is inside
    assert talk.put("f", index, sub, value + beyond) == 0
    assert shown(talk) == before | {(0x6150, sub): bytes((status,))}
    assert talk.sync().status == CALIBRATED | CONTACT
    assert talk.get("B", 0x1001) == 0


def test_the_span_of_an_angle_does_not_wrap() -> None:
    talk = finger(load=(1.0, 175.0, 170.0))
    assert talk.put("f", START, 8, 170.0) == talk.put("f", END, 8, -170.0) == 0  # start over end: not checked
    talk.sync()
    assert talk.get("h", 0x7130, 8) == pytest.approx(17500, abs=2)
    assert talk.get("B", 0x6150, 8) == 3
    assert talk.put("f", END, 8, 174.9) == 0
    assert talk.get("B", 0x6150, 8) == 3
    assert talk.put("f", END, 8, 180.0) == 0
    assert talk.get("B", 0x6150, 8) == 0


REALS = st.floats(width=32, allow_nan=False, allow_infinity=False)


@given(
    st.integers(1, 9),
    st.one_of(st.integers(-2, 2), REALS),
    st.one_of(st.integers(-2, 2), REALS),
    st.floats(0.0, 30.0),
    st.floats(-180.0, 180.0),
)
@settings(max_examples=60)
def test_6130h_is_compared_as_it_is_read(sub: int, start: float, end: float, P: float, phi: float) -> None:
    """A span anywhere, or as many REAL32 steps beside the value as an integer says, which may be none."""
    talk = finger(load=(P, phi, phi - 10.0))
    value = talk.get("f", 0x6130, sub)
    bits = struct.unpack("<i", struct.pack("<f", 0.0 if math.isnan(value) else value))[0]
    span = [struct.unpack("<f", struct.pack("<i", bits + v))[0] if isinstance(v, int) and bits > 9 else v
            for v in (start, end)]  # fmt: skip
    before = talk.get("B", 0x6150, sub)
    for index, limit in zip((START, END), span, strict=True):
        assert talk.put("f", index, sub, limit) == 0
        assert talk.get("f", index, sub) == real32(limit)
    talk.sync()
    if math.isnan(value):
        return
    over = value > real32(span[1]) or -(value < real32(span[0]))
    assert talk.get("B", 0x6150, sub) == ((0, 3, 5)[over] if over else before)
    lost = bool(over) and sub <= 3
    assert math.isnan(talk.get("f", 0x6130, sub)) == lost
    assert lost or talk.get("f", 0x6130, sub) == value
    assert bool(talk.get("H", 0x2124)) == lost
    assert bool(int(talk.get("B", 0x2120)) & SATURATED) == lost


@given(st.integers(1, 9), st.integers(-32767, 32767), st.sampled_from([START, END]), st.sampled_from([0x1000, 0x3000]))
@settings(max_examples=40)
def test_the_integer_forms_are_the_same_span(sub: int, digits: int, index: int, form: int) -> None:
    written, same = finger(load=LOAD), finger(load=LOAD)
    kind = "h" if form == 0x1000 else "i"
    per_unit = 10.0 ** same.get("B", 0x6132, sub)
    assert written.put(kind, index + form, sub, digits) == same.put("f", index, sub, digits / per_unit) == 0
    assert written.upload(index, sub) == same.upload(index, sub)
    assert written.get("h", index + 0x1000, sub) == written.get("i", index + 0x3000, sub) == digits
    written.sync()
    same.sync()
    assert shown(written) == shown(same)
