"""The wait of LssMaster for a response, on a bus with other LSS traffic."""

from __future__ import annotations

import threading

from canopen_device.core import codes
from host.bus_with_nodes import connected, finger
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
