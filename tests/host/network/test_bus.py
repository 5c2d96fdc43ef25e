"""Bus: NMT, waiting for frames, the buffer of what came; opening a bus that is not there; responses to LSS."""

from __future__ import annotations

import itertools
import threading

import can
import numpy as np
import pytest

from canopen_device.core import codes
from host.bus_with_nodes import connected, finger, new_channel, running
from tipforce.errors import EnvironmentLackError, InputError, NoResponseError
from tipforce.host.frames.frame_array import FrameBuffer, frame_array
from tipforce.host.network.bus import Bus
from tipforce.host.network.lss import LssAddress, LssMaster
from tipforce.host.network.open_bus import open_bus


def test_what_is_not_allowed_is_named() -> None:
    with connected() as (connection, _):
        with pytest.raises(InputError, match=r"NMT command 'halt': allowed are start, stop, preop, reset-node"):
            connection.nmt("halt", 5)
        for node_id in (0, 128, -1):
            with pytest.raises(InputError, match=rf"node-id {node_id}: allowed are 1 to 127"):
                connection.sdo(node_id)
        assert connection.sdo(3) is connection.sdo(3)


def test_wait_for_names_what_did_not_come() -> None:
    with connected(finger(5)) as (connection, _), pytest.raises(NoResponseError) as caught:
        connection.wait_for({0x7FE, 0x123, 0x705}, timeout_s=0.05)
    assert "0x123" in str(caught.value)
    assert "0x7FE" in str(caught.value)
    assert "within 0.05 s" in str(caught.value)


def test_wait_for_takes_up_to_the_last_awaited_and_leaves_the_rest() -> None:
    channel = new_channel()
    with connected(channel=channel) as (connection, _), can.Bus(interface="virtual", channel=channel) as other:
        for can_id in (0x10, 0x20, 0x10, 0x30, 0x40):
            other.send(can.Message(arbitration_id=can_id, data=[can_id], is_extended_id=False))
        assert connection.wait_for({0x20, 0x30})["can_id"].tolist() == [0x10, 0x20, 0x10, 0x30]
        rest = connection.wait_for({0x40})
        assert rest["can_id"].tolist() == [0x40]
        assert rest["length"].tolist() == [1]
        assert rest["data"].tolist() == [[0x40] + [0] * 7]
        assert len(connection.buffer.take_all()) == 0


def test_the_flags_of_a_frame_are_kept() -> None:
    channel = new_channel()
    with connected(channel=channel) as (connection, _), can.Bus(interface="virtual", channel=channel) as other:
        other.send(can.Message(arbitration_id=0x701, data=b"\x05", is_extended_id=True))
        other.send(can.Message(arbitration_id=0x702, is_remote_frame=True, dlc=1, is_extended_id=False))
        other.send(can.Message(arbitration_id=0x7FE, is_extended_id=False))
        found = connection.wait_for({0x7FE})
    assert found["can_id"].tolist() == [0x8000_0701, 0x4000_0702, 0x7FE]


def frames(count: int) -> list[can.Message]:
    return [can.Message(arbitration_id=k, timestamp=k, is_extended_id=False) for k in range(count)]


def test_a_full_buffer_drops_the_oldest_and_counts_them() -> None:
    buffer = FrameBuffer(limit=10)
    for message in frames(25):
        buffer.on_message_received(message)
    kept = buffer.take_all()["can_id"].tolist()
    assert kept == list(range(25 - len(kept), 25))
    assert len(kept) <= 10
    assert buffer.dropped == 25 - len(kept)


def test_a_buffer_passes_over_can_fd() -> None:
    buffer = FrameBuffer()
    buffer.on_message_received(can.Message(is_fd=True, data=bytes(12)))
    assert not len(buffer.take_all())


def test_frame_array_of_nothing_and_of_short_data() -> None:
    assert frame_array([]).shape == (0,)
    (row,) = frame_array([(7, 0x181, b"\1\2")])
    assert (row["t_ns"], row["can_id"], row["length"]) == (7, 0x181, 2)
    np.testing.assert_array_equal(row["data"], [1, 2, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    "options",
    [
        {"interface": "socketcan", "channel": "no-such-bus0"},
        {"interface": "no-such-interface", "channel": "x"},
        {"interface": "slcan", "channel": "no-such-file"},
    ],
)
def test_a_bus_that_cannot_be_opened_says_what_to_do(options: dict[str, str]) -> None:
    with pytest.raises(EnvironmentLackError) as caught:
        open_bus(bitrate=None, **options)
    for part in (options["interface"], options["channel"], "check -i and -c", "tipforce vcan -- "):
        assert part in str(caught.value)


def test_open_gives_a_connection() -> None:
    with Bus.open(new_channel(), "virtual", timeout_s=0.25, retries=0) as connection:
        assert connection.sdo(1).timeout_s == 0.25
        assert connection.sdo(1).retries == 0


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
