"""Bus: NMT, waiting for frames, the buffer of what came; opening a bus that is not there; responses to LSS; finding
nodes: our own, a stopped one, foreign devices, and one that dies meanwhile."""

import itertools
import math
import struct
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from unittest.mock import MagicMock, Mock

import can
import pytest

from canopen_device.core import codes
from canopen_device.core.node import Device
from canopen_device.core.object_dictionary import ObjectDictionary
from canopen_device.running.open_bus import PythonCanPort
from host.bus_with_nodes import FaultyBus, beam_calibration, connected, finger, new_channel, running
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.errors import EnvironmentLackError, InputError, NoResponseError
from tipforce.host.frames.frame_array import FrameBuffer
from tipforce.host.network.bus import Bus, Dispatcher, Heartbeats
from tipforce.host.network.find import FoundNode, find_nodes
from tipforce.host.network.finger import Identity
from tipforce.host.network.interfaces import open_bus
from tipforce.host.network.lss import LssMaster
from tools.rig import until


def test_what_is_not_allowed_is_named() -> None:
    with connected() as (connection, _):
        with pytest.raises(InputError, match=r"NMT command 'halt': allowed are start, stop, preop, reset-node"):
            connection.nmt("halt", 5)
        for node_id in (0, 128, -1):
            with pytest.raises(InputError, match=rf"node-id {node_id}: allowed are 1 to 127"):
                connection.sdo(node_id)
        assert connection.sdo(3) is connection.sdo(3)


def test_a_link_that_ends_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """socketcand: a write to a closed socket is no error of python-can, the text of a failed read has a traceback."""
    with connected() as (connection, bus):
        with monkeypatch.context() as ended:
            ended.setattr(bus, "send", Mock(side_effect=BrokenPipeError(32, "Broken pipe")))
            with pytest.raises(EnvironmentLackError, match=r"0x000: the bus refused it: .* Broken pipe$"):
                connection.nmt("start", 1)
            PythonCanPort(bus).send([(0x080, b"")])
        with monkeypatch.context() as ended:
            ended.setattr(bus, "recv", Mock(side_effect=can.CanOperationError("reset by peer  Traceback (most recent")))
            until(lambda: connection.notifier.exception)
            with pytest.raises(EnvironmentLackError, match=r"reset by peer$"):
                find_nodes(connection, [1], 0.0)


def test_a_node_opens_a_link_that_ended_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once it has failed for a second, and until it opens; the old one is closed before, also where that fails."""
    now_s = 10.0
    clock = SimpleNamespace(monotonic=lambda: now_s, sleep=lambda _seconds: None)
    monkeypatch.setattr("canopen_device.running.open_bus.time", clock)
    failed = can.CanOperationError("Could not read from serial device")
    ended = Mock(recv=Mock(side_effect=failed), shutdown=Mock(side_effect=failed))
    frame = can.Message(arbitration_id=0x80, is_extended_id=False)
    reopen = Mock(side_effect=[EnvironmentLackError("refused"), new := Mock(recv=Mock(return_value=frame))])
    port = PythonCanPort(ended, reopen)
    assert port.receive(0.0) is None
    assert not reopen.called
    for calls in (1, 2):
        now_s += 1.0
        assert port.receive(0.0) is None
        port.send([(0x181, b"")])
        assert reopen.call_count == calls
    assert ended.shutdown.call_count == 1
    assert new.send.call_count == 1
    assert port.receive(0.0) == (0x80, b"")


def test_a_sync_for_one_reading_is_no_producer(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (connection, _):
        connection.dispatcher.notify(0x80, bytearray(), 0.0)
        assert connection.sync_due_s(0.01) == math.inf
        monkeypatch.setattr("tipforce.host.network.bus._SYNC_SILENT_S", 0.0)
        assert connection.sync_due_s(0.01) == -math.inf


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
        assert connection.wait_for({0x20, 0x30}, 10.0)["can_id"].tolist() == [0x10, 0x20, 0x10, 0x30]
        rest = connection.wait_for({0x40}, 10.0)
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
        found = connection.wait_for({0x7FE}, 10.0)
    assert found["can_id"].tolist() == [0x8000_0701, 0x4000_0702, 0x7FE]


def test_subscribers_get_data_frames_of_their_identifier_alone() -> None:
    dispatcher, received = Dispatcher(can.Bus(interface="virtual", channel=new_channel())), list[bytes]()
    dispatcher.subscribe(0x585, lambda _can_id, data, _t_s: received.append(bytes(data)))
    for flags in ({"is_extended_id": True}, {"is_remote_frame": True}, {"is_error_frame": True}, {"is_fd": True}, {}):
        dispatcher.on_message_received(can.Message(arbitration_id=0x585, **{"is_extended_id": False, **flags}))
    assert received == [b""]
    assert dispatcher.bus is not None
    dispatcher.bus.shutdown()


def test_what_comes_when_a_wait_has_just_ended_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that waits runs late: the time is over, and the frame is there."""
    buffer = FrameBuffer()

    def late(_timeout_s: float) -> bool:
        buffer._frames.append((0, 0x20, b""))
        return False

    monkeypatch.setattr(buffer._arrived, "wait", late)
    assert buffer.take({0x20}, time.monotonic() + 60.0)["can_id"].tolist() == [0x20]


