"""Two nodes in two processes on one bus, read together by the host library."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tipforce.dictionary import objects as od
from tipforce.host.hand.polled import PolledHand
from tipforce.host.network.bus import Bus
from tipforce_tools.demo.job import bounds, case_calibration, coverage_factor
from vcan.support import running_node

CASES = {5: "I", 6: "II"}
LOADS = ((4.4, 90.0, 60.0), (4.4, 0.0, 30.0), (2.0, 150.0, 100.0), (1.0, -20.0, 45.0))  # P N, phi, theta degree


@pytest.fixture
def hand(host: Bus, tmp_path: Path) -> Iterator[PolledHand]:
    """Nodes 5 and 6, calibrated and started."""
    with ExitStack() as stack:
        for node_id, case in CASES.items():
            flags = ("--layout", case, "--offset", "12.0,-8.5,5.3", "--seed", str(node_id))
            store = ("--store", str(tmp_path / f"{node_id}.json"))
            stack.enter_context(running_node(tmp_path, *flags, *store, node_id=node_id))
        hand = PolledHand(host, list(CASES), messages=("Gauges", "Contact"))
        for node_id, case in CASES.items():
            hand.fingers[node_id].apply_calibration(case_calibration(case, pull=True))
        hand.start()
        yield hand


def apply_load(hand: PolledHand, load: tuple[float, float, float]) -> None:
    for finger in hand.fingers.values():
        for entry, value in zip((od.SIMULATION_P, od.SIMULATION_PHI, od.SIMULATION_THETA), load, strict=True):
            finger.sdo.write(entry, value)
    time.sleep(0.002)  # a conversion under the new load


def test_each_sync_gives_one_coherent_sample_per_finger_within_its_bound(hand: PolledHand) -> None:
    z = coverage_factor(len(LOADS) * len(CASES) * 3)
    for load in LOADS:
        apply_load(hand, load)
        sample = hand.sample(timeout_s=5.0)
        assert not sample.missing.any()
        for k, (node_id, case) in enumerate(CASES.items()):
            gauges, contact = (sample.messages[node_id, name].columns for name in ("Gauges", "Contact"))
            assert gauges["counter"].tolist() == contact["counter"].tolist(), "one frame of each, of one sample"
            applied = np.array(load)
            found = np.array([sample.P_newtons[k], sample.phi_deg[k], sample.theta_deg[k]])
            _, bound, _ = bounds(case_calibration(case, pull=True), applied, z)
            error = found - applied
            error[1:] = (error[1:] + 180.0) % 360.0 - 180.0
            assert np.all(np.abs(error) <= bound), (node_id, load, error, bound)
