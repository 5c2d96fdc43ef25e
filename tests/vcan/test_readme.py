"""The README's walk on a bus, pasted without waiting between its lines; the example of a controller of a hand."""

import os
import re
import subprocess
import sys
from pathlib import Path

from vcan.support import REPOSITORY, WAIT_S, RawBus, is_boot_up

HEADING = "## Try it on a bus"
SET_UP = ("source .venv/bin/activate", "tipforce vcan")  # what runs this test has done both
CONTACT = re.compile(r"\s*([56]) \(0x0[56]\)  (\S+) N, phi (\S+) deg, theta (\S+) deg  u\(P\) \S+ N")
LIMIT_S = 400


def walk() -> list[str]:
    """The first two shell blocks under the heading, without comments."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    first, second = text[text.index(HEADING) :].split("```")[1:4:2]
    return [line.split("   #")[0].rstrip() for line in (first + second).splitlines() if line]


def test_both_fingers_show_the_load_that_is_applied(tmp_path: Path) -> None:
    lines = walk()
    assert tuple(lines[:2]) == SET_UP
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    pasted = "\n".join([*lines[2:], "code=$?", "kill $!", "wait", "exit $code", ""])
    done = subprocess.run(
        ["bash"], input=pasted, capture_output=True, text=True, timeout=LIMIT_S, check=False,
        cwd=tmp_path, env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    contacts = [found.groups() for found in map(CONTACT.fullmatch, done.stdout.splitlines()) if found]
    assert [node for node, *_ in contacts] == ["5", "6"], f"{done.stdout}\n{done.stderr}"
    for _, *texts in contacts:
        P, phi, theta = map(float, texts)
        assert abs(P - 4.4) < 0.05
        assert abs(phi - 90.0) < 1.0
        assert abs(theta - 45.0) < 1.0


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
