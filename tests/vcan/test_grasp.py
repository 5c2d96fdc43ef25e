"""The force controller of docs/examples, written for the MuJoCo twin, against the nodes of `tipforce run`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from vcan.support import REPOSITORY, WAIT_S, Launch, RawBus, is_boot_up

SCENE = """\
duration_s = 600.0
sync_hz = 1

[[nodes]]
ids = [1, 2]
pdos = ["contact"]

[[loads]]
kind = "static"
P_N = 2.0
phi_deg = -90
theta_deg = 85

[noise]
gauge_microstrain = 0.5
"""


def test_the_controller_of_the_twin_runs_against_nodes(launch: Launch, bus: RawBus, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    launch("run", str(scene), "-i", "socketcan", "-c", "vcan0", "-q")
    bus.until(is_boot_up(2))
    code = (
        "import can, grasp_controller\n"
        "rows, u = grasp_controller.control(can.Bus('vcan0', 'socketcan'), seconds=0.1)\n"
        "known = [row.P_newtons for row in rows if row.P_newtons.sum() > 0.0]  # none that is stale\n"
        "print(*known[-1].round(1), *(0.001 < one < 0.02 for one in u))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=REPOSITORY / "docs" / "examples", capture_output=True, text=True, timeout=2 * WAIT_S, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["2.0", "2.0", "True", "True"], done.stderr
    grips = [int.from_bytes(data, "little", signed=True) for can_id, data in bus.waiting() if can_id == 0x20A]
    assert len(grips) == 50
    assert all(0 < grip < 6000 for grip in grips)


def test_the_controller_grasps_in_a_process_of_its_own(bus: RawBus) -> None:
    """The twin follows the SYNCs of the bus: the force is held although this machine is slower than the clock."""
    folder = REPOSITORY / "docs" / "examples"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    twin = subprocess.Popen([sys.executable, "grasp.py", "socketcan", "vcan0"], env=environment, cwd=folder)
    try:
        bus.until(is_boot_up(2))
        code = (
            "import can, grasp_controller\n"
            "rows, u = grasp_controller.control(can.Bus('vcan0', 'socketcan'), seconds=0.5, paced=False)\n"
            "print(*rows[-1].P_newtons.round(1), any(row.missing.any() for row in rows))"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, cwd=folder, capture_output=True, text=True,
            timeout=2 * WAIT_S, check=False,
        )  # fmt: skip
    finally:
        twin.kill()
        twin.wait()
    assert done.stdout.split() == ["2.0", "2.0", "False"], done.stderr
