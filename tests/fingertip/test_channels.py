"""Channel objects of CiA 404: three forms of one value, scaling, saturation, units."""

import math
import random
import struct

import pytest

from canopen_device.testing import MemoryStore
from fingertip.finger import FAULT, PUSH, SATURATED, SAVE, Finger, finger, forces, record

SETTINGS = (0x120, 0x121, 0x122, 0x123, 0x124, 0x133, 0x134, 0x135, 0x136, 0x148, 0x149)


def test_channels_of_three_gauges() -> None:
    talk = finger(load=PUSH)
    expected = [*(100.0 * f for f in forces(PUSH)), *forces(PUSH), *PUSH]
    tolerance = [0.051] * 3 + [0.51e-3] * 3 + [0.6e-3, 0.05, 0.1]  # half a count, and what it makes of the angles
    for found, wanted, within in zip(talk.channels(), expected, tolerance, strict=True):
        assert found == pytest.approx(wanted, abs=within)
    units = [talk.get("I", 0x6131, sub) for sub in range(1, 10)]
    assert units == [0xFA010100] * 3 + [0x00210000] * 4 + [0x00410000] * 2
    assert [talk.get("B", 0x6132, sub) for sub in range(1, 10)] == [1, 1, 1, 3, 3, 3, 3, 2, 2]
    assert [talk.get("H", 0x6110, sub) for sub in range(1, 10)] == [70] * 3 + [10001] * 3 + [10002, 10003, 10003]


def test_two_point_scaling_and_offset() -> None:
    talk = finger(calibrated=False, load=(1.0, 90.0, 0.0))  # 1000 counts on gauges 1 and 2
    for index, value in ((0x6120, 100.0), (0x6121, -50.0), (0x6122, 600.0), (0x6123, 200.0), (0x6124, 7.0)):
        assert talk.put("f", index, 1, value) == 0
    talk.advance(100_000)
    # gain 0.5, so -50 + 0.5 * 900 + 7
    assert talk.get("f", 0x6130, 1) == pytest.approx(407.0)
    assert talk.get("h", 0x7130, 1) == 4070
    assert talk.get("f", 0x6130, 2) == pytest.approx(100.0)


def test_scaling_points_that_differ_less_than_real32_tells_are_equal() -> None:
    # INTEGER32 holds 16777217, REAL32 does not: kept finer than it is stored, the two would meet at the restart.
    store = MemoryStore()
    talk = finger(store=store)
    assert talk.put("f", 0x6122, 1, 16777216.0) == 0
    assert talk.put("i", 0x9120, 1, 16777217) == 0x06090030
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    talk.say("> 000#8105\n< 705#00")
    assert finger(store=store, calibrated=False).get("f", 0x6120, 1) == 0.0


def test_settings_are_the_same_after_a_restart() -> None:
    store = MemoryStore()
    talk = finger(store=store)
    for sub in (1, 2, 3):
        assert talk.put("i", 0x9124, sub, 123456789 + sub) == 0
    assert talk.put("f", 0x6123, 1, 1234.5) == talk.put("I", 0x6114, 1, 250) == 0
    assert talk.put("I", 0x1010, 3, SAVE) == 0
    before = [talk.upload(index, sub) for index in (0x6123, 0x6124, 0x7124, 0x9124) for sub in (1, 2, 3)]
    again = finger(store=store, calibrated=False)
    assert [again.upload(index, sub) for index in (0x6123, 0x6124, 0x7124, 0x9124) for sub in (1, 2, 3)] == before
    assert again.source.period_us == 250


def test_flat_scaling_never_raises() -> None:
    # Equal process values make a gauge that reads the same for ever; the frozen-gauge watch must stand that.
    talk = finger(calibrated=record(noise_strain=1e-5), load=PUSH)
    assert talk.put("f", 0x6123, 1, 0.0) == 0
    for _ in range(40):
        pdos = talk.sync()
    assert pdos.status & FAULT  # the other two are frozen: no noise where 100 counts of it are expected
    assert talk.put("f", 0x6123, 1, 1000.0) == 0


