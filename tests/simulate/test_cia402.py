"""The drive: each transition of CiA 402-2, its modes, limits, faults. docs/examples has BaseNode402 with it."""

from pathlib import Path

import pytest

from canopen_device.eds import read_eds
from canopen_device.machine import Drive, SimulatedDevice
from canopen_device.machine.running import shipped_eds
from canopen_device.testing import Conversation
from tipforce.errors import InputError

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80
DISABLED, READY, ON, ENABLED, QUICK, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08


class Axis(Conversation):
    def __init__(self) -> None:
        self.drive = Drive()
        self.simulated = SimulatedDevice(read_eds(shipped_eds("cia402"), 5), self.drive)
        super().__init__(self.simulated, emcy=True)
        self.step([(0, b"\x01\x05")])

    def store(self, key: int, value: int) -> None:
        size = self.simulated.description.find(key).type.size
        assert self.download(key, 0, (value & 0xFFFFFFFF).to_bytes(4, "little")[:size]) == 0

    def control(self, *words: int) -> int:
        for word in words:
            self.store(0x6040, word)
        return self.state

    def enable(self, mode: int, *stores: tuple[int, int]) -> None:
        """Enable the drive in a mode of operation, after these writes."""
        for key, value in ((0x6060, mode), *stores):
            self.store(key, value)
        self.control(SHUTDOWN, ENABLE)

    @property
    def state(self) -> int:
        word = int(self.simulated[0x6041])
        return word & 0x6F if word & 0x40 == 0 and word & 0x08 == 0 else word & 0x4F

    def bit(self, number: int) -> int:
        return int(self.simulated[0x6041]) >> number & 1


@pytest.mark.parametrize(
    ("words", "state"),
    [
        ((), DISABLED), ((SHUTDOWN,), READY), ((SHUTDOWN, SWITCH_ON), ON), ((SHUTDOWN, SWITCH_ON, ENABLE), ENABLED),
        ((SHUTDOWN, ENABLE), ENABLED), ((SWITCH_ON,), DISABLED), ((ENABLE,), DISABLED), ((SHUTDOWN, DISABLE), DISABLED),
        ((SHUTDOWN, SWITCH_ON, SHUTDOWN), READY), ((SHUTDOWN, ENABLE, SWITCH_ON), ON),
        ((SHUTDOWN, ENABLE, SHUTDOWN), READY), ((SHUTDOWN, ENABLE, DISABLE), DISABLED),
        ((SHUTDOWN, QUICK_STOP), DISABLED), ((SHUTDOWN, ENABLE, QUICK_STOP), QUICK),
        ((SHUTDOWN, SWITCH_ON, QUICK_STOP), DISABLED), ((RESET,), DISABLED),
    ],
)  # fmt: skip
def test_transitions(words: tuple[int, ...], state: int) -> None:
    assert Axis().control(*words) == state


@pytest.mark.parametrize("step_us", [2000, 7000, 45_000, 130_000])  # a busy machine is late
def test_a_profile_move_is_a_trapezoid_that_ends_on_its_target(step_us: int) -> None:
    axis = Axis()
    axis.enable(1, (0x607A, 5000))
    axis.control(0x1F)
    assert (axis.bit(10), axis.bit(12)) == (0, 1)
    fastest, started_us = 0, axis.now_us
    while not axis.bit(10):
        axis.sleep(step_us)
        assert 0 <= int(axis.simulated[0x6064]) <= 5000
        fastest = max(fastest, int(axis.simulated[0x606C]))
        assert axis.now_us < started_us + 2_000_000
    # 10 000/s, reached and left at 100 000/s2: 5000 take 0.5 s and 0.1 s for the two ends.
    assert axis.now_us - started_us == pytest.approx(600_000, abs=max(15_000, step_us))
    assert fastest == 10_000
    assert (axis.simulated[0x6064], axis.simulated[0x606C]) == (5000, 0)
    axis.control(ENABLE)
    assert axis.bit(12) == 0
    axis.store(0x607A, -200)
    axis.control(0x5F)  # relative
    axis.advance(500_000)
    assert axis.simulated[0x6064] == 4800


