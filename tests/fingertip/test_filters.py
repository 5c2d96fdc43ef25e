"""Filters 61A0h, 61A1h: equal to their definitions, exact however long they run."""

import subprocess
import sys

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_device.testing import MemoryStore
from fingertip.filtered import IIR, MOVING, REPEATING, filtered, ramp
from fingertip.finger import (
    LOAD,
    SAVE,
    STALE,
    UNKNOWN,
    finger,
)  # fmt: skip
from tipforce.fingertip import filters

COUNTS = st.lists(st.integers(-(1 << 23), (1 << 23) - 1), min_size=1, max_size=120)
CONSTANT = st.integers(2, 40)


def outputs(kind: int, constant: int, counts: list[int]) -> list[float]:
    """What a filter of three gauges gives after each conversion; the gauges see c, -c and 3 c."""
    algorithm = filters.algorithm(kind, 3, constant)
    found = []
    for one in counts:
        if algorithm.push((one, -one, 3 * one)):
            output = algorithm.output()
            assert output is not None
            found.append(output)
    return [one[0] for one in found]


def mean_so_far(counts: list[int], constant: int) -> npt.NDArray[np.float64]:
    """Moving average by its definition, in numpy."""
    return np.array([np.mean(counts[max(0, k + 1 - constant) : k + 1]) for k in range(len(counts))])


@given(counts=COUNTS, constant=CONSTANT)
def test_moving_average_is_the_mean_of_the_last(counts: list[int], constant: int) -> None:
    # Sums of integers are exact: only the one division rounds.
    np.testing.assert_allclose(outputs(MOVING, constant, counts), mean_so_far(counts, constant), rtol=1e-15, atol=1e-9)


@given(counts=COUNTS, constant=CONSTANT)
def test_repeating_average_is_the_mean_of_each_block(counts: list[int], constant: int) -> None:
    blocks = len(counts) // constant
    wanted = np.reshape(counts[: blocks * constant], (blocks, constant)).mean(axis=1)
    np.testing.assert_allclose(outputs(REPEATING, constant, counts), wanted, rtol=1e-15, atol=1e-9)


@given(counts=COUNTS, constant=CONSTANT)
def test_first_order_follows_its_equation_to_a_256th_of_a_count(counts: list[int], constant: int) -> None:
    y, wanted = 0.0, []
    for k, x in enumerate(counts):
        y += (x - y) / min(k + 1, constant)
        wanted.append(y)
    assert np.max(np.abs(np.array(outputs(IIR, constant, counts)) - wanted)) <= 1 / 256 + 1e-8


def test_first_order_with_the_longest_constant_starts_as_the_mean() -> None:
    counts = np.random.default_rng(6).integers(-1000, 1000, 5000).tolist()
    assert outputs(IIR, 65535, counts)[-1] == pytest.approx(np.mean(counts), abs=1 / 256)


def test_memory_is_bounded() -> None:
    assert not filters.offered(MOVING, filters.LONGEST_WINDOW + 1)
    window = filters.MovingAverage(8, filters.LONGEST_WINDOW)
    assert len(window._ring) * window._ring.itemsize == 8192


# --- on the node ------------------------------------------------------------------------------------------


