"""Hold what two fingers grasp with 2 N: a force controller that reads only CAN, at 500 samples a second.

CAN_INTERFACE=socketcan CAN_CHANNEL=vcan0 python grasp_controller.py
"""

from __future__ import annotations

import os
import struct
import time

import can

import tipforce
from tipforce.host import HandSample, PolledHand

FINGERS = (1, 2)
ASKED_NEWTONS, APPROACH_NEWTONS, MOST_NEWTONS = 2.0, 0.6, 6.0
PERIOD_S, GAIN_PER_S = 0.002, 15.0
GRIP_COB_ID = 0x20A  # the first RPDO of the gripper's drive, node 10: its force, INTEGER16 in mN


def control(bus: can.BusABC, seconds: float, paced: bool = True) -> tuple[list[HandSample], list[float]]:
    """Control for ``seconds``; return the samples, and u(P) of each finger in newtons. ``paced``: by the clock."""
    rows = []
    with tipforce.Bus(bus) as connection:
        hand = PolledHand(connection, FINGERS)
        hand.start()
        grip_newtons, next_s = APPROACH_NEWTONS, time.monotonic()
        for _ in range(round(seconds / PERIOD_S)):
            row = hand.sample(timeout_s=0.5 if paced else 30.0)
            force_newtons = row.P_newtons.mean()  # NaN where a finger does not know its force: the grip stays
            if force_newtons > 0.1:  # before the contact the approach goes on
                grip_newtons += GAIN_PER_S * PERIOD_S * (ASKED_NEWTONS - force_newtons)
            grip_newtons = min(max(grip_newtons, 0.0), MOST_NEWTONS)
            connection.send(GRIP_COB_ID, struct.pack("<h", round(1000 * grip_newtons)))
            rows.append(row)
            if paced:
                next_s = max(next_s, time.monotonic() - PERIOD_S) + PERIOD_S
                time.sleep(max(0.0, next_s - time.monotonic()))
        u_P_newtons = [0.001 * float(connection.sdo(node_id)["u_P"]) for node_id in FINGERS]
    return rows, u_P_newtons


if __name__ == "__main__":
    bus = can.Bus(interface=os.environ.get("CAN_INTERFACE"), channel=os.environ.get("CAN_CHANNEL"))
    samples, uncertainties = control(bus, seconds=3.0)
    for k, node_id in enumerate(FINGERS):
        print(f"node {node_id}: {samples[-1].P_newtons[k]:.3f} N, u(P) {uncertainties[k]:.3f} N")
