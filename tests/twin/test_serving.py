"""Fingertips of a MuJoCo model as nodes on a bus in simulated time, and the grasp of docs/examples."""

import itertools
import struct
from collections.abc import Iterator
from types import SimpleNamespace

import can
import mujoco
import numpy as np
import pytest

import grasp
import tipforce
from grasp_controller import ASKED_NEWTONS, control
from tipforce_robots.mujoco import Fingertips, TwinNodes
from twin.models import pressed, push

SITES = {"thumb": "thumb_tip"}
Frame = tuple[int, bytes]


@pytest.fixture
def buses() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    with can.Bus(interface="virtual", channel="twin") as one, can.Bus(interface="virtual", channel="twin") as other:
        yield one, other


def sent(bus: can.BusABC, can_id: int, data: bytes = b"") -> None:
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def received(bus: can.BusABC) -> list[Frame]:
    found = []
    while (message := bus.recv(0.0)) is not None:
        found.append((message.arbitration_id, bytes(message.data)))
    return found


def test_the_frames_say_what_the_sample_says(buses: tuple[can.BusABC, can.BusABC]) -> None:
    """Two twins of one seed: one is read, the other is asked by SYNC."""
    model, data = pressed({"ball": (100.0, 0.0, 0.02)})
    read, served = Fingertips(model, SITES, seed=4), Fingertips(model, SITES, seed=4)
    compared = 0
    with TwinNodes(served, data, buses[0]) as nodes:
        assert received(buses[1]) == [(0x701, b"\x00")]
        sent(buses[1], 0, b"\x01\x00")
        push(model, data, "ball", np.array([0.1, -1.5, 0.0]))
        for _ in range(50):
            mujoco.mj_step(model, data)
            sent(buses[1], 0x80)
            nodes.exchange()
            sample = read.read(data)["thumb"]
            [content] = [content for can_id, content in received(buses[1]) if can_id == 0x281]
            P, phi, theta, status, counter = struct.unpack("<hhhBB", content)
            contact = sample.contact
            assert status == int(sample.status)
            assert counter == contact.counter
            assert round(1000 * contact.P_newtons) == P
            if not np.isnan(contact.theta_deg):
                assert (round(100 * contact.phi_deg), round(100 * contact.theta_deg)) == (phi, theta)
                compared += 1
    assert compared > 20
    assert received(buses[1])[-1] == (0x701, b"\x04")  # stopped on purpose


def test_time_is_that_of_the_simulation(buses: tuple[can.BusABC, can.BusABC]) -> None:
    model, data = pressed({"ball": (100.0, 0.0, 0.02)})
    tips = Fingertips(model, SITES)
    nodes = TwinNodes(tips, data, buses[0])
    sent(buses[1], 0x601, bytes.fromhex("2b17100064000000"))  # 1017h: a heartbeat each 100 ms
    nodes.exchange()
    received(buses[1])
    for _ in range(1000):
        mujoco.mj_step(model, data)
        nodes.exchange()
    assert received(buses[1]) == [(0x701, b"\x7f")] * 5
    # An NMT reset is that of a node with a store: it boots, and its calibration is still there.
    sent(buses[1], 0, b"\x81\x01")
    sent(buses[1], 0x601, bytes.fromhex("4020210000000000"))  # 2120h
    nodes.exchange()
    boot, answer = received(buses[1])
    assert boot == (0x701, b"\x00")
    assert answer[1][4] & int(tipforce.Status.CALIBRATED)
    # The model starts again: so do its nodes.
    mujoco.mj_resetData(model, data)
    with pytest.raises(tipforce.InputError, match="the time of data went back from 500000 to 0 us"):
        nodes.exchange()
    tips.reset()
    nodes.exchange()
    assert received(buses[1]) == [(0x701, b"\x00")]


