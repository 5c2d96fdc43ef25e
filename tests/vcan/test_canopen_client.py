"""Foreign masters over vcan0: the `canopen` package with our EDS, and its BaseNode402 with the simulated drive."""

import time
from collections.abc import Iterator

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

import tipforce
from canopen_device.machine import Drive, shipped_eds
from tipforce_tools.demo.job import case_calibration
from vcan.support import NODE_ID, REPOSITORY, WAIT_S, RawBus, running_node, wait_until

EDS = REPOSITORY / "eds" / "tipforce-3.eds"
COMMIT = 0x74696D63  # "cmit"
DRIVE_ID = 6
TARGET_REACHED = 0x400


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


def until(node: BaseNode402, state: str) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while node.state != state:
        assert time.monotonic() < deadline_s, node.state
        node.check_statusword(WAIT_S)


def test_enable_move_fault_and_reset() -> None:
    network = canopen.Network()
    network.connect(channel="vcan0", interface="socketcan")
    drive = Drive()
    try:
        with tipforce.simulated_device("cia402", DRIVE_ID, "vcan0", application=drive) as device:
            node = BaseNode402(DRIVE_ID, str(shipped_eds("cia402")))
            node.TIMEOUT_SWITCH_STATE_FINAL = node.TIMEOUT_SWITCH_STATE_SINGLE = node.TIMEOUT_CHECK_TPDO = WAIT_S
            node.sdo.RESPONSE_TIMEOUT = node.TIMEOUT_SWITCH_OP_MODE = WAIT_S
            network.add_node(node)
            node.sdo[0x1017].raw = 50
            node.nmt.wait_for_heartbeat(WAIT_S)
            node.setup_402_state_machine()
            node.nmt.state = "OPERATIONAL"
            node.op_mode = "PROFILED POSITION"
            node.state = "OPERATION ENABLED"
            node.sdo[0x607A].raw = 1000
            node.controlword = 0x1F
            wait_until(lambda: node.sdo[0x6041].raw & TARGET_REACHED != 0, "the move should end")
            assert node.sdo[0x6064].raw == 1000
            drive.fail(0x2310)
            until(node, "FAULT")
            # The EMCY follows the PDO that shows the state.
            wait_until(lambda: [error.code for error in node.emcy.active] == [0x2310], "EMCY 2310h should come")
            node.controlword = 0x00
            node.controlword = 0x80
            until(node, "SWITCH ON DISABLED")
            node.state = "OPERATION ENABLED"
            assert device[0x6064] == 1000
    finally:
        network.disconnect()
