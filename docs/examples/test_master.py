"""A test of a CANopen master without hardware: canopen's BaseNode402 against a simulated drive, and one that fails."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

import tipforce
from canopen_device.machine import Drive, SimulatedDevice, shipped_eds

BUS = {"interface": "virtual", "channel": "machine"}  # or {"interface": "socketcan", "channel": "vcan0"}


@pytest.fixture
def network() -> Iterator[canopen.Network]:
    """The bus of the master."""
    network = canopen.Network()
    network.connect(**BUS)
    yield network
    network.disconnect()


def enabled(network: canopen.Network) -> BaseNode402:
    """The master's part: start the node, enable the drive."""
    node = BaseNode402(5, str(shipped_eds("cia402")))
    network.add_node(node)
    node.sdo["Producer heartbeat time"].raw = 50
    node.nmt.wait_for_heartbeat(2)
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    node.op_mode = "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    return node


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait at most five seconds."""
    end_s = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < end_s


def test_the_drive_moves(network: canopen.Network) -> None:
    with tipforce.simulated_device("cia402", 5, network) as drive:
        node = enabled(network)
        node.sdo["Target position"].raw = 500
        node.controlword = 0x1F
        wait_for(lambda: drive["Position actual value"] == 500)


def test_the_master_sees_a_fault(network: canopen.Network) -> None:
    axis = Drive()
    with tipforce.simulated_device("cia402", 5, network, application=axis):
        node = enabled(network)
        axis.fail(0x2310)
        wait_for(lambda: node.state == "FAULT")
        assert [error.code for error in node.emcy.active] == [0x2310]


def test_the_master_survives_a_silent_node(network: canopen.Network) -> None:
    with tipforce.simulated_device("cia402", 5, network) as drive:
        assert isinstance(drive, SimulatedDevice)
        node = enabled(network)
        drive.fault("silent")
        with pytest.raises(canopen.SdoCommunicationError):
            node.sdo["Device type"].raw  # noqa: B018
        drive.clear_fault("silent")
        assert node.sdo["Device type"].raw == 0x00020192
