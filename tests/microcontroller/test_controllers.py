"""The CAN drivers against fake controllers: order, room, remote and 29-bit frames, states, bit rates."""

from typing import Any

import pytest

from canopen_device.core.emcy import TRANSMIT_OVERFLOW
from firmware.app import Clock, Firmware
from firmware.can_machine import MachineCan
from firmware.can_mcp2515 import Mcp2515, bit_timing
from firmware.can_port import QUEUE, RECEIVE_AT_ONCE
from firmware.source import Gauges
from microcontroller import fake_controllers, fakes, rig
from tipforce_loader.flash import FlashStore

KINDS = ["mcp2515", "machine", "pyb"]
ERROR = 0x20000000


@pytest.fixture(params=KINDS)
def pair(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    return rig.controller(request.param)


def test_frames_come_in_order_and_29_bits_are_left_out(pair: tuple[Any, Any]) -> None:
    port, bus = pair
    bus.coming += [(0x123, b"\1\2\3"), (0x7FF, bytes(range(8))), (0x80000123, b"\4"), (0, b"")]
    bus.coming += [(0x40000705, b""), (0x80000001, b"")]
    assert port.receive() == [(0x123, b"\1\2\3"), (0x7FF, bytes(range(8))), (0, b""), (0x40000705, b"")]
    assert port.receive() == []
    bus.coming += RECEIVE_AT_ONCE * [(0x80000123, b"\4")] + [(0x705, b"\5")]
    assert (port.receive(), port.receive()) == ([], [(0x705, b"\5")])


def test_frames_go_in_order_and_wait_for_room(pair: tuple[Any, Any]) -> None:
    port, bus = pair
    wanted = [(0x585, bytes((k,))) for k in range(20)] + [(0x85, b""), (0x7FF, bytes(8))]
    bus.room = 3
    for frame in wanted:
        port.send(*frame)
    assert bus.sent == wanted[:3]
    assert port.busy()
    for _ in range(len(wanted)):
        bus.free(2) if hasattr(bus, "free") else setattr(bus, "room", 2)
        port.receive()
    assert bus.sent == wanted
    assert not port.busy()


def test_pyb_sends_one_at_a_time() -> None:
    """Its mailboxes would swap frames of one identifier."""
    port, bus = rig.controller("pyb")
    bus.pending = 1
    port.send(1, b"")
    assert bus.sent == []
    bus.pending = 0
    port.receive()
    assert bus.sent == [(1, b"")]


def test_a_full_queue_is_told(pair: tuple[Any, Any]) -> None:
    port, bus = pair
    bus.room = 0
    for _ in range(QUEUE + 2):
        port.send(0x181, b"")
    assert port.receive() == [TRANSMIT_OVERFLOW]


def test_states_become_error_frames(pair: tuple[Any, Any]) -> None:
    port, bus = pair
    for state, expected in ((1, 0x0C), (2, 0x30), (1, 0x0C), (0, 0x40)):
        bus.error = state
        assert port.receive() == [(ERROR | 4, bytes((0, expected)) + bytes(6))]
        assert port.receive() == []
    bus.room = 0
    port.send(0x181, b"")
    bus.error = 3
    assert port.receive() == [(ERROR | 0x40, bytes(8))]
    port.send(0x181, b"")
    assert not port.busy()  # a frame of before would be stale
    before = bus.restarts
    port.restart()
    assert bus.restarts == before + 1
    assert port.receive() == [(ERROR | 4, b"\0\x40" + bytes(6))]


def test_an_overrun_is_told_once() -> None:
    for kind in ("mcp2515", "machine"):
        port, bus = rig.controller(kind)
        bus.overrun = True
        bus.coming.append((1, b""))
        assert sorted(port.receive() + port.receive()) == [(1, b""), (ERROR | 4, b"\0\1" + bytes(6))], kind
        assert port.receive() == []


@pytest.mark.parametrize("oscillator_hz", [8000000, 16000000, 20000000])
@pytest.mark.parametrize("bit_rate", [10000, 20000, 50000, 125000, 250000, 500000, 800000, 1000000])
def test_every_bit_rate_of_cia_301(oscillator_hz: int, bit_rate: int) -> None:
    if (oscillator_hz, bit_rate) in ((8000000, 800000), (8000000, 1000000), (20000000, 800000)):
        with pytest.raises(ValueError, match=f"rate {bit_rate}: not possible with an oscillator of {oscillator_hz} Hz"):
            bit_timing(oscillator_hz, bit_rate)
        return
    bus = fake_controllers.FakeMcp2515(oscillator_hz)
    Mcp2515(bus, bus.cs, bit_rate, oscillator_hz)
    assert bus.bit_rates == [bit_rate]  # the fake checks the rules of the segments


def test_no_mcp2515() -> None:
    bus = fake_controllers.FakeMcp2515()
    bus.dead = True
    with pytest.raises(OSError, match="MCP2515: no response"):
        Mcp2515(bus, bus.cs, 500000)


def firmware_on(clock: fakes.FakeClock, slots: fakes.MemorySlots) -> tuple[Firmware, fake_controllers.FakeMachineCan]:
    bus = fake_controllers.FakeMachineCan()
    port = MachineCan(bus, 125000)
    chips = [rig.chip("ads1220", clock, [k])[0] for k in range(3)]
    return Firmware(5, Gauges(chips, 1000.0), port, FlashStore(slots), 7, Clock(clock.ticks, clock.diff)), bus


def test_the_clock_goes_on_where_ticks_wrap() -> None:
    fake = fakes.FakeClock(fakes.FakeClock.PERIOD - 1000)
    clock = Clock(fake.ticks, fake.diff)
    assert clock.now() == 0
    for k in range(1, 5000):
        fake.now_us += 500_000
        assert clock.now() == 500_000 * k  # more than two wraps


def test_lss_switches_the_bit_rate_after_its_delay_and_nobody_speaks_meanwhile() -> None:
    clock = fakes.FakeClock(0)
    node, bus = firmware_on(clock, fakes.MemorySlots())
    node.poll()
    for data in ("0401", "130004", "15C800"):  # configuration state, 125 -> 50 kbit/s by index 4... , delay 200 ms
        bus.coming.append((0x7E5, bytes.fromhex(data.ljust(16, "0"))))
    node.poll()
    rates: dict[int, int] = {}
    bus.sent.clear()
    for _ in range(1200):
        clock.now_us += 1000
        node.poll()
        rates.setdefault(len(bus.bit_rates), clock.now_us)
        if clock.now_us < 400_000:
            assert bus.sent == []
    assert bus.bit_rates[0] == 125000
    assert len(bus.bit_rates) == 2
    assert rates[2] == 200_000
    assert bus.sent  # heartbeat again


def test_a_bit_rate_that_lss_stored_holds_from_power_on() -> None:
    clock, slots = fakes.FakeClock(0), fakes.MemorySlots()
    node, bus = firmware_on(clock, slots)
    node.poll()
    for data in ("0401", "17"):  # stored without a change: the one the board began with, not LSS's default
        bus.coming.append((0x7E5, bytes.fromhex(data.ljust(16, "0"))))
        node.poll()
    assert firmware_on(clock, slots)[1].bit_rates == [125000]
    for data in ("130006", "17"):
        bus.coming.append((0x7E5, bytes.fromhex(data.ljust(16, "0"))))
        node.poll()
    again, bus = firmware_on(clock, slots)
    assert bus.bit_rates == [125000, 50000]
    again.poll()
    assert bus.sent == [(0x705, b"\0")]


def test_run_feeds_the_watchdog_and_sleeps_shortly() -> None:
    clock = fakes.FakeClock(0)
    node, bus = firmware_on(clock, fakes.MemorySlots())
    fed: list[int] = []

    class OffError(Exception):
        pass

    def sleep(us: int) -> None:
        assert 0 < us <= 500
        clock.now_us += us
        if clock.now_us > 3_000_000:
            raise OffError

    with pytest.raises(OffError):
        node.run(sleep, lambda: fed.append(clock.now_us))
    assert len(fed) > 5000
    assert bus.sent.count((0x705, b"\x7f")) == 3  # heartbeat each second


class Trial:
    def __init__(self) -> None:
        self.on_trial = True

    def confirm(self) -> None:
        self.on_trial = False


@pytest.mark.parametrize(
    ("heard_at_s", "confirmed_at_s", "restarts_at_s"),
    [(0, 5, None), (4, 5, None), (20, 20, None), (59, 59, None), (None, None, 60)],
    ids=["at once", "before 5 s", "later", "just in time", "never"],
)
def test_a_program_on_trial_is_confirmed_after_5_s_and_a_frame_and_given_up_after_60_s(
    heard_at_s: int | None, confirmed_at_s: int | None, restarts_at_s: int | None
) -> None:
    clock, trial, restarts = fakes.FakeClock(0), Trial(), []
    node, bus = firmware_on(clock, fakes.MemorySlots())
    node._programs = trial  # type: ignore[assignment]
    node._restart = lambda: restarts.append(clock.now_us)
    confirmed: int | None = None
    for second in range(62):
        clock.now_us = 1_000_000 * second
        if second == heard_at_s:
            bus.coming.append((0x123, b""))
        node.poll()
        if confirmed is None and not trial.on_trial:
            confirmed = second
    assert confirmed == confirmed_at_s
    assert restarts[:1] == ([] if restarts_at_s is None else [1_000_000 * restarts_at_s])
