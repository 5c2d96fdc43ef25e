"""The node as a process: how it ends, an interface that goes away, its priority."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from vcan.adc import in_user_mode_linux
from vcan.support import (
    HEARTBEAT,
    NODE_ID,
    OPERATIONAL_BEAT,
    WAIT_S,
    Command,
    RawBus,
    answers_a_sync,
    running_node,
    start_with_fast_heartbeats,
    wait_until,
)  # fmt: skip

OWN_BUS = "tipforce0"


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
    bus.until(lambda frame: frame == (HEARTBEAT + NODE_ID, b"\x04"))


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True, capture_output=True, timeout=WAIT_S)


@pytest.fixture
def own_bus() -> Iterator[str]:
    """A bus of its own, that the test may take down and away."""
    try:
        ip("add", "dev", OWN_BUS, "type", "vcan")
    except subprocess.CalledProcessError as error:
        if b"not permitted" in error.stderr:
            pytest.skip("taking an interface down needs CAP_NET_ADMIN; `tipforce vcan --uml -- ...` has it")
        raise
    ip("set", OWN_BUS, "up")
    yield OWN_BUS
    subprocess.run(["ip", "link", "del", OWN_BUS], check=False, capture_output=True, timeout=WAIT_S)


def still_operational(channel: str, node: Command) -> None:
    """It sends heartbeats in the state that it was in (so it was not restarted), and answers a SYNC."""
    with RawBus(channel) as bus:
        bus.until(lambda frame: frame == OPERATIONAL_BEAT)
        assert answers_a_sync(bus)
    wait_until(lambda: "up again" in node.stderr, "no word that the interface is up again")
    assert node.end() == 0


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
            start_with_fast_heartbeats(bus)
        ip(*away)
        wait_until(lambda: said in node.stderr, "no word that the interface is gone")
        time.sleep(0.2)  # ten heartbeats that can't be sent
        if back:
            ip(*back)
        ip("set", own_bus, "up")
        still_operational(own_bus, node)
        assert node.stderr.count(said) == 1


def test_priority_and_locked_memory_as_root(tmp_path: Path) -> None:
    if not in_user_mode_linux():
        pytest.skip("needs real-time rights; `tipforce vcan --uml -- ...` has them")
    with running_node(tmp_path, "--priority", "60", "--lock-memory") as node:
        assert os.sched_getscheduler(node.pid) == os.SCHED_FIFO
        assert os.sched_getparam(node.pid).sched_priority == 60
        assert int(Path(f"/proc/{node.pid}/status").read_text().split("VmLck:")[1].split()[0]) > 1000, "kilobytes"
