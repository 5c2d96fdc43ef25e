"""Nodes in processes of their own: held by the example's force controller, shown by `tipforce view`."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from tipforce.host.configuration.calibration import write_calibration
from tipforce_tools.demo.job import bounds, case_calibration, coverage_factor
from tools.view.support import Page, get
from vcan.support import BUS, REPOSITORY, WAIT_S, Command, RawBus, is_boot_up, running_node, wait_until


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


PAGE_LOADS = {5: ("I", (4.4, 90.0, 60.0)), 6: ("II", (2.0, 150.0, 100.0))}  # case, and P N, phi, theta degree
SYNC_HZ = 50
# A sample is live for 2.5 SYNC periods, counted in SYNCs as they come; that they stop is seen after 0.1 s. The page
# takes the period from the SYNCs themselves; before it has three of them, the limit is 0.5 s.
LIVE_MS = 1.1 * 2.5 * 1000 / SYNC_HZ + 100
FIRST_MS = 500.0
JSON_STEP = np.array([5e-5, 5e-4, 5e-4])  # half a digit of what the events carry
SAMPLES = 20

Message = dict[str, Any]


def server_of(command: Command) -> Any:
    """The server of `tipforce view`, as tools.view.support takes it."""
    wait_until(lambda: "\n" in command.stdout or command.ended, "the page's address should be told")
    assert not command.ended, command.stderr
    parts = urlsplit(json.loads(command.stdout)["url"])
    assert (parts.hostname, parts.path, parts.query) == ("127.0.0.1", "/", "")
    return SimpleNamespace(guard=SimpleNamespace(port=parts.port))


@pytest.fixture
def pages(tmp_path: Path) -> Iterator[dict[str, Any]]:
    """Two loaded nodes; `view hand.toml`, which calibrates and starts them and sends the SYNC; `view -i -c` beside.

    Afterwards the commands end as they should.
    """
    folder = tmp_path
    text = f'[bus]\ninterface = "socketcan"\nchannel = "vcan0"\n[hand]\nsync_hz = {SYNC_HZ}\n'
    for node_id, (case, _) in PAGE_LOADS.items():
        write_calibration(folder / f"{case}.toml", case_calibration(case, pull=True))
        text += f'[[finger]]\nnode_id = {node_id}\nlayout = "{case}"\ncalibration = "{case}.toml"\n'
    (folder / "hand.toml").write_text(text)
    with ExitStack() as stack:
        for node_id, (case, load) in PAGE_LOADS.items():
            flags = ("--layout", case, "--offset", "12.0,-8.5,5.3", "--load", ",".join(map(str, load)))
            stack.enter_context(running_node(folder, *flags, node_id=node_id))
        commands = {
            "hand.toml": Command(("view", str(folder / "hand.toml"), "--port", "0", "--json"), folder),
            "vcan0": Command(("view", *BUS, "--port", "0", "--json"), folder),
        }
        for command in commands.values():
            stack.callback(command.close)
        yield {title: server_of(command) for title, command in commands.items()}
        for command in commands.values():
            assert command.end() == 0
            assert "Traceback" not in command.stderr


def all_live(message: Message) -> bool:
    return [finger["w"] for finger in message["fingers"]] == ["live", "live"]


def check_ages(messages: list[Message]) -> None:
    """What is shown as live is young, by the page's own times: that of the sample, and that of the picture."""
    for message in messages:
        limit_ms = LIVE_MS if message["period"] else FIRST_MS
        for finger in message["fingers"]:
            if finger["w"] == "live":
                assert message["t"] - finger["since"] <= limit_ms, message


def test_the_pages_and_the_force_on_each_finger(pages: dict[str, Any]) -> None:
    for title, server in pages.items():
        check_page(title, server)


def check_page(title: str, server: Any) -> None:
    status, headers, html = get(server, "/")
    assert (status, headers["content-type"].partition(";")[0]) == (200, "text/html")
    assert b"<script" in html
    messages: list[Message] = []
    with Page(server) as page:
        page.send("stream")
        deadline_s = time.monotonic() + WAIT_S
        while len(messages) < SAMPLES:
            assert time.monotonic() < deadline_s, messages[-1:]
            message = page.receive()["answer"]
            messages += [message] if all_live(message) else []
        setup = page.ask("setup")
    check_ages(messages)
    assert [finger["node_id"] for finger in setup["fingers"]] == list(PAGE_LOADS)
    assert setup["title"].startswith(title)
    z = coverage_factor(SAMPLES * len(PAGE_LOADS) * 3)
    for message in messages:
        for finger, (case, load) in zip(message["fingers"], PAGE_LOADS.values(), strict=True):
            error = np.array(finger["c"]) - load
            error[1:] = (error[1:] + 180.0) % 360.0 - 180.0
            _, bound, _ = bounds(case_calibration(case, pull=True), np.array(load), z)
            assert (np.abs(error) <= bound + JSON_STEP).all(), (finger, load, bound)
    assert messages[-1]["nmt"] == ["operational", "operational"]
