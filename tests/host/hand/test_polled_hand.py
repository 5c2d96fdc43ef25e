"""A hand: one row per SYNC, of one instant, with the missing finger marked."""

from collections.abc import Iterator

import can
import numpy as np
import pytest

from host.bus_with_nodes import FaultyBus, apply_load, beam_calibration, connected, finger, fresh_sample
from tipforce.dictionary import objects as od
from tipforce.errors import InputError
from tipforce.host.hand.polled import PolledHand
from tipforce.host.network.bus import Bus

PATIENCE_S = 0.25  # for a row that stays incomplete
FINGERS = {1: "I", 2: "II", 7: "III"}


@pytest.fixture(scope="module")
def bus() -> Iterator[tuple[Bus, FaultyBus]]:
    with connected(*(finger(n, case) for n, case in FINGERS.items())) as (connection, faulty):
        for node_id, case in FINGERS.items():
            connection.finger(node_id).apply_calibration(beam_calibration(case), store=False)
        yield connection, faulty


@pytest.fixture
def hand(bus: tuple[Bus, FaultyBus]) -> Iterator[PolledHand]:
    hand = PolledHand(bus[0], list(FINGERS), messages=("Gauges", "Contact"))
    hand.start()
    yield hand
    bus[1].fault = lambda message: message
    hand.stop()


def test_the_pdos_of_a_sync_are_of_one_sample(hand: PolledHand) -> None:
    counters = []
    for _ in range(30):
        row = hand.sample(timeout_s=2.0)
        for node_id in FINGERS:
            gauges, contact = row.messages[node_id, "Gauges"], row.messages[node_id, "Contact"]
            assert len(gauges.t_ns) == len(contact.t_ns) == 1
            assert gauges.columns["counter"][0] == contact.columns["counter"][0]
        counters.append([int(row.messages[n, "Contact"].columns["counter"][0]) for n in FINGERS])
    steps = np.diff(np.array(counters), axis=0) % 256
    # A SYNC that comes before the next conversion repeats the counter and is marked stale.
    assert set(steps.ravel().tolist()) <= {0, 1}


def test_a_truncated_pdo_is_a_missing_finger(hand: PolledHand, bus: tuple[Bus, FaultyBus]) -> None:
    def short(message: can.Message) -> can.Message:
        if message.arbitration_id == 0x282:
            message.data = message.data[:5]
            message.dlc = 5
        return message

    bus[1].fault = short
    row = fresh_sample(hand, PATIENCE_S)
    assert row.missing.tolist() == [False, True, False]
    assert np.isnan([row.P_newtons[1], row.phi_deg[1], row.theta_deg[1]]).all()
    assert not np.isnan(row.P_newtons[[0, 2]]).any()
    assert (2, "Gauges") in row.messages


def test_a_sample_never_shows_what_came_before_its_sync(hand: PolledHand, bus: tuple[Bus, FaultyBus]) -> None:
    apply_load(hand.connection, 1, 1.0, 90.0, 60.0)
    hand.connection.sync()
    hand.connection.wait_for({0x281, 0x282, 0x287}, 10.0)
    apply_load(hand.connection, 1, 3.0, 90.0, 60.0)
    assert fresh_sample(hand).P_newtons[0] == pytest.approx(3.0, abs=0.02)
    bus[1].fault = lambda m: None if m.arbitration_id == 0x281 else m
    assert hand.sample(PATIENCE_S).missing[0]


def test_a_silent_converter_is_unknown_not_frozen(hand: PolledHand) -> None:
    apply_load(hand.connection, 7, 2.0, 90.0, 60.0)
    assert not np.isnan(fresh_sample(hand).P_newtons[2])
    sdo = hand.connection.sdo(7)
    sdo.write(od.SIMULATION_FAULT, 4)
    hand.sample(timeout_s=2.0)
    row = hand.sample(timeout_s=2.0)
    sdo.write(od.SIMULATION_FAULT, 0)
    assert not row.missing[2]
    assert np.isnan(row.P_newtons[2])
    assert row.messages[7, "Contact"].columns["stale"][0]


def test_stopped_fingers_are_missing(hand: PolledHand) -> None:
    hand.stop()
    assert hand.sample(PATIENCE_S).missing.all()


@pytest.mark.parametrize(
    ("node_ids", "messages", "text"),
    [
        ([], ("Contact",), r"node-ids \[\]: allowed is each node-id once"),
        ([1, 2, 1], ("Contact",), r"node-ids \[1, 2, 1\]: allowed is each node-id once"),
        ([1], ("Angles",), r"message 'Angles': allowed are Gauges, Contact, Force, Health"),
        ([128], ("Contact",), r"node-id 128: allowed are 1 to 127"),
    ],
)
def test_what_is_not_a_hand(hand: PolledHand, node_ids: list[int], messages: tuple[str, ...], text: str) -> None:
    with pytest.raises(InputError, match=text):
        PolledHand(hand.connection, node_ids, messages=messages)
