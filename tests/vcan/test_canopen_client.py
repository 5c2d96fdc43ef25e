"""A foreign CANopen client, the `canopen` package with our EDS, talks to a node in another process over vcan0."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Iterator
from pathlib import Path

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
    with running_node(folder, "--store", str(folder / "store.json"), "--uncalibrated", fresh=True):
        network = canopen.Network()
        network.connect(channel="vcan0", interface="socketcan")
        try:
            found = network.add_node(NODE_ID, str(EDS))
            found.sdo.RESPONSE_TIMEOUT = 5.0
            yield found
        finally:
            network.disconnect()


@contextlib.contextmanager
def finalizers_of_refused_streams() -> Iterator[None]:
    """What is collected in here may be canopen's stream of a refused segmented download, and nothing else may raise.

    Such a stream closes itself with one segment more, which the node refuses too. From Python 3.13 on (before, with
    `-X dev`) what a finalizer raises is reported, and pytest makes a failure of it.
    """
    reported: list[tuple[str, type[BaseException]]] = []
    before = sys.unraisablehook
    sys.unraisablehook = lambda found: reported.append((type(found.object).__name__, found.exc_type))
    try:
        yield
    finally:
        sys.unraisablehook = before
    assert set(reported) <= {("WritableStream", canopen.SdoAbortedError)}


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


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x1000, 0, bytes(4), 0x06010002),
        (0x1018, 4, bytes(4), 0x06010002),
        (0x1008, 0, b"a longer name", 0x06010002),
        (0x2140, 0, bytes(158), 0x06010002),
        (0x5000, 0, bytes(4), 0x06020000),
        (0x1018, 9, bytes(4), 0x06090011),
        (0x1017, 0, bytes(4), 0x06070012),
        (0x1017, 0, bytes(1), 0x06070013),
        (0x2104, 0, bytes(4), 0x08000020),
    ],
)
def test_refused_download_names_its_abort_code(
    remote: canopen.RemoteNode, index: int, sub: int, data: bytes, code: int
) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        remote.sdo.download(index, sub, data)
    found = refused.value.code
    # The failed stream of canopen sends one segment more when it is collected. If that were in canopen's own receiving
    # thread, while it holds the lock of the queue of responses, the two would wait for each other for ever.
    with finalizers_of_refused_streams():
        del refused
        gc.collect()
    assert found == code


def test_upload_of_a_write_only_object_is_refused(remote: canopen.RemoteNode) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        remote.sdo.upload(0x2104, 0)
    assert refused.value.code == 0x06010001


def test_the_committed_eds_is_the_generated_one() -> None:
    assert Path(EDS).read_text() == eds_text(3)
