"""The blocks of 61xxh and 71xxh, the channels of CiA 404, and nodes with four to eight gauges."""

import random
import struct

import pytest

from canopen_device.testing import MemoryStore
from fingertip import finger as rig
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

F = rig.forces(rig.PUSH)


def test_two_point_scaling_and_offset() -> None:
    talk = rig.finger(calibrated=False, load=(1.0, 90.0, 0.0))  # 1000 counts on gauges 1 and 2
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
    talk = rig.finger(store=store)
    assert talk.put("f", 0x6122, 1, 16777216.0) == 0
    assert talk.put("i", 0x9120, 1, 16777217) == 0x06090030
    assert talk.put("I", 0x1010, 1, rig.SAVE) == 0
    talk.say("> 000#8105\n< 705#00")
    assert rig.finger(store=store, calibrated=False).get("f", 0x6120, 1) == 0.0


def test_flat_scaling_never_raises() -> None:
    # Equal process values make a gauge that reads the same for ever; the frozen-gauge watch must stand that.
    talk = rig.finger(calibrated=rig.record(noise_strain=1e-5), load=rig.PUSH)
    assert talk.put("f", 0x6123, 1, 0.0) == 0
    for _ in range(40):
        pdos = talk.sync()
    assert pdos.status & rig.FAULT  # the other two are frozen: no noise where 100 counts of it are expected
    assert talk.put("f", 0x6123, 1, 1000.0) == 0


@pytest.mark.parametrize("n", [3, 5])
def test_a_mapping_read_at_once_has_the_values_of_each_entry(n: int) -> None:
    """The default PDOs are packed by one function; it must give what the entries give one by one."""
    talk, pick = rig.finger(n), random.Random(5)
    od = talk.device.od
    loads = [rig.PUSH, (0.0, 0.0, 0.0), (40.0, 90.0, 0.0), (1.0, 180.0, 170.0), (30.0, -179.998, -170.0)]
    loads += [(25.0, 0.0, 90.0)]
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


def gauges(n: int) -> list[float]:
    return [100.0 * F[k % 3] * (1, -1)[k // 3 % 2] for k in range(n)]


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7, 8])
def test_identity_and_number_of_channels(n: int) -> None:
    talk = rig.finger(n, load=rig.PUSH)
    assert talk.get("I", 0x1018, 2) == 0x54500100 | n  # bit 8: simulated
    assert talk.get("I", 0x1018, 4) == 4711
    for index, highest in ((0x6130, n + 6), (0x7100, n), (0x6125, n), (0x6139, n + 1), (0x2100, 3 * n), (0x2101, n)):
        assert talk.get("B", index, 0) == highest
    values = talk.channels(n)
    assert values[:n] == pytest.approx(gauges(n), abs=0.051)  # half a count, and what it makes of the angles
    assert values[n:] == pytest.approx([*F, *rig.PUSH], rel=5e-3, abs=1e-3)
    assert talk.get("B", 0x2120) == rig.CALIBRATED | rig.CONTACT


@pytest.mark.parametrize(("n", "last"), [(5, 5), (8, 6)])
def test_further_gauges_go_in_further_tpdos(n: int, last: int) -> None:
    talk = rig.finger(n, load=rig.PUSH)
    assert sorted(talk.frames()) == [0x185, 0x285]
    assert talk.upload(0x1800 + last, 1) == 0x06020000
    for number in range(5, last + 1):
        # No COB-ID is assigned to them; the default itself cannot be made valid.
        assert talk.get("I", 0x1800 + number - 1, 1) == 0xC0000000
        assert talk.put("I", 0x1800 + number - 1, 1, 0x40000000) == 0x06090030
        assert talk.put("I", 0x1800 + number - 1, 1, 0x40000000 | 0x195 + 0x100 * (number - 5)) == 0
    sent = talk.frames()
    wanted = [round(10 * value) for value in gauges(n)]
    groups = {0x185: wanted[:3], 0x195: wanted[3:6]} | ({0x295: wanted[6:]} if n > 6 else {})
    assert sorted(sent) == sorted([*groups, 0x285])
    tails = set()
    for can_id, values in groups.items():
        assert list(struct.unpack(f"<{len(values)}h", sent[can_id][:-2])) == values
        tails.add(sent[can_id][-2:])
    assert tails == {sent[0x285][-2:]}


@pytest.mark.parametrize("n", [5, 8])
def test_offsets_are_taken_off_before_the_matrix(n: int) -> None:
    offsets = [1e-5 * k for k in range(1, n + 1)]
    talk = rig.finger(
        n, calibrated=rig.record(n, offsets=offsets), offset_microstrain=[1e6 * value for value in offsets]
    )
    assert struct.unpack("<h", talk.frames()[0x285][:2]) == (0,)
    assert talk.channels(n)[:n] == pytest.approx([1e6 * value for value in offsets], abs=0.01)


def test_a_broken_wire_costs_its_gauge_alone() -> None:
    talk = rig.finger(5, load=rig.PUSH)
    talk.break_gauge(2, 4)
    sent = talk.frames()[0x285]
    assert struct.unpack("<h", sent[:2])[0] == pytest.approx(1000, abs=3)
    assert sent[6] & (rig.SATURATED | rig.FAULT) == rig.SATURATED
    assert talk.get("H", 0x2124) == 1 << 3 | 1 << 10
    talk.break_gauge(2, 3)  # the only one that sees F3
    sent = talk.frames()[0x285]
    assert sent[:6] == bytes.fromhex("008000800080")
    assert sent[6] & rig.FAULT


def test_a_frozen_gauge_is_left_out_and_still_shown() -> None:
    talk = rig.finger(5, calibrated=rig.record(5, noise_strain=1e-6), load=rig.PUSH, noise_microstrain=1.0)
    talk.frames()
    talk.break_gauge(1, 5)
    for _ in range(40):
        sent = talk.frames()[0x285]
    assert sent[6] & (rig.SATURATED | rig.FAULT) == rig.SATURATED
    assert talk.get("H", 0x2124) == 1 << 9 | 1 << 4
    assert talk.get("h", 0x7130, 5) != -0x8000
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 6)] == [0, 0, 0, 0, 1]
    assert struct.unpack("<h", sent[:2])[0] == pytest.approx(1000, abs=100)


def test_condition_limit_counts_for_wide_matrices_as_well() -> None:
    talk = rig.finger(8)
    talk.stage(rig.record(8, C=[[1e4] * 8, [1e4] * 7 + [1e4 + 0.5], [0.0, 1e4] * 4]))
    assert talk.commit() == 0x06090031
    assert talk.upload(0x2140) == rig.record(8)


@pytest.mark.parametrize("eds", [b"x", bytes(range(256)) * 40])
def test_node_gives_its_own_eds(eds: bytes) -> None:
    source = SimulatedSource(rig.strain_per_newton())
    talk = rig.Finger(fingertip_node(5, source, eds=eds), source)
    assert talk.upload(0x1021) == eds
    assert talk.get("H", 0x1022) == 0
    assert talk.download(0x1021, 0, b"y") == 0x06010002


def test_three_gauges_have_four_tpdos_and_a_node_without_room_for_its_eds_no_object_of_it() -> None:
    assert {rig.finger().upload(*place) for place in ((0x1021, 0), (0x1022, 0), (0x1804, 1), (0x1A04, 1))} == {
        0x06020000
    }
