"""Tests of your own against a simulated hand. They run anywhere, and on a real vcan by two environment variables:

CAN_INTERFACE=socketcan CAN_CHANNEL=vcan0 python -m pytest test_hand.py
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import can
import numpy as np
import pytest

import tipforce
from tipforce.host import Faults, FaultyBus, PolledHand, quiet

BUS: dict[str, Any] = {
    "interface": os.environ.get("CAN_INTERFACE", "virtual"),
    "channel": os.environ.get("CAN_CHANNEL", "vcan0"),
}
FINGERS = (1, 2, 3, 4, 5)
FORCES_NEWTONS = np.array([0.5, 1.0, 1.5, 2.0, 2.5])
CONTACT = {node_id: 0x280 + node_id for node_id in FINGERS}


@pytest.fixture
def hand() -> Iterator[tuple[PolledHand, FaultyBus]]:
    """Five fingers that are calibrated and started, and the bus through which you hear them."""
    loads = {n: (P, 90.0, 45.0) for n, P in zip(FINGERS, FORCES_NEWTONS.tolist(), strict=True)}
    with tipforce.simulated_hand(FINGERS, loads, **BUS):
        bus = FaultyBus(can.Bus(**BUS), Faults(), seed=1)
        with tipforce.Bus(bus) as connection:
            found = PolledHand(connection, FINGERS)
            found.start()
            yield found, bus


def test_forces(hand: tuple[PolledHand, FaultyBus]) -> None:
    row = hand[0].sample(timeout_s=1.0)
    assert row.P_newtons == pytest.approx(FORCES_NEWTONS, abs=0.1)
    assert row.theta_deg == pytest.approx(45.0, abs=10.0)


def test_a_lost_answer_is_missing_and_the_finger_comes_back(hand: tuple[PolledHand, FaultyBus]) -> None:
    fingers, bus = hand
    bus.faults = Faults(drop=1.0, only=frozenset({CONTACT[3]}))
    row = fingers.sample(timeout_s=1.0)
    assert row.missing.tolist() == [False, False, True, False, False]
    assert np.isnan(row.P_newtons[2])
    bus.faults = quiet(bus.faults)
    assert not fingers.sample(timeout_s=1.0).missing.any()


def test_every_loss_is_seen(hand: tuple[PolledHand, FaultyBus]) -> None:
    fingers, bus = hand
    bus.faults = Faults(drop=0.2, only=frozenset(CONTACT.values()))
    missing = sum(int(fingers.sample(timeout_s=1.0).missing.sum()) for _ in range(4))
    assert missing == bus.counts["drop"] > 0
