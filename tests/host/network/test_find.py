"""find_nodes on a bus with our nodes, a stopped one, foreign devices, and one that dies meanwhile."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import can
import pytest

from canopen_device.core.node import Device
from canopen_device.core.object_dictionary import ObjectDictionary
from host.bus_with_nodes import FaultyBus, beam_calibration, connected, finger
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.errors import EnvironmentLackError
from tipforce.host.network.bus import Bus
from tipforce.host.network.find import FoundNode, find_nodes
from tipforce.host.network.finger import FingertipClient

WAIT_S = 0.2


def foreign(node_id: int, identity: dict[int, tuple[str, int]]) -> Device:
    """Somebody else's device: the mandatory objects of CiA 301 and nothing of ours."""
    entries = ObjectDictionary(node_id)
    entries.add(0x1000, 0, ("I", "ro", 0, 0x00010191, None, None))
    entries.add(0x1001, 0, ("B", "ro", 0, 0, None, None))
    entries.add(0x1017, 0, ("H", "rw", 0, 20, None, None))
    entries.add(0x1F80, 0, ("I", "rw", 0, 4, None, None))
    entries.add(0x1005, 0, ("I", "rw", 0, 0x80, None, None))
    entries.add(0x1019, 0, ("B", "rw", 0, 0, None, None))
    for sub, (kind, value) in identity.items():
        entries.add(0x1018, sub, (kind, "ro", 0, value, None, None))
    return Device(entries)


COMPLETE = {0: ("B", 4), 1: ("I", 0x1F5), 2: ("I", 0xCAFE), 3: ("I", 1), 4: ("I", 99)}
MINIMAL = {0: ("B", 1), 1: ("I", 0x1F5)}
NARROW = {0: ("B", 4), 1: ("H", 0x1F5), 2: ("H", 1), 3: ("H", 1), 4: ("H", 1)}


@pytest.fixture(scope="module")
def bus() -> Iterator[tuple[Bus, FaultyBus]]:
    """Nodes 5 (calibrated), 6 (not), 7 (stopped); 20 to 22 are foreign."""
    devices = [finger(5), finger(6), finger(7)]
    others = [foreign(20, COMPLETE), foreign(21, MINIMAL), foreign(22, NARROW)]
    with connected(*devices, *others, timeout_s=0.3, retries=1) as (connection, faulty):
        for node_id in (5, 6, 7):
            connection.sdo(node_id).write(od.HEARTBEAT_PRODUCER_MS, 20)
        FingertipClient(connection.sdo(5)).apply_calibration(beam_calibration(), store=False)
        connection.nmt("start", 6)
        connection.nmt("stop", 7)
        yield connection, faulty


@pytest.fixture
def connection(bus: tuple[Bus, FaultyBus]) -> Iterator[Bus]:
    yield bus[0]
    bus[1].fault = lambda message: message


def test_who_is_there_and_how(connection: Bus) -> None:
    found = {node.node_id: node for node in find_nodes(connection, range(1, 128), WAIT_S)}
    assert list(found) == [5, 6, 7, 20, 21, 22]
    crc = beam_calibration().crc32()
    assert found[5] == FoundNode(
        5, "pre-operational", "simulated fingertip, 3 gauges", 1005, f"0x{crc:08X} generation 1", "match",
        product=0x54500103,
    )  # fmt: skip
    assert found[6] == FoundNode(
        6, "operational", "simulated fingertip, 3 gauges", 1006, "not calibrated", "match", product=0x54500103
    )
    assert found[7] == FoundNode(7, "stopped", "no SDO in this state", 0, "unknown", "unknown")
    assert found[20] == FoundNode(
        20, "pre-operational", "product 0x0000CAFE", 99, "not a fingertip", "no: another device", product=0xCAFE
    )
    assert found[21].device == "no identity object"
    assert found[22].device == "unknown object format"


def test_only_the_node_ids_asked_for(connection: Bus) -> None:
    assert [node.node_id for node in find_nodes(connection, [6, 20, 50], WAIT_S)] == [6, 20]
    assert find_nodes(connection, [50], 0.01) == []
    assert [node.state for node in find_nodes(connection, [6], 1e6)] == ["operational"]  # every answer is in


def test_no_heartbeat_is_said(connection: Bus, bus: tuple[Bus, FaultyBus]) -> None:
    bus[1].fault = lambda m: None if m.arbitration_id >= 0x700 else m
    (node,) = find_nodes(connection, [6, 7], WAIT_S)
    assert (node.node_id, node.state) == (6, "no heartbeat")


def test_a_node_that_goes_silent_does_not_hide_the_others(connection: Bus, bus: tuple[Bus, FaultyBus]) -> None:
    answers = iter(range(1000))

    def dies(message: can.Message) -> can.Message | None:
        return message if message.arbitration_id != 0x585 or next(answers) == 0 else None

    bus[1].fault = dies
    found = find_nodes(connection, [5, 6], WAIT_S)
    assert [(node.node_id, node.device) for node in found] == [
        (5, "stopped responding"),
        (6, "simulated fingertip, 3 gauges"),
    ]


def test_another_revision_is_named(connection: Bus, bus: tuple[Bus, FaultyBus]) -> None:
    older = table.REVISION + 0x10000

    def other_revision(message: can.Message) -> can.Message:
        if message.arbitration_id == 0x585 and bytes(message.data[:4]) == b"\x43\x18\x10\x03":
            message.data[4:] = struct.pack("<I", older)
        return message

    bus[1].fault = other_revision
    (node,) = find_nodes(connection, [5], WAIT_S)
    assert node.eds == f"no: revision 0x{older:08X}, expected 0x{table.REVISION:08X}"


def test_a_dead_bus_is_an_error(connection: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise can.CanOperationError("network is down")

    monkeypatch.setattr(connection.network, "send_message", refuse)
    with pytest.raises(EnvironmentLackError, match="network is down"):
        find_nodes(connection, [5], WAIT_S)