def test_a_state_that_another_follows_before_the_look_was_reached() -> None:
    """Of two nodes that boot, the second one beats again while the first one is waited for."""
    heartbeats, since_s = Heartbeats(), time.monotonic()
    for data in (b"\0", b"\x7f"):
        heartbeats.on_message_received(can.Message(arbitration_id=0x705, data=data, is_extended_id=False))
    assert heartbeats.wait(5, codes.INITIALISING, since_s, 0.0)
    assert heartbeats.state(5) == codes.PRE_OPERATIONAL
    assert not heartbeats.wait(5, codes.INITIALISING, time.monotonic() + 1.0, 0.0)


def test_a_bus_that_is_closed_while_another_thread_sends_has_its_own_error() -> None:
    bus = Mock(send=Mock(side_effect=can.CanOperationError("closed")))
    dispatcher = Dispatcher(bus)
    dispatcher._lock = MagicMock(__enter__=lambda _lock: setattr(dispatcher, "bus", None))
    with pytest.raises(can.CanOperationError, match="closed"):
        dispatcher.send_message(0x80, b"")


def test_a_full_buffer_drops_the_oldest_and_counts_them() -> None:
    buffer = FrameBuffer(limit=10)
    for k in range(25):
        buffer(can.Message(arbitration_id=k, timestamp=k, is_extended_id=False))
    buffer(can.Message(is_fd=True, data=bytes(12)))  # passed over
    kept = buffer.take_all()["can_id"].tolist()
    assert kept == list(range(25 - len(kept), 25))
    assert len(kept) <= 10
    assert buffer.dropped == 25 - len(kept)


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
                connection.dispatcher.notify(codes.LSS_RESPONSE_COB_ID, bytearray(OTHER), 0.0)

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            assert not lss.any_unconfigured()
            assert not lss.select(Identity(1, 2, 3, 4))
        finally:
            stopped.set()
            thread.join()


def test_a_response_among_other_frames_is_found() -> None:
    with connected(finger(5)) as (connection, _), LssMaster(connection) as lss:
        serial = connection.sdo(5)["identity.serial"]
        found = [connection.sdo(5)[f"identity.{part}"] for part in ("vendor", "product", "revision")]
        connection.dispatcher.notify(codes.LSS_RESPONSE_COB_ID, bytearray(OTHER), 0.0)
        assert lss.select(Identity(*(int(part) for part in (*found, serial))))
        assert lss.node_id() == 5


@pytest.mark.parametrize("lost", [3, 70, 110, 118])  # 118: the last of all
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


# --- find_nodes ------------------------------------------------------------------------------------------------

WAIT_S = 0.2


def foreign(node_id: int, identity: dict[int, tuple[str, int]]) -> Device:
    """Somebody else's device: the mandatory objects of CiA 301 and nothing of ours."""
    entries = ObjectDictionary(node_id)
    for index, kind, access, value in (
        (0x1000, "I", "ro", 0x00010191), (0x1001, "B", "ro", 0), (0x1017, "H", "rw", 20), (0x1F80, "I", "rw", 4),
        (0x1005, "I", "rw", 0x80), (0x1019, "B", "rw", 0),
    ):  # fmt: skip
        entries.add(index, 0, (kind, access, 0, value, None, None))
    for sub, (kind, value) in identity.items():
        entries.add(0x1018, sub, (kind, "ro", 0, value, None, None))
    return Device(entries)


