"""Two fingers grasp a ball in MuJoCo and lift it; grasp_controller.py sees their forces as frames on a CAN bus only.

python grasp.py                    both, on a bus inside this process; no display, the same run each time
python grasp.py socketcan vcan0    the gripper alone, for a controller in another process, until Ctrl-C
"""

from __future__ import annotations

import struct
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import can
import mujoco

from grasp_controller import ASKED_NEWTONS, FINGERS, GRIP_COB_ID, PERIOD_S, control
from tipforce.host import HandSample
from tipforce_robots.mujoco import Fingertips, Load, TwinNodes, grasp_model

SECONDS, LIFT_AT_S, LIFT_M_PER_S, LIFT_M = 3.0, 1.2, 0.05, 0.05


@dataclass
class Gripper:
    """The model, its fingertips, and the true loads at each SYNC."""

    seed: int = 0
    model: mujoco.MjModel = field(default_factory=grasp_model)
    loads: list[dict[str, Load]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.data = mujoco.MjData(self.model)
        self.tips = Fingertips(self.model, {"thumb": "thumb_tip", "index": "index_tip"}, seed=self.seed)

    def on_frame(self, cob_id: int, content: bytes) -> None:
        """Obey the controller's command, and note the truth at each SYNC."""
        if cob_id == GRIP_COB_ID:
            self.data.ctrl[:2] = 0.001 * struct.unpack("<h", content)[0]
        elif cob_id == 0x080:
            self.loads.append(self.tips.loads(self.data))

    def step(self) -> None:
        """One time step: lift slowly after a while."""
        self.data.ctrl[2] = min(max(0.0, LIFT_M_PER_S * (self.data.time - LIFT_AT_S)), LIFT_M)
        mujoco.mj_step(self.model, self.data)

    def held(self, finger: str) -> float:
        """Return the true force, the mean of the last half second, newtons."""
        last = self.loads[-round(0.5 / PERIOD_S) :]
        return sum(loads[finger].P_newtons for loads in last) / len(last)

    def serve(self, bus: can.BusABC, stop: Callable[[], bool]) -> None:
        """Serve the fingertips; each SYNC advances the simulation by a period of the controller."""
        with TwinNodes(self.tips, self.data, bus, self.on_frame) as nodes:
            nodes.follow_sync(self.step, PERIOD_S, stop)


def grasp(seconds: float, seed: int = 0) -> tuple[Gripper, list[HandSample], list[float]]:
    """Grasp with the controller; return the gripper, the controller's samples and u(P) of each finger in newtons."""
    gripper, ended = Gripper(seed), threading.Event()
    with can.Bus(interface="virtual", channel="grasp") as nodes_bus:
        thread = threading.Thread(target=gripper.serve, args=(nodes_bus, ended.is_set))
        thread.start()
        try:
            rows, u_P_newtons = control(can.Bus(interface="virtual", channel="grasp"), seconds, paced=False)
        finally:
            ended.set()
            thread.join()
    return gripper, rows, u_P_newtons


def main() -> None:
    """See the module."""
    if len(sys.argv) == 3:
        with can.Bus(interface=sys.argv[1], channel=sys.argv[2]) as bus:
            Gripper().serve(bus, lambda: False)
    gripper, rows, u_P_newtons = grasp(SECONDS)
    print(f"asked for {ASKED_NEWTONS:.3f} N; the columns are the estimate and the truth of each finger")
    for k in range(len(rows) // 12 - 1, len(rows), len(rows) // 12):
        each = zip(rows[k].P_newtons, gripper.loads[k].values(), strict=True)
        print(f"{(k + 1) * PERIOD_S:5.2f} s  " + "  ".join(f"{P:.3f} {load.P_newtons:.3f} N" for P, load in each))
    for k, (finger, node_id) in enumerate(zip(gripper.tips.node_ids, FINGERS, strict=True)):
        print(f"node {node_id}, {finger}: held {gripper.held(finger):.4f} N, u(P) {u_P_newtons[k]:.4f} N")


if __name__ == "__main__":
    main()
