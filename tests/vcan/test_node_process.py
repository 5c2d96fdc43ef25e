"""The node as a process: how it ends, what it keeps, and what it does when its interface goes away."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tipforce.dictionary import objects as od
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import FingertipClient
from tipforce_tools.demo.job import case_calibration
from vcan.support import HEARTBEAT, NODE_ID, SDO_REQUEST, SYNC, WAIT_S, Command, RawBus, running_node, wait_until

OWN_BUS = "tipforce0"


def receivers(channel: str) -> int:
    """How many sockets listen on a bus, as the kernel lists them (each of ours without a filter)."""
    lines = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(line.split()[:1] == [channel] for line in lines)


def active_crc(connection: Bus) -> int:
    return connection.sdo(NODE_ID).read(od.CALIBRATION_ACTIVE_CRC)


# Its end


@pytest.mark.parametrize(("number", "fresh"), [(signal.SIGTERM, False), (signal.SIGINT, True)])
def test_sigterm_and_ctrl_c_end_the_node_and_free_the_socket(tmp_path: Path, number: int, fresh: bool) -> None:
    before = receivers("vcan0")
    with running_node(tmp_path, fresh=fresh) as node:
        assert receivers("vcan0") == before + 1
        assert node.end(number) == 0
        assert receivers("vcan0") == before
        assert "Traceback" not in node.stderr
        assert node.stdout == ""


# What it keeps


def test_stored_calibration_is_active_again_after_a_kill(host: Bus, tmp_path: Path) -> None:
    store = ("--store", str(tmp_path / "store.json"))
    client = FingertipClient(host.sdo(NODE_ID))
    stored, unstored = case_calibration("I", pull=True), case_calibration("II", pull=True)
    with running_node(tmp_path, *store) as node:
        generation = client.apply_calibration(stored)
        assert client.apply_calibration(unstored, store=False) == generation + 1
        assert node.end(signal.SIGKILL) == -signal.SIGKILL
    with running_node(tmp_path, *store):
        assert active_crc(host) == stored.crc32()
        assert host.sdo(NODE_ID).read(od.CALIBRATION_GENERATION) == generation
        assert client.verify_calibration(stored) == []


# Its interface


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


def start_with_fast_heartbeats(channel: str) -> None:
    """Operational, and 1017h = 20 ms, so that the node soon notices that it can't send."""
    with RawBus(channel) as bus:
        bus.send(SDO_REQUEST + NODE_ID, b"\x2b\x17\x10\0\x14\0\0\0")
        bus.until(lambda frame: frame[0] == 0x580 + NODE_ID)
        bus.send(0x000, bytes((1, NODE_ID)))
        bus.until(lambda frame: frame == (HEARTBEAT + NODE_ID, b"\x05"))


def still_operational(channel: str, node: Command) -> None:
    """It sends heartbeats in the state that it was in (so it was not restarted), and answers a SYNC."""
    with RawBus(channel) as bus:
        bus.until(lambda frame: frame == (HEARTBEAT + NODE_ID, b"\x05"))
        bus.send(SYNC)
        assert {0x180 + NODE_ID, 0x280 + NODE_ID} <= {can_id for can_id, _ in bus.answers()}
    wait_until(lambda: "up again" in node.stderr, "no word that the interface is up again")
    assert node.end() == 0


def test_node_outlives_its_interface_going_down_and_up(own_bus: str, tmp_path: Path) -> None:
    with running_node(tmp_path, channel=own_bus) as node:
        start_with_fast_heartbeats(own_bus)
        ip("set", own_bus, "down")
        wait_until(lambda: "Network is down" in node.stderr, "no word that the interface is down")
        time.sleep(0.2)  # ten heartbeats that can't be sent
        ip("set", own_bus, "up")
        still_operational(own_bus, node)
        assert node.stderr.count("Network is down") == 1


def test_node_outlives_its_interface_going_away_and_coming_back(own_bus: str, tmp_path: Path) -> None:
    with running_node(tmp_path, channel=own_bus) as node:
        start_with_fast_heartbeats(own_bus)
        ip("del", own_bus)
        wait_until(lambda: "continues when it is up again" in node.stderr, "no word that the interface is gone")
        time.sleep(0.2)
        ip("add", "dev", own_bus, "type", "vcan")
        ip("set", own_bus, "up")
        still_operational(own_bus, node)
        assert node.stderr.count("continues when it is up again") == 1