COMPLETE = {0: ("B", 4), 1: ("I", 0x1F5), 2: ("I", 0xCAFE), 3: ("I", 1), 4: ("I", 99)}
MINIMAL = {0: ("B", 1), 1: ("I", 0x1F5)}
NARROW = {0: ("B", 4), 1: ("H", 0x1F5), 2: ("H", 1), 3: ("H", 1), 4: ("H", 1)}


@pytest.fixture(scope="module")
def bus() -> Iterator[tuple[Bus, FaultyBus]]:
    """Nodes 5 (calibrated), 6 (not), 7 (stopped); 20 to 23 are foreign."""
    devices = [finger(5), finger(6), finger(7)]
    others = [foreign(20, COMPLETE), foreign(21, MINIMAL), foreign(22, NARROW), foreign(23, {})]
    with connected(*devices, *others, timeout_s=0.3, retries=1) as (connection, faulty):
        for node_id in (5, 6, 7):
            connection.sdo(node_id).write(od.HEARTBEAT_PRODUCER_MS, 20)
        connection.finger(5).apply_calibration(beam_calibration(), store=False)
        connection.nmt("start", 6)
        connection.nmt("stop", 7)
        yield connection, faulty


@pytest.fixture
def connection(bus: tuple[Bus, FaultyBus]) -> Iterator[Bus]:
    yield bus[0]
    bus[1].fault = lambda message: message


def test_who_is_there_and_how(connection: Bus) -> None:
    found = {node.node_id: node for node in find_nodes(connection, range(1, 128), WAIT_S)}
    assert list(found) == [5, 6, 7, 20, 21, 22, 23]
    crc = beam_calibration().crc32()
    assert found[5] == FoundNode(
        5, "pre-operational", "simulated fingertip, 3 gauges", 1005, f"0x{crc:08X} generation 1", "match",
        product=0x54500103,
    )  # fmt: skip
    assert found[6] == FoundNode(
        6, "operational", "simulated fingertip, 3 gauges", 1006, "not calibrated", "match", product=0x54500103
    )
    assert found[7] == FoundNode(7, "stopped", "no SDO in this state", 0, "unknown", "unknown")
    assert found[20] == FoundNode(
        20, "pre-operational", "product 0x0000CAFE", 99, "not a fingertip", "no: another device", product=0xCAFE
    )
    assert (found[21].device, found[21].calibration) == ("of vendor 0x000001F5", "not a fingertip")
    assert found[22].device == "unknown object format"
    assert found[23].device == "no identity object"


def test_only_the_node_ids_asked_for(connection: Bus) -> None:
    assert [node.node_id for node in find_nodes(connection, [6, 20, 50], WAIT_S)] == [6, 20]
    assert find_nodes(connection, [50], 0.01) == []
    assert [node.state for node in find_nodes(connection, [6], 1e6)] == ["operational"]  # every answer is in


def test_no_heartbeat_is_said(connection: Bus, bus: tuple[Bus, FaultyBus]) -> None:
    bus[1].fault = lambda m: None if m.arbitration_id >= 0x700 else m
    (node,) = find_nodes(connection, [6, 7], WAIT_S)
    assert (node.node_id, node.state) == (6, "no heartbeat")


def test_a_node_that_goes_silent_does_not_hide_the_others(connection: Bus, bus: tuple[Bus, FaultyBus]) -> None:
    answers = iter(range(1000))

    def dies(message: can.Message) -> can.Message | None:
        return message if message.arbitration_id != 0x585 or next(answers) == 0 else None

    bus[1].fault = dies
    found = find_nodes(connection, [5, 6], WAIT_S)
    assert [(node.node_id, node.device) for node in found] == [
        (5, "stopped responding"),
        (6, "simulated fingertip, 3 gauges"),
    ]


def test_another_revision_is_named(connection: Bus, bus: tuple[Bus, FaultyBus]) -> None:
    older = table.REVISION + 0x10000

    def other_revision(message: can.Message) -> can.Message:
        if message.arbitration_id == 0x585 and bytes(message.data[:4]) == b"\x43\x18\x10\x03":
            message.data[4:] = struct.pack("<I", older)
        return message

    bus[1].fault = other_revision
    (node,) = find_nodes(connection, [5], WAIT_S)
    assert node.eds == f"no: revision 0x{older:08X}, expected 0x{table.REVISION:08X}"
