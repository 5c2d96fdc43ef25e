"""The wait of LssMaster for a response, on a bus with other LSS traffic."""

from __future__ import annotations

import itertools
import threading

import can
import pytest

from canopen_device.core import codes
from host.bus_with_nodes import connected, finger, new_channel, running
from tipforce.host.network.lss import LssAddress, LssMaster

OTHER = bytes((codes.LSS_IDENTIFIED,)) + bytes(7)


def test_other_traffic_neither_extends_the_wait_nor_is_kept() -> None:
    """With a wait that each frame restarts, this test would not end."""
    with connected() as (connection, _), LssMaster(connection, timeout_s=0.05) as lss:
        stopped = threading.Event()

        def flood() -> None:
            while not stopped.wait(0.001):
                connection.network.notify(codes.LSS_RESPONSE_COB_ID, bytearray(OTHER), 0.0)

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            assert not lss.any_unconfigured()
            assert not lss.select(LssAddress(1, 2, 3, 4))
        finally:
            stopped.set()
            thread.join()


def test_a_response_among_other_frames_is_found() -> None:
    with connected(finger(5)) as (connection, _), LssMaster(connection) as lss:
        serial = connection.sdo(5)["identity.serial"]
        found = [connection.sdo(5)[f"identity.{part}"] for part in ("vendor", "product", "revision")]
        connection.network.notify(codes.LSS_RESPONSE_COB_ID, bytearray(OTHER), 0.0)
        assert lss.select(LssAddress(*(int(part) for part in (*found, serial))))
        assert lss.node_id() == 5


@pytest.mark.parametrize("lost", [3, 70, 110])
def test_a_response_that_is_late_is_no_bit_of_the_address(lost: int) -> None:
    """The wait for a response ends before it: silence, which stands for a bit of 1."""
    responses = itertools.count()

    def late(message: can.Message) -> can.Message | None:
        is_late = message.arbitration_id == codes.LSS_RESPONSE_COB_ID and next(responses) == lost
        return None if is_late else message

    channel = new_channel()
    with (
        connected(channel=channel) as (connection, bus),
        running([finger(255, serial=0x00F00001)], channel),
        LssMaster(connection, 0.05) as lss,
    ):
        bus.fault = late
        address = lss.fastscan()
        assert address is not None
        assert address.serial == 0x00F00001
        assert next(responses) > lost
        assert lss.node_id() == 255
