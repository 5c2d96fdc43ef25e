"""The simulated source and the source that replays a recording."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fingertip.finger import CALIBRATED, CONTACT, FAULT, PUSH, SATURATED, STALE, Finger, finger, record
from tipforce.fingertip import Reading, Source, fingertip_node
from tipforce.sources import ReplaySource

STUCK, OPEN, SATURATE, SILENT, DRIFT = 1, 2, 3, 4, 5
WIRE_BREAK = 0x400
NOISE = 0.5  # microstrain: five counts
CONVERTER, ENDS = (16, 10.0), (-32768, 32767)


def noisy(load: tuple[float, float, float] = PUSH) -> Finger:
    """A node whose gauges have the noise that their calibration states."""
    return finger(calibrated=record(noise_strain=NOISE * 1e-6), load=load, noise_microstrain=NOISE)


def inject(talk: Finger, fault: int, gauge: int = 2, magnitude: float = 0.0) -> None:
    assert talk.put("B", 0x2200, 2, gauge) == talk.put("f", 0x2200, 3, magnitude) == 0
    assert talk.put("H", 0x2200, 1, fault) == 0


@pytest.mark.parametrize(
    ("fault", "status", "bits"), [(0, CALIBRATED | CONTACT, 0), (SATURATE, CALIBRATED | SATURATED, 0b100)]
)
def test_neither_noise_nor_an_end_of_the_range_is_a_frozen_gauge(fault: int, status: int, bits: int) -> None:
    talk = noisy()
    inject(talk, fault, 3)
    for _ in range(2000):
        assert talk.sync().status == status
    assert talk.get("H", 0x2124) == bits


def test_a_sync_without_a_new_sample_does_not_take_a_wire_break_away() -> None:
    talk = noisy()
    inject(talk, OPEN)
    assert talk.sync().status == CALIBRATED | SATURATED | FAULT
    assert [talk.get("B", 0x6150, sub) for sub in (1, 2, 3)] == [1, 1, 1]
    assert talk.sync(after_us=1).status == CALIBRATED | SATURATED | FAULT | STALE
    assert talk.get("H", 0x2124) == WIRE_BREAK | 0b10


def test_silent_from_the_start_is_unknown_and_then_a_fault() -> None:
    talk = finger()
    talk.source.fault = SILENT
    talk.say("> 000#8105\n< 705#00\n> 000#0105")
    assert talk.put("H", 0x1017, 0, 0) == 0
    assert talk.sync().status & (STALE | FAULT) == STALE
    assert talk.sync(after_us=200_000).status & (STALE | FAULT) == STALE | FAULT
    assert all(math.isnan(value) for value in talk.channels())


def test_the_load_that_the_source_has_is_read_back() -> None:
    """Also one that did not come over SDO: `tipforce node --load`."""
    talk = finger()
    talk.source.load = (4.5, 90.0, 45.0)
    assert [talk.get("f", 0x2201, sub) for sub in (1, 2, 3)] == [4.5, 90.0, 45.0]


class Bare(Source):
    def __init__(self) -> None:
        self.next: Reading | None = Reading((1, 2, 3), 0, 2500)

    def read(self, now_us: int) -> Reading | None:
        del now_us
        return self.next


def test_a_temperature_beyond_the_range_is_said_once_and_its_end() -> None:
    talk = finger(emcy=True)
    temperatures = (8001, 8001, -0x8000, 2300, 2300, -2001)  # one that is not known ends nothing
    for temperature, codes in zip(temperatures, ([0x4210], [], [], [0], [], [0x4210]), strict=True):
        talk.source.temperature = temperature
        talk.sync()
        assert talk.emcy() == codes, temperature


def test_equal_readings_that_are_not_in_a_row_freeze_nothing() -> None:
    source = Bare()
    talk = finger(source=source, calibrated=record(noise_strain=NOISE * 1e-6))
    for k in range(200):
        source.next = Reading((k // 2, k, -k), 0, 2500)
        assert not talk.sync().status & FAULT


@pytest.mark.parametrize("node_id", [0, 128, -1])
def test_node_id_out_of_range(node_id: int) -> None:
    with pytest.raises(ValueError, match="allowed 1 to 127"):
        fingertip_node(node_id, Bare())


def replay(times_us: list[int], **options: object) -> ReplaySource:
    rows = [(k, -k, 2 * k) for k in range(len(times_us))]
    return ReplaySource(times_us, rows, CONVERTER, ENDS, **options)  # type: ignore[arg-type]


@given(
    st.lists(st.integers(5, 5000), min_size=1, max_size=30), st.integers(0, 10**12), st.sampled_from([0.5, 1.0, 4.0])
)
def test_each_row_comes_once_and_in_time(steps: list[int], start_us: int, speed: float) -> None:
    times = [sum(steps[:k]) for k in range(len(steps) + 1)]
    source = replay([7_000_000 + time for time in times], speed=speed)
    for k, time in enumerate(times):
        now_us = start_us + -int(-time // speed)
        assert source.read(now_us) == ((k, -k, 2 * k), 0, -0x8000)
        assert source.read(now_us) is None
    assert source.over
    assert source.read(start_us + 10**9) is None


def test_rows_that_were_missed_are_passed_over_and_gaps_are_no_reading() -> None:
    source = ReplaySource([0, 1000, 2000, 3000], [(1, 1, 1), None, (3, 3, 3), (4, 4, 4)], CONVERTER, ENDS)
    readings = [source.read(now_us) for now_us in (50, 1050, 1900, 3060)]
    assert [None if one is None else one.counts[0] for one in readings] == [1, None, None, 4]


def test_a_loop_begins_anew_after_the_median_step() -> None:
    source = replay([0, 1000, 2000], loop=True, temperatures=[2300, 2310, 2320])
    found = [source.read(now_us) for now_us in range(500, 10_000, 1000)]
    assert [one.counts[0] for one in found if one is not None] == [0, 1, 2] * 3 + [0]
    assert found[1] is not None
    assert found[1].temperature == 2310
    assert not source.over


@pytest.mark.parametrize(
    ("times", "options", "message"),
    [
        ([], {}, "0 rows"), ([0, 0], {}, "do not increase"), ([1, 0], {}, "do not increase"),
        ([0], {"speed": 0.0}, "speed 0.0"), ([0], {"speed": float("nan")}, "speed nan"),
        ([0], {"speed": float("inf")}, "speed inf"),
    ],
)  # fmt: skip
def test_what_cannot_be_replayed(times: list[int], options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replay(times, **options)
