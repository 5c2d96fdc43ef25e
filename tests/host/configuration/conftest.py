"""A fingertip on a bus that can be made to fail."""

from collections.abc import Iterator

import pytest

from host.bus_with_nodes import FaultyBus, connected, finger
from tipforce.host.network.bus import Bus
from tipforce.host.network.sdo import SdoChannel

NODE = 5


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bus, FaultyBus]]:
    with connected(finger(NODE, store=tmp_path_factory.mktemp("store") / "node.json")) as both:
        yield both


@pytest.fixture
def sdo(bus: tuple[Bus, FaultyBus]) -> SdoChannel:
    connection, _ = bus
    connection.buffer.clear()
    connection.nmt("reset-node", NODE)
    connection.wait_for({0x700 + NODE})
    return connection.sdo(NODE)
