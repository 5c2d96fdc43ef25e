"""Processes and what is under them: how a node ends; a clock that is set; an interface that goes away, or that has
another bit rate or none."""

import itertools
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from vcan.support import NODE_ID, OPERATIONAL_BEAT, SYNC, Launch, RawBus, ip_link, running_node, wait_until

OWN_BUS = "tipforce0"
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


def receivers(channel: str) -> int:
    """How many sockets listen on a bus, as the kernel lists them (each of ours without a filter)."""
    return sum(line.split()[:1] == [channel] for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_and_ctrl_c_end_the_node_and_free_the_socket(bus: RawBus, tmp_path: Path, number: int) -> None:
    """Its last frame says that it stopped."""
    before = receivers("vcan0")
    with running_node(tmp_path) as node:
        assert receivers("vcan0") == before + 1
        assert node.end(number) == 0
        assert receivers("vcan0") == before
        assert "Traceback" not in node.stderr
        assert node.stdout == ""
    bus.until(lambda frame: frame == (OPERATIONAL_BEAT[0], b"\x04"))


@pytest.fixture
def own_bus() -> Iterator[str]:
    """A bus of its own, that the test may take down and away."""
    try:
        ip_link("add", "dev", OWN_BUS, "type", "vcan")
    except subprocess.CalledProcessError as error:
        if b"not permitted" in error.stderr:
            pytest.skip("taking an interface down needs CAP_NET_ADMIN; `tipforce vcan --uml -- ...` has it")
        raise
    ip_link("set", OWN_BUS, "up")
    yield OWN_BUS
    ip_link("del", OWN_BUS, check=False)


@pytest.mark.parametrize(
    ("away", "back", "said"),
    [
        (["set", OWN_BUS, "down"], [], "Network is down"),
        (["del", OWN_BUS], ["add", "dev", OWN_BUS, "type", "vcan"], "continues when it is up again"),
    ],
    ids=["down", "deleted"],
)
def test_node_outlives_its_interface(own_bus: str, tmp_path: Path, away: list[str], back: list[str], said: str) -> None:
    with running_node(tmp_path, channel=own_bus) as node:
        with RawBus(own_bus) as bus:
            bus.start_node()
        ip_link(*away)
        wait_until(lambda: said in node.stderr, "no word that the interface is gone")
        time.sleep(0.2)  # ten heartbeats that can't be sent
        if back:
            ip_link(*back)
        ip_link("set", own_bus, "up")
        with RawBus(own_bus) as bus:
            bus.until(lambda frame: frame == OPERATIONAL_BEAT)  # in the state that it was in: it was not restarted
            assert bus.answers_a_sync()
        wait_until(lambda: "up again" in node.stderr, "no word that the interface is up again")
        assert node.end() == 0
        assert node.stderr.count(said) == 1


@pytest.mark.usefixtures("own_kernel")
def test_a_clock_that_is_set_moves_nothing(bus: RawBus, tmp_path: Path) -> None:
    with running_node(tmp_path) as node:
        bus.start_node()
        before = time.clock_gettime(time.CLOCK_REALTIME)
        began = time.monotonic()
        bus.waiting()  # those of before do not count
        try:
            for step_s in (86400.0, -2 * 86400.0, 1e9):
                time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + step_s)
                beats = [bus.until(lambda frame: frame == OPERATIONAL_BEAT) for _ in range(10)]
                assert all(len(frames) == 1 for frames in beats), "nothing but heartbeats: no EMCY, no burst"
        finally:
            time.clock_settime(time.CLOCK_REALTIME, before + time.monotonic() - began)
        # Thirty heartbeats of 20 ms: less would be a burst after a step forward. The lower bound alone is no timing.
        assert time.monotonic() - began > 0.5
        assert bus.answers_a_sync()
        assert node.end() == 0


@pytest.mark.usefixtures("own_kernel")
def test_priority_and_locked_memory_as_root(tmp_path: Path) -> None:
    with running_node(tmp_path, "--priority", "60", "--lock-memory") as node:
        assert os.sched_getscheduler(node.pid) == os.SCHED_FIFO
        assert os.sched_getparam(node.pid).sched_priority == 60
        assert int(Path(f"/proc/{node.pid}/status").read_text().split("VmLck:")[1].split()[0]) > 1000, "kilobytes"


@pytest.mark.usefixtures("own_kernel")
@pytest.mark.parametrize(
    "words",
    ["scan --nodes 5", "read 5", "monitor --once 2", "dump --decode -T 3000", "log -o LOG --seconds 2", "doctor"],
)
def test_another_bit_rate_is_named_on_the_only_interface_that_is_up(
    words: str, bus: RawBus, launch: Launch, tmp_path: Path
) -> None:
    """Without a flag; the controller of another bit rate sees errors (linux/can/error.h: protocol, bus error)."""
    ip_link("set", CHANNEL, "down")
    try:
        command = launch(*words.replace("LOG", str(tmp_path / "run.log")).split())
        wait_until(lambda: command.ended, words, lambda: bus.send(ERROR, b"\0\0\x08\0\0\0\0\0"))
    finally:
        ip_link("set", CHANNEL, "up")
    text = command.stderr + command.stdout
    assert "-c vcan0, the only CAN interface that is up" in text
    assert "another bit rate than that of the nodes, or no node acknowledges: " in text
    assert "`sudo ip link set vcan0 down && sudo ip link set vcan0 up type can bitrate 1000000`" in text


@pytest.mark.usefixtures("own_kernel")
def test_a_run_records_after_an_outage(launch: Launch, tmp_path: Path) -> None:
    scene, log = tmp_path / "scene.toml", tmp_path / "run.log"
    with RawBus(CHANNEL, only=SYNC) as bus:
        scene.write_text(SCENE)
        run = launch("run", str(scene), "-i", "socketcan", "-c", CHANNEL, "-o", str(log))
        for _ in range(20):
            bus.receive()
        ip_link("set", CHANNEL, "down")
    wait_until(lambda: "the bus failed" in run.stderr or run.ended, "the run notices")
    ip_link("set", CHANNEL, "up")
    assert run.wait() == 0, run.stderr
    assert "SYNCs were not sent while the bus was down" in run.stderr
    assert run.stderr.count(f"{CHANNEL}: up again") == 1
    times = [float(line[1:18]) for line in log.read_text().splitlines() if " 080#" in line]
    gaps = [after - before for before, after in itertools.pairwise(times)]
    longest = gaps.index(max(gaps))
    pdos = [float(line[1:18]) for line in log.read_text().splitlines() if " 281#" in line]
    assert [t for t in pdos if t < times[longest + 1]]
    assert len([t for t in pdos if t > times[longest + 1]]) > 20, "the nodes are heard after it"


@pytest.mark.usefixtures("own_kernel")
def test_activating_a_bit_timing_leaves_vcan_up(tmp_path: Path) -> None:
    with running_node(tmp_path, channel=CHANNEL) as node, RawBus(CHANNEL) as bus:
        for request in (b"\x04\x01", b"\x13\x00\x04", b"\x15\x00\x00", b"\x04\x00"):  # 125 kbit/s, at once
            bus.send(0x7E5, request.ljust(8, b"\0"))
        wait_until(lambda: "vcan1 has no bit timing" in node.stderr, "the node says so")
        # An interface that was down ends the reception of this socket with ENETDOWN.
        assert (0x7E4, b"\x13" + bytes(7)) in bus.answers(NODE_ID)
