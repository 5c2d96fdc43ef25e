"""Nodes with five and with eight gauges: their channels, TPDO5 and TPDO6, calibration, product code."""

import math
import struct

import pytest

from fingertip.finger import (
    CALIBRATED,
    CONTACT,
    FAULT,
    PUSH,
    SATURATED,
    Finger,
    finger,
    forces,
    matrix,
    record,
    strain_per_newton,
)
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

F = forces(PUSH)


def gauges(n: int) -> list[float]:
    """Microstrain of all gauges under PUSH."""
    return [100.0 * F[k % 3] * (1, -1)[k // 3 % 2] for k in range(n)]


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7, 8])
def test_identity_and_number_of_channels(n: int) -> None:
    talk = finger(n, load=PUSH)
    assert talk.get("I", 0x1018, 2) == 0x54500100 | n  # bit 8: simulated
    assert talk.get("I", 0x1018, 4) == 4711
    for index, highest in ((0x6130, n + 6), (0x7100, n), (0x6125, n), (0x6139, n + 1), (0x2100, 3 * n), (0x2101, n)):
        assert talk.get("B", index, 0) == highest
    values = talk.channels(n)
    assert values[:n] == pytest.approx(gauges(n), abs=0.051)
    assert values[n:] == pytest.approx([*F, *PUSH], rel=5e-3, abs=1e-3)
    assert talk.get("B", 0x2120) == CALIBRATED | CONTACT


def test_three_gauges_have_four_tpdos() -> None:
    talk = finger()
    assert talk.upload(0x1804, 1) == talk.upload(0x1A04, 1) == 0x06020000


@pytest.mark.parametrize(("n", "last"), [(5, 5), (8, 6)])
def test_further_gauges_go_in_further_tpdos(n: int, last: int) -> None:
    talk = finger(n, load=PUSH)
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
def test_more_gauges_make_the_force_more_certain(n: int) -> None:
    # With C the mean over k gauges the variance of a component is that of one gauge over k.
    sigma = 1e-6
    talk = finger(n, calibrated=record(n, noise_strain=sigma), load=(1.0, 90.0, -90.0))
    talk.frames()
    per_gauge = [len([None for value in row if value]) for row in matrix(n)]
    assert talk.get("f", 0x2107, 1) == pytest.approx(sigma * 1e4 / math.sqrt(per_gauge[0]), rel=1e-5)


@pytest.mark.parametrize("n", [5, 8])
def test_offsets_are_taken_off_before_the_matrix(n: int) -> None:
    offsets = [1e-5 * k for k in range(1, n + 1)]
    talk = finger(n, calibrated=record(n, offsets=offsets), offset_microstrain=[1e6 * value for value in offsets])
    assert struct.unpack("<h", talk.frames()[0x285][:2]) == (0,)
    assert talk.channels(n)[:n] == pytest.approx([1e6 * value for value in offsets], abs=0.01)


def contact_without(lost: dict[int, float], n: int = 5) -> tuple[bytes, Finger]:
    """TPDO2 of a loaded node whose gauges ``lost`` (from 1) are off by so many microstrain."""
    talk = finger(n, load=PUSH)
    for gauge, microstrain in lost.items():
        talk.source.offset_microstrain[gauge - 1] = microstrain
    return talk.frames()[0x285], talk


def test_a_lost_gauge_makes_the_force_less_certain() -> None:
    whole, spared = (contact_without(lost)[1] for lost in ({}, {1: 5000.0}))
    assert spared.get("f", 0x2107, 2) > 1.3 * whole.get("f", 0x2107, 2)  # phi: this load is mostly F3


def test_a_broken_wire_costs_its_gauge_alone() -> None:
    talk = finger(5, load=PUSH)
    talk.break_gauge(2, 4)
    sent = talk.frames()[0x285]
    assert struct.unpack("<h", sent[:2])[0] == pytest.approx(1000, abs=3)
    assert sent[6] & (SATURATED | FAULT) == SATURATED
    assert talk.get("H", 0x2124) == 1 << 3 | 1 << 10
    talk.break_gauge(2, 3)  # the only one that sees F3
    sent = talk.frames()[0x285]
    assert sent[:6] == bytes.fromhex("008000800080")
    assert sent[6] & FAULT


def test_a_frozen_gauge_is_left_out_and_still_shown() -> None:
    noisy = record(5, noise_strain=1e-6)
    talk = finger(5, calibrated=noisy, load=PUSH, noise_microstrain=1.0)
    talk.frames()
    talk.break_gauge(1, 5)
    for _ in range(40):
        sent = talk.frames()[0x285]
    assert sent[6] & (SATURATED | FAULT) == SATURATED
    assert talk.get("H", 0x2124) == 1 << 9 | 1 << 4
    assert talk.get("h", 0x7130, 5) != -0x8000
    assert [talk.get("B", 0x6150, sub) for sub in range(1, 6)] == [0, 0, 0, 0, 1]
    assert struct.unpack("<h", sent[:2])[0] == pytest.approx(1000, abs=100)


def test_condition_limit_counts_for_wide_matrices_as_well() -> None:
    talk = finger(8)
    C = [[1e4] * 8, [1e4] * 7 + [1e4 + 0.5], [0.0, 1e4] * 4]
    talk.stage(record(8, C=C))
    assert talk.commit() == 0x06090031
    assert talk.upload(0x2140) == record(8)


@pytest.mark.parametrize("eds", [b"x", bytes(range(256)) * 40])
def test_node_gives_its_own_eds(eds: bytes) -> None:
    source = SimulatedSource(strain_per_newton())
    talk = Finger(fingertip_node(5, source, eds=eds), source)
    assert talk.upload(0x1021) == eds
    assert talk.get("H", 0x1022) == 0
    assert talk.download(0x1021, 0, b"y") == 0x06010002


def test_node_without_room_for_its_eds_omits_both_objects() -> None:
    talk = finger()
    assert talk.upload(0x1021) == talk.upload(0x1022) == 0x06020000


@pytest.mark.parametrize("n", [5, 8])
def test_saturated_gauge_among_many(n: int) -> None:
    talk = finger(n, load=PUSH)
    talk.source.offset_microstrain[n - 1] = -5000.0
    sent = talk.frames()
    assert sent[0x285][6] & SATURATED
    assert talk.get("h", 0x7130, n) == -32767
    assert talk.get("B", 0x6150, n) == 5
    assert talk.get("H", 0x2124) == 1 << n - 1
    assert struct.unpack("<hhh", sent[0x285][:6]) == (
        pytest.approx(1000, abs=3),
        pytest.approx(17500, abs=20),
        pytest.approx(1000, abs=40),
    )


def test_force_goes_on_while_the_gauges_left_have_rank_3() -> None:
    # Gauges 1, 4 see F1; 2, 5 see F2; 3 alone sees F3.
    for lost in ([1], [2], [4], [5], [1, 2], [4, 5], [2, 4]):
        sent, _ = contact_without(dict.fromkeys(lost, 5000.0))
        assert struct.unpack("<h", sent[:2])[0] == pytest.approx(1000, abs=3), lost
        assert sent[6] & SATURATED
    for lost in ([3], [1, 4], [2, 5], [1, 2, 3]):
        sent, _ = contact_without(dict.fromkeys(lost, 5000.0))
        assert sent[:6] == bytes.fromhex("008000800080"), lost
        assert sent[6] & SATURATED
