"""Bits on the wire, and the budget of a hand."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_device.can_frame import least_bits, most_bits
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.network.bus_load import (
    LoadMeter,
    hand_budget,
    highest_rate_hz,
    range_of_bits,
)  # fmt: skip

identifiers = st.one_of(
    st.integers(0, 0x7FF),
    st.integers(0, 0x7FF).map(lambda n: n | 0x40000000),
    st.integers(0, 0x1FFFFFFF).map(lambda n: n | 0x80000000),
    st.integers(0, 0x1FFFFFFF).map(lambda n: n | 0xC0000000),
)


def test_the_figures_of_the_standard() -> None:
    assert [least_bits(8), most_bits(8), least_bits(0), most_bits(0)] == [111, 135, 47, 55]
    assert [least_bits(8, True), most_bits(8, True)] == [131, 160]


def test_five_fingers_at_a_kilohertz() -> None:
    both = hand_budget(5, 1000, ("Gauges", "Contact"))
    assert both.least_load == pytest.approx(1.16, abs=0.005)
    assert both.most_load == pytest.approx(1.405, abs=0.005)
    one = hand_budget(5, 1000, ("Contact",))
    assert 0.60 < one.least_load < one.most_load < 0.735
    assert hand_budget(15, 243, ("Gauges", "Contact")).most_load == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(("nodes", "pdos"), [(5, ("Contact",)), (15, ("Gauges", "Contact", "Health"))])
def test_the_highest_rate_is_where_the_limit_is(nodes: int, pdos: tuple[str, ...]) -> None:
    rate = highest_rate_hz(nodes, pdos, limit=0.5)
    assert hand_budget(nodes, rate, pdos).most_load == pytest.approx(0.5)
    assert highest_rate_hz(127, ("Health",), bit_rate=10_000) == 0.0


@pytest.mark.parametrize(
    "arguments", [(0, 1.0), (128, 1.0), (1, 0.0), (1, -1.0), (1, float("nan")), (1, 1.0, ("Torque",)), (1, 1.0, ())]
)
def test_refused(arguments: tuple[int, float]) -> None:
    with pytest.raises(InputError):
        hand_budget(*arguments)


@given(st.lists(st.tuples(identifiers, st.binary(max_size=8)), max_size=20))
def test_the_fast_range_is_that_of_each_frame(frames: list[tuple[int, bytes]]) -> None:
    frames = [*frames, (0x20000004, bytes(8))]  # an error frame is not what was on the wire
    array = frame_array([(k, can_id, data) for k, (can_id, data) in enumerate(frames)])
    least, most = range_of_bits(array)
    real = [(0 if i & 0x40000000 else len(data), bool(i & 0x80000000)) for i, data in frames if not i & 0x20000000]
    assert (least, most) == (sum(least_bits(*one) for one in real), sum(most_bits(*one) for one in real))


def test_the_meter_looks_at_the_last_second() -> None:
    meter = LoadMeter(100_000)
    frames = frame_array([(0, 0x181, bytes(8))] * 100)
    assert meter.load(0.0) == (0.0, 0.0)
    for k in range(5):
        meter.add(frames, 0.3 * k)
    meter.add(frames[:0], 1.3)
    low, high = meter.load(1.2)
    assert low == pytest.approx(4 * 100 * 111 / 100_000)
    assert high == pytest.approx(4 * 100 * 135 / 100_000)
    assert meter.load(9.0) == (0.0, 0.0)
