"""The force controller of docs/examples, written for the MuJoCo twin, against the nodes of `tipforce run`."""

from __future__ import annotations

import os
import subprocess
import sys

from vcan.support import REPOSITORY, WAIT_S, RawBus, is_boot_up


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
