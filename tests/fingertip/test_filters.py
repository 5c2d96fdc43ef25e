"""Filters 61A0h, 61A1h: equal to their definitions, exact; on a node: no average over a bad conversion or a sleep."""

import math
import struct
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device.testing import MemoryStore
from fingertip import finger as rig
from tipforce.fingertip import filters
from tipforce.fingertip.source import Reading, Source
from tipforce.sources.simulated import SATURATED as AT_THE_END
from tipforce.sources.simulated import SILENT, STUCK

MOVING, REPEATING, IIR = filters.MOVING_AVERAGE, filters.REPEATING_AVERAGE, filters.FIRST_ORDER
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


@given(counts=COUNTS, constant=CONSTANT)
def test_moving_average_is_the_mean_of_the_last(counts: list[int], constant: int) -> None:
    # Sums of integers are exact: only the one division rounds.
    means = [np.mean(counts[max(0, k + 1 - constant) : k + 1]) for k in range(len(counts))]
    np.testing.assert_allclose(outputs(MOVING, constant, counts), means, rtol=1e-15, atol=1e-9)


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
    # With the longest constant it starts as the mean.
    assert outputs(IIR, 65535, counts)[-1] == pytest.approx(np.mean(counts), rel=1e-12, abs=1 / 256)


def test_type_none_and_a_constant_of_one_have_no_filter_and_load_none() -> None:
    code = (
        "import sys; from tipforce.fingertip.node import fingertip_node as node;"
        "from tipforce.sources.simulated import SimulatedSource as Source;"
        "node(5, Source([[1e-4] * 3] * 3)).step(0, [(0x605, bytes((0x2F, 0xA0, 0x61, 1, 0, 0, 0, 0))), (0x80, b'')]);"
        "print([m for m in sys.modules if m.split('.')[-1] in ('filters', 'front_end', 'random', 'array')])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert shown.stdout == "[]\n"
    assert rig.filtered(IIR, 1).device.application.filtering is None


@pytest.mark.parametrize("step_us", [1, 100, 500, 10_000])
def test_every_conversion_goes_in_whenever_the_node_is_stepped(step_us: int) -> None:
    """The filter does not hang on the loop: conversions that it came too late for are made up for."""
    talk = rig.filtered(MOVING, 8, calibrated=False)
    # Gauge 1 is in mN ten times the number of the conversion since a second.
    talk.source.forces = lambda now_us: ((now_us - 1_000_000) / 500 / 100, 0.0, 0.0)
    talk.now_us = 1_000_000
    while talk.now_us < 1_040_000:
        talk.now_us = min(talk.now_us + step_us, 1_040_000) if step_us > 1 else max(talk.due_us, talk.now_us + 1)
        talk.step()
    pdos = talk.sync(after_us=0)
    # Conversions 73 to 80: their mean is 76.5.
    assert pdos.gauges[0] == 765
    assert talk.get("f", 0x6100, 1) == 800.0  # the field value stays what the converter gave last
    assert talk.get("f", 0x6130, 1) == pytest.approx(76.5, rel=1e-6)
    assert [talk.sync(after_us=500).gauges[0] for _ in range(3)] == [775, 785, 795]  # one conversion more at each SYNC


def test_frames_of_a_filtered_node_byte_by_byte() -> None:
    talk = rig.finger(calibrated=False)
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
    talk = rig.filtered(MOVING, 6, load=(1.0, 90.0, 0.0))
    for _ in range(10):
        talk.sync()
    talk.source.load = (0.0, 0.0, 0.0)
    index, kind, value = change
    assert talk.put(kind, index, 1, value) == 0
    assert talk.sync(after_us=2000).gauges == (0, 0, 0)


def test_stored_with_the_application_parameters() -> None:
    store = MemoryStore()
    assert rig.filtered(MOVING, 6, store=store).put("I", 0x1010, 3, rig.SAVE) == 0
    again = rig.finger(store=store, calibrated=False)
    assert [again.get("B", 0x61A0, sub) for sub in (1, 2, 3)] == [MOVING] * 3
    again.source.load = (1.0, 90.0, 0.0)
    assert again.sync(after_us=500).gauges[0] == 500  # one conversion without load, one with
    assert again.put("I", 0x1011, 3, rig.LOAD) == 0
    again.say("> 000#8105\n< 705#00")
    assert again.get("B", 0x61A0, 1) == 0


def test_a_store_with_a_filter_that_is_not_offered_gives_none() -> None:
    talk = rig.finger()
    for sub, kind in ((1, MOVING), (2, IIR), (3, 0)):
        talk.device.od.values[0x61A000 | sub] = kind
        talk.device.od.values[0x61A100 | sub] = 65535
    talk.device.application.on_reset(talk.now_us)
    assert [talk.get("B", 0x61A0, sub) for sub in (1, 2, 3)] == [0] * 3
    assert [talk.get("H", 0x61A1, sub) for sub in (1, 2, 3)] == [1] * 3


def test_saturation_within_a_block_shows_before_the_block_ends_and_the_block_begins_anew() -> None:
    talk = rig.filtered(REPEATING, 100, load=rig.PUSH)
    talk.advance(120_000)
    clean = talk.sync()
    assert not clean.status & rig.STALE
    talk.source.fault, talk.source.fault_gauge = AT_THE_END, 2
    assert talk.sync().status & (rig.STALE | rig.SATURATED) == rig.STALE | rig.SATURATED
    assert talk.get("H", 0x2124) == 2
    talk.source.fault = 0
    talk.sync()
    talk.advance(48_000)  # 98 clean conversions
    assert talk.sync(after_us=0).status & rig.STALE
    talk.advance(2_000)
    assert talk.sync(after_us=0)[:3] == clean[:3]


@given(st.data())
@settings(max_examples=30, deadline=None)
def test_no_live_value_holds_a_bad_conversion(data: st.DataObject) -> None:
    """Whatever conversions are at the end of the range, a gauge that is shown is the mean of values that are not."""
    kind = data.draw(st.sampled_from([MOVING, REPEATING, IIR]))
    talk = rig.filtered(kind, data.draw(st.integers(2, 12)), calibrated=False, load=(0.5, 90.0, 0.0))
    bad = data.draw(st.sets(st.integers(0, 79)))
    start = talk.now_us // 500
    talk.source.forces = lambda now_us: (1e6 if now_us // 500 - start in bad else 0.5, 0.0, 0.0)
    seen = set()
    for _ in range(data.draw(st.integers(1, 40))):
        seen.add(talk.sync(after_us=data.draw(st.integers(0, 3000))).gauges[0])
    assert seen <= {rig.UNKNOWN, 32767, 500}


def test_with_more_gauges_the_others_stay_filtered_while_one_is_lost() -> None:
    talk = rig.filtered(MOVING, 50, n=4, calibrated=rig.record(4), noise_microstrain=3.0)
    talk.source.fault, talk.source.fault_gauge = AT_THE_END, 4
    values = []
    for _ in range(200):
        pdos = talk.sync(after_us=500)
        assert pdos.status & rig.SATURATED
        values.append(pdos.gauges[0])
    assert np.std(values[60:]) < 30 / math.sqrt(50) * 2.5  # 30 counts unfiltered


def test_frozen_gauge_is_found_by_raw_counts() -> None:
    talk = rig.filtered(MOVING, 16, calibrated=rig.record(noise_strain=5e-7), load=rig.PUSH, noise_microstrain=0.5)
    for _ in range(100):
        assert not talk.sync().status & rig.FAULT
    talk.source.fault, talk.source.fault_gauge = STUCK, 1
    assert [talk.sync(after_us=500).status & rig.FAULT for _ in range(40)] == [0] * 31 + [rig.FAULT] * 9
    talk.source.fault = 0
    assert talk.sync().status & (rig.FAULT | rig.CALIBRATED | rig.CONTACT) == rig.CALIBRATED | rig.CONTACT


def test_sleep_of_the_loop_ends_an_average() -> None:
    talk = rig.filtered(MOVING, 100, load=(1.0, 90.0, 0.0))
    talk.advance(80_000)
    talk.source.load = (0.0, 0.0, 0.0)
    assert talk.sync(after_us=3_600_000_000).gauges == (0, 0, 0)


class Steady(Source):
    """A front end of its own clock that says nothing of when it converts."""

    def __init__(self) -> None:
        self.taken = -1

    def read(self, now_us: int) -> Reading | None:
        """Counts are the number of the conversion, of one each 500 us from 130 us on."""
        number = (now_us - 130) // 500
        if number == self.taken:
            return None
        self.taken = number
        return Reading((number, -number, 0), 0, 2300)


def test_a_source_that_does_not_say_when_it_converts() -> None:
    talk = rig.filtered(MOVING, 10, calibrated=False, source=Steady())
    talk.advance(50_000)
    talk.get("f", 0x6130, 1)  # of a sample that is taken for it
    # The field value is the newest number, the process value the mean of the last ten.
    assert talk.device.od.get(0x6100, 1) * 0.1 - talk.device.od.get(0x6130, 1) == pytest.approx(0.45)


def test_without_sync_a_slow_output_is_read_as_known() -> None:
    """Between two averages there is nothing newer to read: only a SYNC says stale, or a front end that is silent."""
    talk = rig.filtered(REPEATING, 1000, load=rig.PUSH)  # one each 0.5 s
    assert math.isnan(talk.get("f", 0x6130, 1))
    talk.advance(600_000)
    for _ in range(20):
        talk.advance(110_000)
        assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=2e-3)
    talk.source.fault = SILENT
    talk.advance(250_000)
    assert math.isnan(talk.get("f", 0x6130, 7))


def test_without_a_filter_a_slow_converter_is_neither_stale_nor_silent() -> None:
    talk = rig.finger(load=rig.PUSH)
    assert talk.put("I", 0x6114, 1, 1_000_000) == 0
    talk.now_us = 2_000_000
    talk.step()
    assert not talk.sync(after_us=100).status & rig.STALE
    assert talk.sync(after_us=300_000).status & (rig.STALE | rig.FAULT) == rig.STALE  # not a fault: none was due
    talk.now_us = 3_400_000
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=2e-3)
    talk.advance(500_000)
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=2e-3)


