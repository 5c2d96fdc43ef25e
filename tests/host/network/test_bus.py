"""Bus: NMT, waiting for frames, the buffer of what came; and opening a bus that is not there."""

from __future__ import annotations

import threading
import time

import can
import numpy as np
import pytest

from host.bus_with_nodes import connected, finger, new_channel
from tipforce.errors import EnvironmentLackError, InputError, NoResponseError
from tipforce.host.frames.frame_array import FrameBuffer, frame_array
from tipforce.host.network.bus import Bus
from tipforce.host.network.open_bus import open_bus

HEARTBEAT = 0x705


def test_nmt_commands_change_the_state() -> None:
    with connected(finger(5)) as (connection, _):
        sdo = connection.sdo(5)
        sdo.download(0x1017, 0, (10).to_bytes(2, "little"))
        for command, state in (("start", 5), ("stop", 4), ("preop", 127)):
            connection.nmt(command, 5)
            connection.buffer.clear()
            connection.wait_for({HEARTBEAT})
            assert connection.wait_for({HEARTBEAT})[-1]["data"][0] == state
        for command in ("reset-comm", "reset-node"):
            connection.nmt(command)
            frames = connection.wait_for({HEARTBEAT})
            while frames[-1]["data"][0]:  # heartbeats that were on their way
                frames = connection.wait_for({HEARTBEAT})


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


def test_take_ends_at_the_deadline_with_what_there_is() -> None:
    buffer = FrameBuffer()
    for message in frames(3):
        buffer.on_message_received(message)
    assert buffer.take({0x7FF}, time.monotonic()).shape == (3,)


def test_take_wakes_for_the_last_identifier_and_leaves_what_follows() -> None:
    buffer = FrameBuffer()

    def arrive() -> None:
        for message in frames(6):
            buffer.on_message_received(message)

    thread = threading.Thread(target=arrive)
    thread.start()
    taken = buffer.take({4, 1}, time.monotonic() + 10)
    thread.join()
    assert taken["can_id"].tolist() == [0, 1, 2, 3, 4]
    assert buffer.take_all()["can_id"].tolist() == [5]


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