@pytest.mark.parametrize(("word", "first_is_reached"), [(0x1F, True), (0x3F, False)])
def test_a_second_set_point_waits_or_takes_over(word: int, first_is_reached: bool) -> None:
    axis = Axis()
    axis.enable(1, (0x607A, 1000))
    axis.control(0x1F, ENABLE)
    axis.advance(20_000)
    axis.store(0x607A, -1000)
    axis.control(word, ENABLE)
    highest = 0
    for _ in range(400):
        axis.advance(2000)
        highest = max(highest, int(axis.simulated[0x6064]))
    assert axis.simulated[0x6064] == -1000
    assert (highest == 1000) is first_is_reached


def test_velocity_cyclic_modes_and_limits() -> None:
    axis = Axis()
    axis.enable(3, (0x60FF, -2000))
    axis.advance(10_000)
    assert -2000 < int(axis.simulated[0x606C]) < 0
    axis.advance(90_000)
    assert (axis.simulated[0x606C], axis.bit(10), axis.bit(12)) == (-2000, 1, 0)
    axis.control(ENABLE | 0x100)  # halt
    axis.advance(100_000)
    assert (axis.simulated[0x606C], axis.bit(12)) == (0, 1)
    axis.store(0x6060, 8)
    axis.store(0x607A, 123)
    axis.control(ENABLE)
    axis.step([(0x80, b"")])
    axis.advance(2000)
    assert axis.simulated[0x6064] == 123
    axis.store(0x607A, 2_000_000)
    axis.advance(4000)
    assert (axis.simulated[0x6064], axis.bit(11)) == (1_000_000, 1)
    axis.store(0x6060, 6)
    axis.control(0x1F)
    assert (axis.simulated[0x6064], axis.bit(10), axis.bit(12)) == (0, 1, 1)
    sent = axis.step([(0x605, bytes.fromhex("2f60600004000000"))])  # profile torque: not supported
    assert any(data[:1] == b"\x80" for can_id, data in sent if can_id == 0x585)


def test_homing_by_a_move_ends_at_zero_with_the_offset() -> None:
    axis = Axis()
    axis.enable(8, (0x607A, 500), (0x607C, 25), (0x6098, 17))
    axis.advance(6000)
    axis.store(0x6060, 6)
    axis.control(0x1F)
    assert (axis.simulated[0x6064], axis.bit(10), axis.bit(12)) == (500, 0, 0)
    axis.advance(4000)
    assert 25 < int(axis.simulated[0x6064]) < 500
    axis.advance(2_000_000)
    assert (axis.simulated[0x6064], axis.bit(10), axis.bit(12)) == (25, 1, 1)


def test_a_fault_stops_the_drive_and_is_reset_by_a_rising_edge() -> None:
    axis = Axis()
    axis.enable(3, (0x60FF, 8000))
    axis.advance(200_000)
    axis.sent.clear()
    axis.drive.fail(0x2310)
    assert axis.state == 0x0F  # fault reaction
    axis.advance(100_000)
    assert axis.state == FAULT
    assert axis.simulated[0x603F] == 0x2310
    assert (0x85, b"\x10\x23\x21\0\0\0\0\0") in axis.sent
    assert axis.control(ENABLE) == FAULT
    assert axis.control(RESET) == DISABLED
    assert axis.simulated[0x603F] == 0
    assert axis.simulated[0x1001] == 0
    axis.drive.fail()
    assert axis.control(RESET) == FAULT  # no edge
    assert axis.control(0, RESET) == DISABLED


@pytest.mark.parametrize(("option", "end"), [(2, DISABLED), (6, QUICK)])
def test_quick_stop_ends_disabled_or_stays(option: int, end: int) -> None:
    axis = Axis()
    axis.enable(3, (0x605A, option), (0x60FF, 8000))
    axis.advance(200_000)
    axis.control(QUICK_STOP)
    axis.advance(100_000)
    assert (axis.state, axis.simulated[0x606C]) == (end, 0)


def test_a_file_that_is_no_drive_is_refused() -> None:
    eds = Path(__file__).parents[2] / "eds" / "tipforce-3.eds"
    with pytest.raises(InputError, match=r"no drive \(CiA 402\): without integers at 6040h"):
        SimulatedDevice(read_eds(eds, 5), Drive())
    assert read_eds(shipped_eds("cia402"), 5).warnings == []