def test_autozero_zeroes_what_is_shown() -> None:
    talk = rig.filtered(MOVING, 64, calibrated=False, noise_microstrain=3.0, offset_microstrain=[40.0, 0.0, 0.0])
    talk.advance(100_000)
    assert talk.put("I", 0x6125, 1, 0x6F72657A) == 0
    shown = [talk.sync().gauges[0] for _ in range(3)]
    assert max(map(abs, shown)) <= 12  # 30 counts of noise in one conversion


@pytest.mark.parametrize(("slow", "within_us"), [("converter", 4000), ("filter", 500_000)])
def test_interrupts_wait_for_what_is_slower_than_the_sample_period(slow: str, within_us: int) -> None:
    """Between two conversions, or two averages, nothing is new, and nothing unknown: no TPDO without a change."""
    constant = 1 if slow == "converter" else 400  # an average each 200 ms
    talk = rig.filtered(REPEATING, constant, calibrated=False)
    assert talk.put("f", 0x6133, 1, 50.0) == 0
    assert talk.put("I", 0x1800, 1, 0xC0000185) == talk.put("B", 0x1800, 2, 255) == 0
    assert talk.put("I", 0x1800, 1, 0x40000185) == 0
    if slow == "converter":
        talk.device.od.values[0x611400 | 1] = 500
        talk.source.period_us = 3125  # as the front end of a microcontroller, which 6114h does not make faster
    talk.advance(500_000)
    talk.take()
    talk.advance(1_000_000)
    talk.quiet()
    talk.source.load = (1.0, 90.0, 0.0)
    talk.advance(within_us)
    assert [struct.unpack("<h", data[:2])[0] for can_id, data in talk.take() if can_id == 0x185] == [1000]
    talk.source.fault = SILENT
    talk.advance(110_000 + within_us)
    assert [struct.unpack("<h", data[:2])[0] for can_id, data in talk.take() if can_id == 0x185] == [rig.UNKNOWN]
