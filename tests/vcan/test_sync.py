"""What `cansend` (can-utils) makes a node do: NMT start, and one coherent sample per SYNC."""

from __future__ import annotations

import itertools
import subprocess

import pytest

from vcan.support import HEARTBEAT, NODE_ID, Command, Frame, RawBus

pytestmark = pytest.mark.usefixtures("node")
GAUGES, CONTACT = 0x180 + NODE_ID, 0x280 + NODE_ID


def cansend(frame: str) -> None:
    subprocess.run(["cansend", "vcan0", frame], check=True, timeout=30)


def pdos(frames: list[Frame]) -> list[Frame]:
    """The node's frames without its heartbeats and without what the hosts sent."""
    return [frame for frame in frames if frame[0] not in (HEARTBEAT + NODE_ID, 0x000, 0x080, 0x600 + NODE_ID)]


def sync_by_cansend(bus: RawBus) -> list[Frame]:
    cansend("080#")
    bus.until(lambda frame: frame[0] == 0x080)
    return pdos(bus.answers())


def test_no_pdo_before_nmt_start(bus: RawBus, node: Command) -> None:
    cansend("000#8205")
    bus.until(lambda frame: frame == (HEARTBEAT + NODE_ID, b"\0"))
    assert sync_by_cansend(bus) == [], node.stderr


def test_ten_syncs_give_ten_pairs_with_successive_counters(bus: RawBus) -> None:
    cansend("000#0105")
    pairs = [sync_by_cansend(bus) for _ in range(10)]
    assert all([can_id for can_id, _ in pair] == [GAUGES, CONTACT] for pair in pairs)
    assert all(len(gauges) == len(contact) == 8 for (_, gauges), (_, contact) in pairs)
    assert all(gauges[6:] == contact[6:] for (_, gauges), (_, contact) in pairs), "status and counter of one sample"
    counters = [pair[0][1][7] for pair in pairs]
    assert all((later - earlier) & 0xFF == 1 for earlier, later in itertools.pairwise(counters)), counters


def test_stopped_node_is_silent_and_heartbeats_say_so(bus: RawBus) -> None:
    cansend("000#0205")
    cansend("080#")
    frames = bus.until(lambda frame: frame == (HEARTBEAT + NODE_ID, b"\x04"))
    assert pdos(frames) == []
