"""A foreign master over vcan0: BaseNode402 of the `canopen` package with the simulated drive."""

import time

import canopen
from canopen.profiles.p402 import BaseNode402

import tipforce
from canopen_device.machine import Drive, shipped_eds
from vcan.support import WAIT_S, wait_until

DRIVE_ID = 6
TARGET_REACHED = 0x400


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
