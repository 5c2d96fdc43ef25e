"""A foreign CANopen client, the `canopen` package with our EDS, talks to a node in another process over vcan0.

tests/device/test_canopen_client.py has its transfers, tests/vcan/test_conformance.py the abort codes.
"""

from __future__ import annotations

from collections.abc import Iterator

import canopen
import pytest

from tipforce_tools.demo.job import case_calibration
from vcan.support import NODE_ID, REPOSITORY, RawBus, running_node

EDS = REPOSITORY / "eds" / "tipforce-3.eds"
COMMIT = 0x74696D63  # "cmit"


@pytest.fixture(scope="module")
def remote(tmp_path_factory: pytest.TempPathFactory) -> Iterator[canopen.RemoteNode]:
    """The node as `tipforce node` starts it from a shell: a fresh interpreter."""
    folder = tmp_path_factory.mktemp("node")
    with running_node(folder, "--store", str(folder / "store.json"), "--uncalibrated", fresh=True):
        network = canopen.Network()
        network.connect(channel="vcan0", interface="socketcan")
        try:
            found = network.add_node(NODE_ID, str(EDS))
            found.sdo.RESPONSE_TIMEOUT = 5.0
            yield found
        finally:
            network.disconnect()


def test_identity_object_says_who_the_node_is(remote: canopen.RemoteNode) -> None:
    identity = remote.sdo[0x1018]
    assert [identity[sub].raw for sub in (1, 2, 4)] == [0, 0x54500103, NODE_ID]
    assert identity[3].raw == remote.object_dictionary.get_variable(0x1018, 3).default  # type: ignore[union-attr]
    assert remote.sdo[0x1000].raw == 0x00020194


def test_producer_heartbeat_time_is_written_and_read_back(remote: canopen.RemoteNode) -> None:
    assert remote.sdo[0x1017].raw == 1000
    remote.sdo[0x1017].raw = 40
    assert remote.sdo[0x1017].raw == 40
    with RawBus() as bus:
        frames = bus.until(lambda frame: frame[0] == 0x700 + NODE_ID)
    assert frames[-1][1] == b"\x7f"
    remote.sdo[0x1017].raw = 1000


def test_matrix_elements_are_staged_and_committed(remote: canopen.RemoteNode) -> None:
    calibration = case_calibration("I", pull=True)
    for sub, element in enumerate(calibration.C.ravel(), 1):
        remote.sdo[0x2100][sub].raw = float(element)
    for sub in (1, 2, 3):
        remote.sdo[0x2101][sub].raw = float(calibration.offset_strain[sub - 1])
    assert remote.sdo[0x2103][3].raw == 0, "staging activates nothing"
    staged_crc = remote.sdo[0x2103][2].raw
    remote.sdo[0x2103][1].raw = staged_crc
    remote.sdo[0x2104].raw = COMMIT
    assert remote.sdo[0x2103][3].raw == staged_crc
    assert remote.sdo[0x2103][4].raw == 1
    assert [remote.sdo[0x2100][k].raw for k in range(1, 10)] == pytest.approx(calibration.C.ravel(), rel=1e-7)