@pytest.mark.parametrize(("gain", "end", "status"), [(10.0, 32767, 3), (-10.0, -32767, 5)])
def test_value_beyond_integer16_saturates_and_says_so(gain: float, end: int, status: int) -> None:
    talk = finger(calibrated=False, load=(30.0, 90.0, 0.0))
    assert talk.put("f", 0x6123, 1, gain * 1000.0) == 0
    assert talk.put("f", 0x6148, 1, -1e6) == talk.put("f", 0x6149, 1, 1e6) == 0  # by default it is what INTEGER16 holds
    assert talk.sync().gauges[0] == end
    assert talk.get("B", 0x6150, 1) == status
    assert talk.get("f", 0x6130, 1) == pytest.approx(gain * 3000.0)
    assert talk.get("i", 0x9130, 1) == pytest.approx(gain * 30000.0)


def absurd(talk: Finger, rng: random.Random) -> None:
    """Write a number from the far ends of REAL32 into a random setting; the node may take or refuse it."""
    number = rng.choice([3.4e38, -3.4e38, 1e-45, -1e-45, 0.0, 1.0, 1e20])
    talk.put("f", 0x6000 + rng.choice(SETTINGS), rng.randint(1, 3), number)


def test_absurd_scaling_and_calibration_never_raise() -> None:
    rng = random.Random(20)
    talk = finger(load=PUSH)
    assert talk.put("f", 0x2105, 1, 1e30) == 0
    for k in range(300):
        absurd(talk, rng)
        C = [[rng.choice([3.4e38, -3.4e38, 1e-45, 1.0, 0.0]) for _ in range(3)] for _ in range(3)]
        data = record(C=C, noise_strain=rng.choice([1e-22, 1e-8, 1e18]), tip=(3e38, -3e38, 3e38, 0.0, 0.0, k % 2))
        talk.stage(data)
        talk.commit()
        talk.put("H", 0x2130, 0, k % 4)
        pdos = talk.sync()
        assert len(struct.pack("<3h", *pdos.contact)) == 6
        for index in (0x6130, 0x7130, 0x9130):
            assert all(isinstance(talk.upload(index, sub), bytes) for sub in range(1, 10))
        assert all(isinstance(talk.upload(0x2107, sub), bytes) for sub in (1, 2, 3))
        talk.upload(0x2123)


@pytest.mark.parametrize("n", [3, 5])
def test_a_mapping_read_at_once_has_the_values_of_each_entry(n: int) -> None:
    """The default PDOs are packed by one function; it must give what the entries give one by one."""
    talk, pick = finger(n), random.Random(5)
    od = talk.device.od
    loads = [PUSH, (0.0, 0.0, 0.0), (40.0, 90.0, 0.0), (1.0, 180.0, 170.0), (30.0, -179.998, -170.0), (25.0, 0.0, 90.0)]
    angle = (-180.0, 180.0)
    loads += [(10.0 ** pick.uniform(-3.0, 1.7), pick.uniform(*angle), pick.uniform(*angle)) for _ in range(60)]
    for k, load in enumerate(loads):
        talk.source.load = load
        talk.source.set_fault(0 if k < 8 else pick.choice((0, 0, 0, 3, 2)), 1, 0.0, talk.now_us)
        talk.sync()
        if k == 5:  # F2 = -25 N is zero from now on
            assert talk.put("H", 0x2130, 0, 1) == 0
            loads[6] = 25.0, 0.0, -90.0
        for first in (1, 2, n + 1, n + 4):
            keys = [(0x7130, first + k) for k in range(3)] + [(0x2120, 0), (0x2121, 0)]
            pack = od.packer(keys)
            assert pack is not None
            assert pack() == struct.pack("<hhhBB", *[od.get(*key) for key in keys])
    assert od.packer([(0x7130, 1), (0x7130, 2), (0x7130, 4), (0x2120, 0), (0x2121, 0)]) is None
    assert od.packer([(0x6130, 1)]) is None


@pytest.mark.parametrize(("sign", "end", "status"), [(1, 32767, 3), (-1, -32767, 5)])
def test_saturated_gauge_reads_the_end_of_the_range(sign: int, end: int, status: int) -> None:
    talk = finger(load=PUSH)
    talk.source.offset_microstrain[1] = sign * 5000.0
    pdos = talk.sync()
    assert pdos.gauges[1] == end
    assert pdos.status & (SATURATED | FAULT) == SATURATED
    assert pdos.contact == (-0x8000,) * 3
    assert math.isnan(talk.get("f", 0x6130, 2))
    assert talk.get("i", 0x9130, 2) == sign * 0x7FFFFFFF
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 10)] == [0, status, 0] + [1] * 6
    assert talk.get("H", 0x2124) == 0b10
    # The others still read.
    assert pdos.gauges[0] == pytest.approx(1000 * forces(PUSH)[0], abs=1)
