"""Shell blocks without output: their lines that need no hardware and take seconds are run as pasted."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs.page_setups import SETUPS
from docs.runner import Terminal

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"^```(?:sh)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# page -> what its lines begin with; the others need a bus, other programs, or minutes
RUN = {
    "tools.md": ["tipforce plot run.log -o run.png"],
    "scenes.md": ["tipforce run grasp --json -o"],
    "firmware.md": ["tipforce export c"],
    "uncertainty.md": ["tipforce budget"],
}


def lines_of(page: Path) -> list[str]:
    """The lines of the page's shell blocks, without comments."""
    blocks = _BLOCK.findall(page.read_text(encoding="utf-8"))
    return [re.split(r" +# ", line)[0] for block in blocks for line in (block + " # ").splitlines()]


@pytest.mark.parametrize("name", RUN)
def test_lines_without_a_bus(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / name
    with SETUPS.get(name, lambda: contextlib.nullcontext({}))():
        terminal = Terminal()
        for start in RUN[name]:
            (line, *_) = [line for line in lines_of(page) if f"{line}  ".startswith(start)]
            with contextlib.redirect_stdout(None):
                terminal(line)
            assert terminal.code == 0, line


def test_the_bus_over_udp_is_pasted(tmp_path: Path) -> None:
    """With the route that the page names, in a network namespace with loopback only."""
    page = (ROOT / "docs" / "user-mode-linux.md").read_text(encoding="utf-8")
    block = _BLOCK.findall(page[page.index("## A bus without kernel CAN") :])[0]
    route = re.search(r"`sudo (ip link set lo up) && sudo (ip route add [^`]*)`", page)
    assert route is not None
    pasted = "\n".join([*route.groups(), block, "tipforce sdo read 5 simulation.P", "kill %1", "wait"])
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"], "/sbin", "/usr/sbin"])
    command = ["unshare", "--map-root-user", "--net", "bash"]
    try:
        done = subprocess.run([*command, "-c", "true"], capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("unshare is not installed")
    if done.returncode:
        pytest.skip(f"no network namespace here: {done.stderr.decode().strip()}")
    environment = {**os.environ, "PATH": path, "PYTHONPATH": os.pathsep.join(sys.path)}
    done_pasting = subprocess.run(
        command, input=pasted, capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path, env=environment
    )
    assert done_pasting.stdout.splitlines()[-1:] == ["4.4"], done_pasting.stderr
