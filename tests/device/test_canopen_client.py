"""The canopen library as a foreign client, in one thread: what its Network sends, a fingertip node answers at once."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from bench.fuzz import STRAIN_PER_NEWTON

from canopen_device.core.node import Device
from canopen_device.testing import MemoryStore
from fingertip.finger import record
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

EDS = Path(__file__).parents[2] / "eds" / "tipforce-3.eds"
RECORD = record()


class DirectBus:
    """A bus whose only other participant is one device."""

    channel_info = "direct"

    def __init__(self, device: Device, network: canopen.Network) -> None:
        self._device = device
        self._network = network
        self._now_us = 0
        self.pass_time(0)

    def send(self, message: can.Message, _timeout: float | None = None) -> None:
        """From the client to the node."""
        self._now_us += 100
        self._deliver([(message.arbitration_id, bytes(message.data))])

    def pass_time(self, microseconds: int) -> None:
        self._now_us += microseconds
        self._deliver([])

    def _deliver(self, frames: list[tuple[int, bytes]]) -> None:
        sent, _ = self._device.step(self._now_us, frames)
        for can_id, data in sent:
            self._network.notify(can_id, bytearray(data), 1e-6 * self._now_us)

    def shutdown(self) -> None:
        """Part of what canopen asks of a bus."""


class Client:
    def __init__(self, node_id: int = 5, device: Device | None = None) -> None:
        self.network = canopen.Network()
        store, source = MemoryStore(), SimulatedSource(STRAIN_PER_NEWTON)
        self.device = device or fingertip_node(node_id, source, 3, 0x1234, store.save, store.load, EDS.read_bytes())
        self.bus = DirectBus(self.device, self.network)
        self.network.bus = self.bus  # type: ignore[assignment]
        self.node = self.network.add_node(5, str(EDS))
        self.node.sdo.RESPONSE_TIMEOUT = 0.05
        self.network.lss.RESPONSE_TIMEOUT = 0.01  # of a silent slave, as fast_scan waits for each bit that is set


@pytest.fixture
def client() -> Iterator[Client]:
    client = Client()
    yield client
    client.network.disconnect()


def test_a_calibration_is_written_by_block_transfer_committed_and_read_back(client: Client) -> None:
    with client.node.sdo[0x2141].open("wb", size=len(RECORD), block_transfer=True) as file:
        file.write(RECORD)
    client.node.sdo[0x2103][1].raw = zlib.crc32(RECORD)
    client.node.sdo[0x2104].raw = 0x74696D63
    with client.node.sdo[0x2140].open("rb", block_transfer=True) as file:
        assert file.read() == RECORD


@pytest.mark.parametrize("block_size", [1, 5, 127])
def test_the_eds_by_block_upload(client: Client, block_size: int) -> None:
    with client.node.sdo[0x1021].open("rb", block_transfer=True, buffering=block_size * 7) as file:
        assert file.read() == EDS.read_bytes()


def test_the_eds_of_a_node_makes_a_dictionary(client: Client) -> None:
    expected = set(client.node.object_dictionary)
    del client.network[5]
    assert set(client.network.add_node(5, upload_eds=True).object_dictionary) == expected


def test_pdo_read_remap_save(client: Client) -> None:
    client.node.tpdo.read()
    first = client.node.tpdo[1]
    assert (first.enabled, first.cob_id) == (True, 0x185)
    places = [(0x7130, 1), (0x7130, 2), (0x7130, 3), (0x2120, 0), (0x2121, 0)]
    assert [(variable.index, variable.subindex) for variable in first.map] == places
    first.clear()
    first.add_variable(0x2121)
    first.add_variable(0x6130, 7)
    first.trans_type = 2
    first.save()
    client.node.nmt.state = "OPERATIONAL"
    heard: list[int] = []
    first.add_callback(lambda message: heard.append(message.map[0].raw))
    for _ in range(4):
        client.network.sync.transmit()
        client.bus.pass_time(2000)
    assert heard == [2, 4]
    assert [client.device.od.integer(0x1A00, sub) for sub in range(3)] == [2, 0x21210008, 0x61300720]
    assert client.device.od.integer(0x1800, 1) == 0x40000185, "valid again"
    client.node.rpdo.read()
    assert not client.node.rpdo[1].enabled
    client.node.rpdo[1].enabled = True
    client.node.rpdo[1].save()
    client.node.rpdo[1]["Command"].raw = 3
    client.node.rpdo[1].transmit()
    assert client.device.od.get(0x6124, 1) == 0.0


def test_lss_fast_scan_gives_a_node_id() -> None:
    client = Client(255)
    found, identity = client.network.lss.fast_scan()
    assert found
    assert identity == [0, 0x54500103, 0x00020000, 0x1234]
    lss = client.network.lss
    lss.configure_node_id(5)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)
    assert client.device.node_id == 5
    assert client.node.sdo[0x1018][4].raw == 0x1234
    assert lss.fast_scan() == (False, None)
