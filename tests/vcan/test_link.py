"""The interface itself: one that goes down and comes back during a run, and one without bit timing."""

import itertools
import subprocess
from pathlib import Path

import pytest

from vcan.adc import in_user_mode_linux
from vcan.support import NODE_ID, SYNC, Launch, RawBus, running_node, wait_until

CHANNEL = "vcan1"
ERROR = 0x20000088
SCENE = """\
duration_s = 6.0
sync_hz = 50

[[nodes]]
ids = [1]
pdos = ["contact"]

[[loads]]
kind = "static"
P_N = 2.0
phi_deg = -90
theta_deg = 80
"""


@pytest.fixture(autouse=True)
def _own_kernel() -> None:
    if not in_user_mode_linux():
        pytest.skip("sets an interface down: only on a kernel of its own, `tipforce vcan --uml -- ...`")


@pytest.mark.parametrize(
    "words",
    ["scan --nodes 5", "read 5", "monitor --once 2", "dump --decode -T 3000", "log -o LOG --seconds 2", "doctor"],
)
def test_another_bit_rate_is_named_on_the_only_interface_that_is_up(
    words: str, bus: RawBus, launch: Launch, tmp_path: Path
) -> None:
    """Without a flag; the controller of another bit rate sees errors (linux/can/error.h: protocol, bus error)."""
    set_link("down")
    try:
        command = launch(*words.replace("LOG", str(tmp_path / "run.log")).split())
        wait_until(lambda: command.ended, words, lambda: bus.send(ERROR, b"\0\0\x08\0\0\0\0\0"))
    finally:
        set_link("up")
    text = command.stderr + command.stdout
    assert "-c vcan0, the only CAN interface that is up" in text
    assert "another bit rate than that of the nodes, or no node acknowledges: " in text
    assert "`sudo ip link set vcan0 down && sudo ip link set vcan0 up type can bitrate 1000000`" in text


def set_link(state: str) -> None:
    subprocess.run(["ip", "link", "set", CHANNEL, state], check=True, capture_output=True)


def test_a_run_records_after_an_outage(launch: Launch, tmp_path: Path) -> None:
    scene, log = tmp_path / "scene.toml", tmp_path / "run.log"
    with RawBus(CHANNEL, only=SYNC) as bus:
        scene.write_text(SCENE)
        run = launch("run", str(scene), "-i", "socketcan", "-c", CHANNEL, "-o", str(log))
        for _ in range(20):
            bus.receive()
        set_link("down")
    wait_until(lambda: "the bus failed" in run.stderr or run.ended, "the run notices")
    set_link("up")
    assert run.wait() == 0, run.stderr
    assert "SYNCs were not sent while the bus was down" in run.stderr
    assert run.stderr.count(f"{CHANNEL}: up again") == 1
    times = [float(line[1:18]) for line in log.read_text().splitlines() if " 080#" in line]
    gaps = [after - before for before, after in itertools.pairwise(times)]
    longest = gaps.index(max(gaps))
    pdos = [float(line[1:18]) for line in log.read_text().splitlines() if " 281#" in line]
    assert [t for t in pdos if t < times[longest + 1]]
    assert len([t for t in pdos if t > times[longest + 1]]) > 20, "the nodes are heard after it"


def test_activating_a_bit_timing_leaves_vcan_up(tmp_path: Path) -> None:
    with running_node(tmp_path, channel=CHANNEL) as node, RawBus(CHANNEL) as bus:
        for request in (b"\x04\x01", b"\x13\x00\x04", b"\x15\x00\x00", b"\x04\x00"):  # 125 kbit/s, at once
            bus.send(0x7E5, request.ljust(8, b"\0"))
        wait_until(lambda: "vcan1 has no bit timing" in node.stderr, "the node says so")
        # An interface that was down ends the reception of this socket with ENETDOWN.
        assert (0x7E4, b"\x13" + bytes(7)) in bus.answers(NODE_ID)