def test_type_none_and_a_constant_of_one_have_no_filter_and_load_none() -> None:
    code = (
        "import sys; from tipforce.fingertip.node import fingertip_node as node;"
        "from tipforce.sources.simulated import SimulatedSource as Source;"
        "node(5, Source([[1e-4] * 3] * 3)).step(0, [(0x605, bytes((0x2F, 0xA0, 0x61, 1, 0, 0, 0, 0))), (0x80, b'')]);"
        "print([m for m in sys.modules if m.split('.')[-1] in ('filters', 'front_end', 'random', 'array')])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert shown.stdout == "[]\n"
    talk = filtered(IIR, 1)
    assert talk.device.application.filtering is None
    plain = finger(noise_microstrain=5.0)
    talk = finger(noise_microstrain=5.0)
    assert talk.put("B", 0x61A0, 1, 0) == 0
    assert [talk.sync() for _ in range(20)] == [plain.sync() for _ in range(20)]


@pytest.mark.parametrize("step_us", [1, 100, 500, 10_000])
def test_every_conversion_goes_in_whenever_the_node_is_stepped(step_us: int) -> None:
    """The filter does not hang on the loop: conversions that it came too late for are made up for."""
    talk = filtered(MOVING, 8, calibrated=False)
    ramp(talk)
    talk.now_us = 1_000_000
    while talk.now_us < 1_040_000:
        talk.now_us = min(talk.now_us + step_us, 1_040_000) if step_us > 1 else max(talk.due_us, talk.now_us + 1)
        talk.step()
    pdos = talk.sync(after_us=0)
    # Conversions 73 to 80: their mean is 76.5.
    assert pdos.gauges[0] == 765
    assert talk.get("f", 0x6100, 1) == 800.0  # the field value stays what the converter gave last
    assert talk.get("f", 0x6130, 1) == pytest.approx(76.5, rel=1e-6)


def test_a_moving_average_at_each_sync() -> None:
    talk = filtered(MOVING, 4, calibrated=False)
    ramp(talk)
    talk.now_us = 1_000_000
    seen = [talk.sync(after_us=500).gauges[0] for _ in range(8)]
    assert seen[4:] == [35, 45, 55, 65]


def test_a_repeating_average_brings_a_sample_for_each_block() -> None:
    talk = filtered(REPEATING, 4, calibrated=False)
    ramp(talk)
    got = [talk.sync(after_us=500) for _ in range(16)]
    fresh = [not pdos.status & STALE for pdos in got]
    first = fresh.index(True)
    assert fresh[first:] == [(k - first) % 4 == 0 for k in range(first, 16)]
    counters = [pdos.counter for pdos in got[first:]]
    assert counters == [counters[0] + k // 4 for k in range(len(counters))]
    assert all(pdos.gauges == (UNKNOWN,) * 3 for pdos, new in zip(got, fresh, strict=True) if not new)
    steps = np.diff([pdos.gauges[0] for pdos, new in zip(got, fresh, strict=True) if new])
    assert set(steps) == {40}


def test_frames_of_a_filtered_node_byte_by_byte() -> None:
    talk = finger(calibrated=False)
    talk.source.load = (1.0, 90.0, 0.0)  # F1 = F2 = 1 N: 1000 counts
    talk.say("""
        > 605#2BA1610102000000
        < 585#60A1610100000000
        > 605#2FA0610102000000
        < 585#60A0610100000000
        > 080#
        < 185#0080008000800800   no average of two yet: unknown, stale
        < 285#0080008000800800
        + 1000
        > 080#
        < 185#E803E80300000001   the first
        < 285#0080008000800001
        > 080#
        < 185#0080008000800801   no new one: the counter is repeated
        < 285#0080008000800801
        + 1000
        > 080#
        < 185#E803E80300000002
        < 285#0080008000800002
        > 605#2BA1610100000000
        < 585#80A1610132000906
        > 605#2FA0610103000000
        < 585#80A0610130000906
        > 605#40A0610300000000
        < 585#4FA0610302000000   one filter for all gauges
    """)


@pytest.mark.parametrize("change", [(0x61A1, "H", 5), (0x61A0, "B", MOVING), (0x6114, "I", 1000)])
def test_a_change_begins_anew(change: tuple[int, str, int]) -> None:
    talk = filtered(MOVING, 6, load=(1.0, 90.0, 0.0))
    for _ in range(10):
        talk.sync()
    talk.source.load = (0.0, 0.0, 0.0)
    index, kind, value = change
    assert talk.put(kind, index, 1, value) == 0
    assert talk.sync(after_us=2000).gauges == (0, 0, 0)


def test_stored_with_the_application_parameters() -> None:
    store = MemoryStore()
    talk = filtered(MOVING, 6, store=store)
    assert talk.put("I", 0x1010, 3, SAVE) == 0
    again = finger(store=store, calibrated=False)
    assert [again.get("B", 0x61A0, sub) for sub in (1, 2, 3)] == [MOVING] * 3
    again.source.load = (1.0, 90.0, 0.0)
    assert again.sync(after_us=500).gauges[0] == 500  # one conversion without load, one with
    assert again.put("I", 0x1011, 3, LOAD) == 0
    again.say("> 000#8105\n< 705#00")
    assert again.get("B", 0x61A0, 1) == 0


def test_a_store_with_a_filter_that_is_not_offered_gives_none() -> None:
    talk = finger()
    for sub, kind in ((1, MOVING), (2, IIR), (3, 0)):
        talk.device.od.values[0x61A000 | sub] = kind
        talk.device.od.values[0x61A100 | sub] = 65535
    talk.device.application.on_reset(talk.now_us)
    assert [talk.get("B", 0x61A0, sub) for sub in (1, 2, 3)] == [0] * 3
    assert [talk.get("H", 0x61A1, sub) for sub in (1, 2, 3)] == [1] * 3