def test_it_follows_the_clock_and_says_what_it_lost(
    buses: tuple[can.BusABC, can.BusABC], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, data = pressed({"ball": (100.0, 0.0, 0.02)})
    nodes = TwinNodes(Fingertips(model, SITES), data, buses[0])
    clock, steps = itertools.count(0.0, 0.1), itertools.count()
    monkeypatch.setattr("tipforce_robots.mujoco.serving.time", SimpleNamespace(monotonic=lambda: next(clock)))
    lost_s = nodes.follow_clock(lambda: mujoco.mj_step(model, data), lambda: next(steps) == 100)
    assert data.time == pytest.approx(0.05)
    assert lost_s == pytest.approx(10.0, abs=0.4)  # 100 steps of 0.5 ms while the clock goes 0.1 s in each
    with pytest.raises(tipforce.InputError, match=r"period_s = 0.0: allowed is a positive finite number"):
        nodes.follow_sync(lambda: None, 0.0, lambda: True)


def test_a_model_that_is_reset_goes_on(buses: tuple[can.BusABC, can.BusABC]) -> None:
    model, data = pressed({"ball": (100.0, 0.0, 0.02)})
    tips = Fingertips(model, SITES)
    nodes, calls = TwinNodes(tips, data, buses[0]), itertools.count(1)

    def step() -> None:
        if next(calls) == 10:
            mujoco.mj_resetData(model, data)
            tips.reset(np.int64(2))  # type: ignore[arg-type]  # as of a generator of numpy
        else:
            mujoco.mj_step(model, data)

    for _ in range(4):
        sent(buses[1], 0x80)
    nodes.follow_sync(step, 0.002, iter([False] * 4 + [True]).__next__)
    assert next(calls) == 1 + 17  # 4 SYNCs of 4 steps, and the reset
    assert data.time == pytest.approx(7 * 0.0005)
    sent(buses[1], 0x80)
    with pytest.raises(tipforce.InputError, match=r"step: the time of data stays at 0\.0035"):
        nodes.follow_sync(lambda: None, 0.002, iter([False]).__next__)
    # Frames without end do not stop the simulation.
    endless, heard = SimpleNamespace(recv=lambda _timeout_s: can.Message(), send=lambda _: None), itertools.count()
    TwinNodes(tips, data, endless, lambda *_: next(heard))  # type: ignore[arg-type]
    assert next(heard) == 10_000


def test_the_grasp_holds_the_asked_force_within_its_uncertainty_the_same_each_time() -> None:
    gripper, rows, u_P_newtons = grasp.grasp(2.0)
    assert [k for k, row in enumerate(rows) if row.missing.any()] == []
    unknown = [(k, row.messages) for k, row in enumerate(rows) if np.isnan(row.P_newtons).any()]
    assert unknown == []
    for k, finger in enumerate(gripper.tips.node_ids):
        assert 0.003 < u_P_newtons[k] < 0.02
        assert abs(gripper.held(finger) - ASKED_NEWTONS) < u_P_newtons[k]
        errors = [row.P_newtons[k] - loads[finger].P_newtons for row, loads in zip(rows, gripper.loads, strict=True)]
        assert np.std(errors[-500:]) == pytest.approx(u_P_newtons[k], rel=0.15)
        assert abs(np.mean(errors[-500:])) < 0.2 * u_P_newtons[k]
    assert gripper.data.body("ball").xpos[2] > 0.06 + 0.03  # lifted
    again = grasp.grasp(0.5)[1]
    assert [row.P_newtons.tolist() for row in again] == [row.P_newtons.tolist() for row in rows[: len(again)]]


def test_the_same_controller_runs_against_simulated_nodes() -> None:
    with tipforce.simulated_hand(2, {1: (1.9, -85, 95), 2: (2.1, -90, 90)}) as bus:
        rows, u_P_newtons = control(can.Bus(**bus.bus_options), 0.1)
    P = np.array([row.P_newtons for row in rows])
    known = P[np.isfinite(P).all(axis=1)]  # on a loaded machine a SYNC may follow the one before too soon: stale
    assert len(rows) == 50
    assert len(known) > 10
    assert known.mean(axis=0) == pytest.approx([1.9, 2.1], abs=0.01)
    assert all(0.001 < u < 0.02 for u in u_P_newtons)
