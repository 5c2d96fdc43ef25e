"""A foreign CANopen client, the `canopen` package with our EDS, talks to a node in another process over vcan0."""

from __future__ import annotations

from collections.abc import Iterator

import canopen
import pytest

from tipforce.dictionary.eds import eds_text
from tipforce_tools.demo.job import case_calibration
from vcan.support import NODE_ID, REPOSITORY, RawBus, running_node

EDS = REPOSITORY / "eds" / "tipforce-3.eds"
COMMIT = 0x74696D63  # "cmit"


@pytest.fixture(scope="module")
def remote(tmp_path_factory: pytest.TempPathFactory) -> Iterator[canopen.RemoteNode]:
    """The node as `tipforce node` starts it from a shell: a fresh interpreter."""
    folder = tmp_path_factory.mktemp("node")
    with running_node(folder, "--store", str(folder / "store.json"), fresh=True):
        network = canopen.Network()
        network.connect(channel="vcan0", interface="socketcan")
        try:
            found = network.add_node(NODE_ID, str(EDS))
            found.sdo.RESPONSE_TIMEOUT = 5.0
            yield found
        finally:
            network.disconnect()


def default(remote: canopen.RemoteNode, index: int, sub: int = 0) -> object:
    """What the EDS says that the object holds."""
    found = remote.object_dictionary.get_variable(index, sub)
    assert found is not None
    return found.default


def test_identity_object_says_who_the_node_is(remote: canopen.RemoteNode) -> None:
    identity = remote.sdo[0x1018]
    assert [identity[sub].raw for sub in (1, 2, 4)] == [0, 0x54500103, NODE_ID]
    assert identity[3].raw == default(remote, 0x1018, 3)
    assert remote.sdo[0x1000].raw == 0x00020194


def test_producer_heartbeat_time_is_written_and_read_back(remote: canopen.RemoteNode) -> None:
    assert remote.sdo[0x1017].raw == 1000
    remote.sdo[0x1017].raw = 40
    assert remote.sdo[0x1017].raw == 40
    with RawBus() as bus:
        frames = bus.until(lambda frame: frame[0] == 0x700 + NODE_ID)
    assert frames[-1][1] == b"\x7f"
    remote.sdo[0x1017].raw = 1000


def test_strings_come_by_segmented_upload(remote: canopen.RemoteNode) -> None:
    for index in (0x1008, 0x100A):
        assert remote.sdo[index].raw == default(remote, index)
    assert remote.sdo[0x1009].raw == "simulated", "hardware version: the EDS is that of real hardware"


def test_eds_object_is_the_nodes_own_eds(remote: canopen.RemoteNode) -> None:
    size = len(eds_text(3, True).encode())
    with remote.sdo[0x1021].open("rb", block_transfer=False, buffering=700) as stream:
        assert stream.read(700).decode() == eds_text(3, True)[:700]
        # The rest is thousands of segments more: that it is there, and that the node takes the abort, is enough.
        assert stream.raw.size == size
    remote.sdo.abort(0x08000000)
    assert remote.sdo[0x1017].raw == 1000


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


def test_upload_of_a_write_only_object_is_refused(remote: canopen.RemoteNode) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        remote.sdo.upload(0x2104, 0)
    assert refused.value.code == 0x06010001
