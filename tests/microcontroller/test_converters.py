"""The converter drivers against chips that behave as their data sheets say, and against chips that fail."""

from typing import Any

import pytest

from fingertip.finger import Finger
from firmware.ads1220 import Ads1220
from firmware.hx711 import Hx711
from firmware.nau7802 import Nau7802
from firmware.source import Gauges
from microcontroller.fakes import FakeAds1220, FakeClock, FakeHx711, FakeNau7802
from microcontroller.rig import chip
from tipforce.dictionary import table
from tipforce.fingertip.node import fingertip_node

STEP_US = 500
START_US = 2_000_000
NO_DATA, WIRE, SUPPLY = (1 << bit for bit in (table.FAULT_NO_DATA, table.FAULT_WIRE_BREAK, table.FAULT_SUPPLY))


KINDS = ["nau7802", "ads1220", "hx711"]


def run(driver: Any, fake: Any, microseconds: int) -> list[tuple[int, ...]]:
    found = []
    for _ in range(microseconds // STEP_US):
        fake.clock.now_us += STEP_US
        counts = driver.poll(fake.clock.now_us)
        if counts is not None:
            found.append(counts)
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("counts", [0, 1, -1, 0x123456, -0x123456, 0x7FFFFF, -0x800000])
def test_counts_arrive_as_they_are(kind: str, counts: int) -> None:
    driver, fake = chip(kind, FakeClock(), [0])
    assert set(run(driver, fake, START_US)) == {(0,)}
    fake.signal[0] = counts
    found = run(driver, fake, 100_000)
    assert found[-1] == (counts,)
    # A converter that is read often enough loses no conversion.
    assert len(found) >= 100_000 // driver.period_us - 1


@pytest.mark.parametrize("kind", KINDS[:2])
def test_two_channels_of_one_chip(kind: str) -> None:
    """What the filter shows just after a change of channel is left out: no reading mixes two gauges."""
    driver, fake = chip(kind, FakeClock(), [1_000_000, -2_000_000])
    found = run(driver, fake, START_US)
    assert len(found) > 20
    assert set(found) == {(1_000_000, -2_000_000)}
    assert driver.period_us < 50_000


def test_nau7802_is_set_up_as_asked() -> None:
    fake = FakeNau7802(FakeClock(), [0, 0])
    run(Nau7802(fake, channels=2, gain=64, rate=80, ldo_millivolts=3300), fake, START_US)
    assert fake.calibrated == 3  # the offset of both channels
    assert fake.registers[1] == 4 << 3 | 6  # VLDO 3.3 V, gain 64
    assert fake.registers[2] & 0x77 == 3 << 4  # 80 conversions a second, no calibration under way
    assert fake.registers[0] & 0x96 == 0x96  # digital and analogue part up, converting, own regulator
    assert fake.registers[0x15] == 0x30
    single = FakeNau7802(FakeClock(), [0])
    run(Nau7802(single, ldo_millivolts=0), single, START_US)
    assert single.registers[0x1C] == 0x80
    assert not single.registers[0] & 0x80


def test_nau7802_calibration_that_fails_is_done_again() -> None:
    fake = FakeNau7802(FakeClock(), [123])
    fake.fail_calibrations = 2
    assert set(run(Nau7802(fake), fake, 2 * START_US)) == {(123,)}


@pytest.mark.parametrize("rate", [20, 45, 330, 1000, 2000, 350])
def test_ads1220_is_set_up_as_asked(rate: int) -> None:
    fake = FakeAds1220(FakeClock(), [5], offset=-100)
    driver = Ads1220(fake, fake.cs, fake.drdy, gain=32, rate=rate, reference="supply")
    run(driver, fake, START_US)
    assert fake.registers[0] == 5 << 1
    assert fake._period_us() == 1000000 // rate
    assert fake.registers[1] & 6 == 4  # continuous, no temperature
    assert fake.registers[2] == 0xC0
    assert driver.offset == -100


def test_ads1220_reads_its_temperature_between_gauges() -> None:
    driver, fake = chip("ads1220", FakeClock(), [7])
    found = run(driver, fake, 10_500_000)
    assert driver.temperature == 2500
    assert set(found) == {(7,)}


def test_hx711_gains_by_pulses() -> None:
    for gain, pulses in ((128, 25), (32, 26), (64, 27)):
        fake = FakeHx711(FakeClock(), [9])
        found = run(Hx711(fake.dout, fake.sck, gain=gain), fake, START_US)
        assert set(fake.pulses_seen) == {pulses}
        assert fake.resets == 1
        assert len(found) > 100


def test_hx711_out_of_step_is_reset() -> None:
    driver, fake = chip("hx711", FakeClock(), [0x123456])
    run(driver, fake, START_US)
    fake.glitch = 1
    found = run(driver, fake, START_US)
    assert fake.resets == 2
    assert set(found) == {(0x123456,)}


def test_hx711_keeps_interrupts_away_while_it_clocks() -> None:
    fake = FakeHx711(FakeClock(), [1])
    held: list[str] = []

    def lock() -> int:
        held.append("lock")
        return 7

    driver = Hx711(fake.dout, fake.sck, lock=lock, unlock=lambda state: held.append(f"un{state}"))
    found = run(driver, fake, START_US)
    assert held[:2] == ["lock", "un7"]
    assert len(held) == 2 * (len(found) + 4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_converter_that_stops_gives_nothing_and_comes_back(kind: str) -> None:
    driver, fake = chip(kind, FakeClock(), [42])
    assert run(driver, fake, START_US)
    fake.stuck = True
    run(driver, fake, 20_000)
    assert run(driver, fake, START_US) == []
    fake.stuck = False
    assert set(run(driver, fake, 2 * START_US)) == {(42,)}


@pytest.mark.parametrize("kind", KINDS[:2])
def test_a_chip_that_is_gone_is_asked_seldom_and_found_again(kind: str) -> None:
    driver, fake = chip(kind, FakeClock(), [42])
    fake.dead = True
    assert run(driver, fake, 1_000_000) == []
    if isinstance(fake, FakeNau7802):
        assert fake.transfers < 100  # every 20 ms: the loop has other work
    fake.dead = False
    assert set(run(driver, fake, START_US)) == {(42,)}
    fake.dead = True
    run(driver, fake, 10_000)
    assert run(driver, fake, 1_000_000) == []


def test_power_that_fails_is_told_with_the_next_reading() -> None:
    driver, fake = chip("nau7802", FakeClock(), [42])
    run(driver, fake, START_US)
    fake.reset()
    assert run(driver, fake, 100_000) == []
    assert driver.faults == SUPPLY
    assert set(run(driver, fake, START_US)) == {(42,)}
    fake.reset()
    fake.unpowered = True  # it answers, but PUR never comes
    assert run(driver, fake, START_US) == []


def test_no_setting_that_a_chip_has_not() -> None:
    clock = FakeClock()
    nau, ads, hx = FakeNau7802(clock, [0]), FakeAds1220(clock, [0]), FakeHx711(clock, [0])
    for build, message in (
        (lambda: Nau7802(nau, gain=3), "gain: 3, allowed 1, 2, 4"),
        (lambda: Nau7802(nau, rate=100), "rate: 100, allowed 10, 20, 40, 80, 320"),
        (lambda: Nau7802(nau, channels=3), "channels: 3, allowed 1, 2"),
        (lambda: Nau7802(nau, ldo_millivolts=5000), "ldo_millivolts: 5000"),
        (lambda: Ads1220(ads, ads.cs, ads.drdy, rate=80), "rate: 80, allowed 20, 45"),
        (lambda: Ads1220(ads, ads.cs, ads.drdy, reference="x"), "reference: 'x', allowed internal"),
        (lambda: Hx711(hx.dout, hx.sck, gain=1), "gain: 1, allowed 32, 64, 128"),
        (lambda: Gauges([], 1.0), "chips: none"),
    ):
        with pytest.raises(ValueError, match=message):
            build()


class Node(Finger):
    """A node with two chips: three gauges, the first chip with two of them."""

    def __init__(self) -> None:
        self.clock = FakeClock(1_000_000)
        self.signals = [[100, 200], [300]]
        pairs = [chip("ads1220", self.clock, signal) for signal in self.signals]
        self.fakes = [pair[1] for pair in pairs]
        self.gauges = Gauges([pair[0] for pair in pairs], 1000.0)
        super().__init__(fingertip_node(5, self.gauges, self.gauges.n), emcy=True)

    def run(self, microseconds: int) -> None:
        for _ in range(microseconds // STEP_US):
            self.now_us = self.clock.now_us = self.clock.now_us + STEP_US
            self.gauges.poll(self.now_us)
            self.step([(0x80, b"")] if self.now_us % 10_000 == 0 else [])

    def frames_of(self, can_id: int) -> list[str]:
        return [data.hex() for sent_id, data in self.sent if sent_id == can_id]

    def faults(self) -> int:
        return int(self.get("H", 0x2124))


@pytest.fixture
def node() -> Node:
    node = Node()
    node.run(500_000)
    assert node.frames_of(0x85)[-1:] in ([], ["0000000800000000"])
    node.take()
    return node


def test_a_silent_chip_is_said_within_two_tenths_of_a_second(node: Node) -> None:
    assert [node.get("i", 0x9100, sub) for sub in (1, 2, 3)] == [100, 200, 300]
    assert node.faults() == 0
    node.fakes[1].stuck = True
    node.run(200_000)
    assert [one[:4] for one in node.frames_of(0x85)] == ["3050"]
    assert node.faults() == NO_DATA
    assert node.frames_of(0x185)[-1][:12] == "008000800080"  # unknown, never an old value
    node.fakes[1].stuck = False
    node.run(500_000)
    assert node.frames_of(0x85)[-1][:4] == "0000"
    assert node.faults() == 0


def test_the_end_of_the_range_is_saturated_and_for_long_a_broken_wire(node: Node) -> None:
    node.signals[0][1] = 0x7FFFFF + 5000
    node.run(100_000)
    assert node.faults() == 2  # gauge 2
    node.run(1_200_000)
    assert node.faults() == 2 | WIRE
    node.signals[0][1] = 0
    node.run(100_000)
    assert node.faults() == 0
    assert node.frames_of(0x85)[-1][:4] == "0000"


def test_the_sample_period_is_never_shorter_than_the_chips_can_do(node: Node) -> None:
    assert node.gauges.period_us == 1000
    node.gauges.period_us = 700_000
    assert (node.gauges.period_us, node.gauges.due_us(5)) == (700_000, 700_005)
