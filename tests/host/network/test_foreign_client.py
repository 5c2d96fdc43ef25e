"""canopen's own RemoteNode with our EDS, as somebody else would use it, against our node."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest

from host.bus_with_nodes import connected, finger
from tipforce.dictionary.eds import eds_text
from tipforce.host.network.bus import Bus

NODE = 5


@pytest.fixture
def both(tmp_path: Path) -> Iterator[tuple[Bus, Any]]:
    """Our connection and canopen's node on it: one receiver serves both."""
    path = tmp_path / "node.eds"
    path.write_text(eds_text(3, simulated=True), encoding="utf-8")
    with connected(finger(NODE)) as (connection, _):
        node = canopen.RemoteNode(NODE, str(path))
        connection.network.add_node(node)
        yield connection, node


def test_pdo_configuration_is_read_changed_and_saved(both: tuple[Bus, Any]) -> None:
    connection, node = both
    node.tpdo.read()
    tpdo = node.tpdo[1]
    assert tpdo.enabled
    assert tpdo.cob_id == 0x185
    assert [(v.index, v.subindex) for v in tpdo.map] == [
        (0x7130, 1),
        (0x7130, 2),
        (0x7130, 3),
        (0x2120, 0),
        (0x2121, 0),
    ]
    tpdo.clear()
    for index, sub in ((0x2121, 0), (0x7130, 7), (0x2120, 0)):
        tpdo.add_variable(index, sub)
    tpdo.trans_type = 3
    tpdo.save()
    assert node.sdo[0x1A00][0].raw == 3
    assert node.sdo[0x1A00][1].raw == 0x21210008
    assert node.sdo[0x1800][2].raw == 3
    assert node.sdo[0x1800][1].raw == 0x40000185, "valid again"

    came = threading.Event()
    tpdo.add_callback(lambda _: came.set())
    connection.nmt("start", NODE)
    connection.buffer.clear()
    for _ in range(3):
        connection.sync()
    assert came.wait(5.0)
    frame = connection.wait_for({0x185})[-1]
    assert frame["length"] == 4
    assert tpdo[1].raw == struct.unpack_from("<h", frame["data"].tobytes(), 1)[0] == -0x8000


def test_rpdo_is_read_and_enabled(both: tuple[Bus, Any]) -> None:
    connection, node = both
    node.rpdo.read()
    rpdo = node.rpdo[1]
    assert not rpdo.enabled
    assert [(v.index, v.subindex) for v in rpdo.map] == [(0x2130, 0)]
    rpdo.enabled = True
    rpdo.save()
    assert node.sdo[0x1400][1].raw & 0x80000000 == 0
    assert connection.sdo(NODE).upload(0x1400, 1) == struct.pack("<I", node.sdo[0x1400][1].raw)


def test_nmt_by_heartbeat(both: tuple[Bus, Any]) -> None:
    _, node = both
    node.sdo[0x1017].raw = 10
    node.nmt.state = "OPERATIONAL"
    node.nmt.wait_for_heartbeat(5)
    node.nmt.wait_for_heartbeat(5)
    assert node.nmt.state == "OPERATIONAL"
