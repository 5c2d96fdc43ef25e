"""The README's walk on a bus, pasted without waiting between its lines."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from vcan.support import REPOSITORY

HEADING = "## Try it on a bus"
SET_UP = ("source .venv/bin/activate", "tipforce vcan")  # what runs this test has done both
CONTACT = re.compile(r"\s*5 \(0x05\)  (\S+) N, phi (\S+) deg, theta (\S+) deg  u\(P\) \S+ N")
LIMIT_S = 400


def walk() -> list[str]:
    """The first shell block under the heading, without comments."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    block = text[text.index(HEADING) :].split("```")[1]
    return [line.split("   #")[0].rstrip() for line in block.splitlines()[1:]]


def test_it_ends_with_the_load_that_it_applied(tmp_path: Path) -> None:
    lines = walk()
    assert tuple(lines[:2]) == SET_UP
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    pasted = "\n".join([*lines[2:], "code=$?", "kill %1", "wait", "exit $code", ""])
    done = subprocess.run(
        ["bash"], input=pasted, capture_output=True, text=True, timeout=LIMIT_S, check=False,
        cwd=tmp_path, env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = CONTACT.fullmatch(done.stdout.splitlines()[-1])
    assert found is not None, done.stdout
    P, phi, theta = map(float, found.groups())
    assert abs(P - 4.4) < 0.05
    assert abs(phi - 90.0) < 1.0
    assert abs(theta - 45.0) < 1.0
