"""Filters on a node: no average over a bad conversion, silence or a sleep, and what else works on its outputs."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingertip.filtered import IIR, MOVING, REPEATING, filtered
from fingertip.finger import (
    CALIBRATED,
    CONTACT,
    FAULT,
    PUSH,
    SATURATED,
    STALE,
    UNKNOWN,
    finger,
    record,
)  # fmt: skip
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Reading, Source
from tipforce.sources.simulated import DRIFT, SILENT, STUCK
from tipforce.sources.simulated import SATURATED as AT_THE_END


@pytest.mark.parametrize("kind", [MOVING, IIR])
def test_saturation_shows_at_once_and_leaves_no_trace(kind: int) -> None:
    talk = filtered(kind, 200, load=PUSH)
    clean = [talk.sync() for _ in range(20)][-1]
    talk.source.fault, talk.source.fault_gauge = AT_THE_END, 2
    bad = talk.sync()
    assert bad.status & SATURATED
    assert (bad.gauges[1], bad.contact) == (32767, (UNKNOWN,) * 3)
    assert talk.get("B", 0x6150, 2) == 3
    talk.sync()
    talk.source.fault = 0
    after = talk.sync()
    assert after[:3] == clean[:3]  # not one count of the end of the range is left


def test_saturation_within_a_block_shows_before_the_block_ends_and_the_block_begins_anew() -> None:
    talk = filtered(REPEATING, 100, load=PUSH)
    talk.advance(120_000)
    clean = talk.sync()
    assert not clean.status & STALE
    talk.source.fault, talk.source.fault_gauge = AT_THE_END, 2
    bad = talk.sync()
    assert bad.status & (STALE | SATURATED) == STALE | SATURATED
    assert talk.get("H", 0x2124) == 2
    talk.source.fault = 0
    talk.sync()
    talk.advance(48_000)  # 98 clean conversions
    assert talk.sync(after_us=0).status & STALE
    talk.advance(2_000)
    assert talk.sync(after_us=0)[:3] == clean[:3]


@given(st.data())
@settings(max_examples=30, deadline=None)
def test_no_live_value_holds_a_bad_conversion(data: st.DataObject) -> None:
    """Whatever conversions are at the end of the range, a gauge that is shown is the mean of values that are not."""
    kind = data.draw(st.sampled_from([MOVING, REPEATING, IIR]))
    constant = data.draw(st.integers(2, 12))
    talk = filtered(kind, constant, calibrated=False, load=(0.5, 90.0, 0.0))
    bad = data.draw(st.sets(st.integers(0, 79)))
    start = talk.now_us // 500
    talk.source.forces = lambda now_us: (1e6 if now_us // 500 - start in bad else 0.5, 0.0, 0.0)
    seen = set()
    for _ in range(data.draw(st.integers(1, 40))):
        seen.add(talk.sync(after_us=data.draw(st.integers(0, 3000))).gauges[0])
    assert seen <= {UNKNOWN, 32767, 500}


def test_with_more_gauges_the_others_stay_filtered_while_one_is_lost() -> None:
    talk = filtered(MOVING, 50, n=4, calibrated=record(4), noise_microstrain=3.0)
    talk.source.fault, talk.source.fault_gauge = AT_THE_END, 4
    values = []
    for _ in range(200):
        pdos = talk.sync(after_us=500)
        assert pdos.status & SATURATED
        values.append(pdos.gauges[0])
    assert np.std(values[60:]) < 30 / math.sqrt(50) * 2.5  # 30 counts unfiltered


def test_frozen_gauge_is_found_by_raw_counts() -> None:
    talk = filtered(MOVING, 16, calibrated=record(noise_strain=5e-7), load=PUSH, noise_microstrain=0.5)
    for _ in range(100):
        assert not talk.sync().status & FAULT
    talk.source.fault, talk.source.fault_gauge = STUCK, 1
    statuses = [talk.sync(after_us=500).status & FAULT for _ in range(40)]
    assert statuses == [0] * 31 + [FAULT] * 9
    talk.source.fault = 0
    assert talk.sync().status & (FAULT | CALIBRATED | CONTACT) == CALIBRATED | CONTACT


def test_silence_ends_an_average() -> None:
    talk = filtered(MOVING, 100, load=(1.0, 90.0, 0.0))
    for _ in range(100):
        talk.sync()
    talk.source.fault = SILENT
    assert talk.sync().status & (STALE | FAULT) == STALE
    assert talk.sync(after_us=100_000).status & (STALE | FAULT) == STALE | FAULT
    talk.source.load = (0.0, 0.0, 0.0)
    talk.source.fault = 0
    assert talk.sync().gauges == (0, 0, 0)


def test_a_loop_that_slept_begins_anew() -> None:
    talk = filtered(MOVING, 100, load=(1.0, 90.0, 0.0))
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
    device = fingertip_node(5, Steady())
    device.step(1_000_000)
    for index, kind, value in ((0x61A1, "H", 10), (0x61A0, "B", MOVING)):
        assert device.od.download(index, 1, struct.pack("<" + kind, value)) == 0
    now_us, due_us = 1_000_000, 0
    while now_us < 1_050_000:
        _, due_us = device.step(now_us)
        now_us = due_us
    assert device.od.get(0x6100, 1) != device.od.get(0x6130, 1)
    device.application.refresh(1_050_000)  # type: ignore[union-attr]
    assert device.od.get(0x6100, 1) * 0.1 - device.od.get(0x6130, 1) == pytest.approx(0.45)  # type: ignore[operator]


def test_without_sync_a_slow_output_is_read_as_known() -> None:
    """Between two averages there is nothing newer to read: only a SYNC says stale, or a front end that is silent."""
    talk = filtered(REPEATING, 1000, load=PUSH)  # one each 0.5 s
    assert math.isnan(talk.get("f", 0x6130, 1))
    talk.advance(600_000)
    for _ in range(20):
        talk.advance(110_000)
        assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=2e-3)
    talk.source.fault = SILENT
    talk.advance(250_000)
    assert math.isnan(talk.get("f", 0x6130, 7))


def test_without_a_filter_a_slow_converter_is_neither_stale_nor_silent() -> None:
    talk = finger(load=PUSH)
    assert talk.put("I", 0x6114, 1, 1_000_000) == 0
    talk.now_us = 2_000_000
    talk.step()
    assert not talk.sync(after_us=100).status & STALE
    assert talk.sync(after_us=300_000).status & (STALE | FAULT) == STALE  # not a fault: none was due
    talk.now_us = 3_400_000
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=2e-3)
    talk.advance(500_000)
    assert talk.get("f", 0x6130, 7) == pytest.approx(1.0, abs=2e-3)


def test_autozero_zeroes_what_is_shown() -> None:
    talk = filtered(MOVING, 64, calibrated=False, noise_microstrain=3.0, offset_microstrain=[40.0, 0.0, 0.0])
    talk.advance(100_000)
    assert talk.put("I", 0x6125, 1, 0x6F72657A) == 0
    shown = [talk.sync().gauges[0] for _ in range(3)]
    assert max(map(abs, shown)) <= 12  # 30 counts of noise in one conversion


def test_a_filter_lowers_the_noise_as_theory_says() -> None:
    for kind, constant, factor in ((MOVING, 16, 1 / 16), (IIR, 16, 1 / 31)):
        talk = filtered(kind, constant, calibrated=False, noise_microstrain=10.0)
        talk.advance(60_000)
        values = [talk.sync(after_us=40_000).gauges[0] for _ in range(300)]
        # 100 counts of noise: variance 1/N, and 1/(2 c - 1) of the first-order filter.
        assert np.var(values) == pytest.approx(1e4 * factor, rel=0.3)


def test_interrupts_compare_outputs() -> None:
    talk = filtered(REPEATING, 400, calibrated=False)  # one each 200 ms
    assert talk.put("f", 0x6133, 1, 50.0) == 0
    assert talk.put("I", 0x1800, 1, 0xC0000185) == talk.put("B", 0x1800, 2, 254) == 0
    assert talk.put("I", 0x1800, 1, 0x40000185) == 0
    talk.advance(500_000)
    talk.take()
    talk.advance(1_000_000)
    talk.quiet()  # no change, and no sample between two outputs that would be unknown
    talk.source.load = (1.0, 90.0, 0.0)
    talk.advance(500_000)
    assert any(can_id == 0x185 for can_id, _ in talk.take())


def test_drift_through_a_first_order_filter_lags_by_its_time_constant() -> None:
    talk = filtered(IIR, 100, calibrated=False)
    talk.source.set_fault(DRIFT, 1, 1000.0, talk.now_us)
    talk.advance(1_000_000)
    shown, raw = talk.sync(after_us=500).gauges[0], talk.get("f", 0x6100, 1)
    # 1000 microstrain a second: 5 counts a conversion, times (constant - 1).
    assert raw - shown == pytest.approx(5 * 99, abs=2)
