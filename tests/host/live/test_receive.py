"""The receive path: SocketReceiver over connected datagram sockets that carry can_frames, python-can's virtual bus."""

import errno
import socket
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can
import numpy as np
import pytest

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.core import core
from tipforce.errors import EnvironmentLackError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import SENT
from tipforce.host.live import receive
from tipforce.host.live.python_can import message_block
from tipforce.host.live.receive import SocketReceiver, open_receiver, prepare_socket
from tipforce.host.live.receiver import SWITCH_INTERVAL_S, Filter, InterfaceDownError, ReceiverGroup, Selection

CONTACT = bytes.fromhex("2E1129239A110303")


def can_frame(can_id: int, data: bytes, length: int | None = None) -> bytes:
    """struct can_frame; what lies behind ``length`` is not zero, as a careless sender leaves it."""
    return struct.pack("=IB3x8s", can_id, len(data) if length is None else length, data)


@pytest.fixture(autouse=True, params=["core", "Python"])
def _body(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "Python":
        monkeypatch.setattr(receive, "core", None)
    elif core is None:
        pytest.skip("needs the compiled core")


@contextmanager
def connected(channel: str = "vcan0", capacity: int = 256) -> Iterator[tuple[SocketReceiver, socket.socket]]:
    if not receive.AVAILABLE:
        pytest.skip("needs the sockets of Linux")
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.bind(("127.0.0.1", 0))
    prepare_socket(one)
    with (
        SocketReceiver(one, channel, capacity=capacity) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bus,
    ):
        bus.connect(one.getsockname())
        yield receiver, bus


def test_frames_come_as_they_were_sent_with_the_kernels_time() -> None:
    before = time.time_ns()
    with connected() as (receiver, bus):
        for can_id, data in ((0x285, CONTACT), (0x123 | EXTENDED_FLAG, b"\x01"), (0x181 | REMOTE_FLAG, b"")):
            bus.send(can_frame(can_id, data))
        bus.send(can_frame(0x182, bytes([1, 2, 0xFF, 0xFF]), 2))
        bus.send(can_frame(ERROR_FLAG | 4, bytes(8)))
        frames = receiver.receive(5.0)
        while len(frames) < 5:
            frames = np.concatenate([frames, receiver.receive(5.0)])
    assert frames["can_id"].tolist() == [0x285, 0x123 | EXTENDED_FLAG, 0x181 | REMOTE_FLAG, 0x182, ERROR_FLAG | 4]
    assert frames["length"].tolist() == [8, 1, 0, 2, 8]
    assert frames["data"][0].tobytes() == CONTACT
    assert frames["data"][3].tolist() == [1, 2, 0, 0, 0, 0, 0, 0], "nothing behind the data"
    assert (frames["channel"] == 0).all()
    assert (frames["flags"] == 0).all()
    assert before <= frames["t_ns"][0]
    assert (np.diff(frames["t_ns"]) >= 0).all()
    assert frames["t_ns"][-1] <= time.time_ns()
    assert (frames["t_ns"] % 1000 != 0).any(), "nanoseconds, as the kernel has them"
    assert Decoder().decode(frames)[5, "Contact"].columns["P"].tolist() == [4.398]


def test_nothing_comes_within_the_time() -> None:
    with connected() as (receiver, _):
        assert len(receiver.receive(0)) == 0
        start = time.monotonic()
        assert len(receiver.receive(0.05)) == 0
        assert time.monotonic() - start >= 0.045


def test_batches_are_used_again_and_lose_nothing() -> None:
    """More than fits into one batch, and many rounds through the same memory."""
    with connected(capacity=16) as (receiver, bus):
        for _round in range(5):
            for number in range(100):
                bus.send(can_frame(number, struct.pack("<q", number)))
            found: list[int] = []
            while len(found) < 100:
                frames = receiver.receive(5.0)
                assert 0 < len(frames) <= 16
                found += frames["data"].copy().view("<i8")[:, 0].tolist()
            assert found == list(range(100))
        assert receiver.dropped == 0


def test_can_fd_frames_stand_beside_the_classic_ones() -> None:
    with connected() as (receiver, bus):
        long = bytes(range(64))
        bus.send(can_frame(0x181, b"\x01"))
        bus.send(struct.pack("=IBB2x64s", 0x285, 64, 1, long))
        bus.send(struct.pack("=IBB2x64s", 0x12345678 | EXTENDED_FLAG, 12, 2, long))
        bus.send(can_frame(0x182, b"\x02"))
        bus.send(bytes(5))  # no frame at all
        time.sleep(0.01)
        block = receiver.receive_block(5.0)
    assert block.frames["can_id"].tolist() == [0x181, 0x182]
    assert [(one.row, one.can_id, one.flags, one.data) for one in block.fd] == [
        (1, 0x285, 1, long),
        (1, 0x12345678 | EXTENDED_FLAG, 2, long[:12]),
    ]
    assert block.positions().tolist() == [0, 3]
    assert block.frames["t_ns"][0] <= block.fd[0].t_ns <= block.fd[1].t_ns <= block.frames["t_ns"][1]
    assert len(Decoder().decode(block.frames)) == 0


def test_frames_of_all_interfaces_have_the_name_of_theirs() -> None:
    with connected("any") as (receiver, bus):
        bus.send(can_frame(0x181, b""))
        bus.send(struct.pack("=IBB2x64s", 0x285, 12, 0, bytes(64)))
        time.sleep(0.01)
        block = receiver.receive_block(5.0)
    assert len(block.names) == 1
    assert (block.frames["channel"].tolist(), [frame.interface for frame in block.fd]) == ([0], [0])


def test_what_the_kernel_dropped_is_counted() -> None:
    with connected() as (receiver, bus):
        receiver._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        for number in range(2000):  # more than the socket's buffer holds
            bus.send(can_frame(1, struct.pack("<q", number)))
        found: list[int] = []
        while len(frames := receiver.receive(0.05)):
            found += frames["data"].copy().view("<i8")[:, 0].tolist()
        bus.send(can_frame(2, bytes(8)))  # the counter travels with a frame
        assert len(receiver.receive(5.0)) == 1
        assert len(found) + receiver.dropped == 2000
    assert found == sorted(found)
    assert receiver.dropped > 0


def test_several_receivers_come_in_the_order_of_time() -> None:
    with connected() as (first, bus), connected("can1") as (second, other), ReceiverGroup([first, second]) as group:
        for number in range(20):
            bus.send(can_frame(0x100 + number, b""))
            other.send(can_frame(0x200 + number, b""))
        other.send(struct.pack("=IBB2x64s", 0x7FF, 12, 0, bytes(64)))
        time.sleep(0.01)
        block = group.receive_block(5.0)
        assert len(block) == 41
        assert block.frames["can_id"].tolist() == [base + k for k in range(20) for base in (0x100, 0x200)]
        assert [block.names[k] for k in block.frames["channel"]] == ["vcan0", "can1"] * 20
        assert [(one.row, block.names[one.interface]) for one in block.fd] == [(40, "can1")]
        assert len(group.receive_block(0.01)) == 0
        assert group.dropped == 0


def test_a_bus_that_fails_costs_no_frame_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (first, bus), connected("can1") as (second, other), ReceiverGroup([first, second]) as group:

        def read() -> int:
            raise OSError(errno.ENETDOWN, "Network is down")

        bus.send(can_frame(0x181, b""))
        other.send(can_frame(0x182, b""))
        time.sleep(0.01)
        with monkeypatch.context() as patch:
            patch.setattr(first, "_read", read)
            assert group.receive(5.0)["can_id"].tolist() == [0x182]
            with pytest.raises(InterfaceDownError, match="vcan0: interface down"):
                group.receive(5.0)
        assert group.receive(5.0)["can_id"].tolist() == [0x181]  # it may come back


def test_python_can_behind_the_same_call() -> None:
    selection = Selection((Filter(0x181, 0x7FF, inverse=True),))
    with (
        open_receiver({"interface": "virtual", "channel": "receive1"}, selection) as receiver,
        can.Bus("receive1", interface="virtual") as bus,
    ):
        bus.send(can.Message(arbitration_id=0x181, is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x285, data=CONTACT, is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x182, is_remote_frame=True, dlc=4, is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x123, data=bytes(12), is_fd=True, bitrate_switch=True))
        bus.send(can.Message(arbitration_id=4, is_error_frame=True))
        block = receiver.receive_block(5.0)
        assert block.frames["can_id"].tolist() == [0x285, 0x182 | REMOTE_FLAG]
        assert block.frames["length"].tolist() == [8, 4]
        assert block.frames["data"][0].tobytes() == CONTACT
        assert [(one.row, one.can_id, one.flags) for one in block.fd] == [(2, 0x123 | EXTENDED_FLAG, 1)]
        assert block.names == ("receive1",)
        assert len(receiver.receive(0.01)) == 0
        assert receiver.fileno() == -1


def test_a_message_of_more_than_8_bytes_is_can_fd() -> None:
    """The readers of .csv and .db do not say so."""
    block = message_block([can.Message(arbitration_id=0x285, data=bytes(12), is_extended_id=False, check=False)], {})
    assert (len(block.frames), [(one.can_id, one.data) for one in block.fd]) == (0, [(0x285, bytes(12))])


def test_python_can_of_several_buses(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_timeout_s: float) -> object:
        raise EnvironmentLackError("unplugged")

    names = ("receive2", "receive3")
    receivers = [open_receiver({"interface": "virtual", "channel": name}) for name in names]
    with (
        ReceiverGroup(receivers) as group,
        can.Bus(names[0], interface="virtual") as bus,
        can.Bus(names[1], interface="virtual") as other,
    ):
        for number in range(100):
            bus.send(can.Message(arbitration_id=number, is_extended_id=False))
            other.send(can.Message(arbitration_id=number, is_extended_id=False))
        found: dict[str, list[int]] = {name: [] for name in names}
        while sum(map(len, found.values())) < 200:
            block = group.receive_block(5.0)
            assert len(block)
            for number, can_id in block.frames[["channel", "can_id"]].tolist():
                found[block.names[number]].append(can_id)
        assert found == {name: list(range(100)) for name in names}
        assert len(group.receive_block(0.01)) == len(group.receive_block(0)) == 0
        with monkeypatch.context() as patch:
            patch.setattr(receivers[0], "receive_block", fails)
            other.send(can.Message(arbitration_id=7, is_extended_id=False))
            assert group.receive(5.0)["can_id"].tolist() == [7]
            with pytest.raises(EnvironmentLackError, match="unplugged"):
                group.receive(5.0)
        bus.send(can.Message(arbitration_id=8, is_extended_id=False))
        assert group.receive(5.0)["can_id"].tolist() == [8]


def test_own_frames_are_marked() -> None:
    own, other = (can.Message(arbitration_id=1, is_rx=is_rx) for is_rx in (False, True))
    assert message_block([own, other], {}).frames["flags"].tolist() == [SENT, 0]


def test_filters_as_the_kernel_has_them() -> None:
    can_id = np.array([0x181, 0x181 | EXTENDED_FLAG, 0x182, ERROR_FLAG | 4], dtype=np.uint32)
    assert Selection().passes(can_id).tolist() == [True, True, True, False]
    assert Selection(error_mask=4).passes(can_id).tolist() == [True, True, True, True]
    assert Selection((Filter(0x181, 0x7FF),)).passes(can_id).tolist() == [True, True, False, False]
    assert Selection((Filter(0x181, 0x7FF | EXTENDED_FLAG),)).passes(can_id).tolist() == [True, False, False, False]
    both = (Filter(0x181, 0x7FF, inverse=True), Filter(0x182, 0x7FF, inverse=True))
    assert Selection(both).passes(can_id).tolist() == [True, True, True, False]
    assert Selection(both, join=True).passes(can_id).tolist() == [False, False, False, False]
    assert Filter(0x181, 0x7FF, inverse=True).kernel_words() == (0x20000181, 0x7FF)


def test_the_switch_interval_is_short_while_a_receiver_is_open() -> None:
    before = sys.getswitchinterval()
    with connected():
        with connected() as (second, _):
            assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL_S)
            second.close()
            second.close()
        assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL_S)
    assert sys.getswitchinterval() == before
    with connected():
        sys.setswitchinterval(0.002)  # the program's own wish stays
    assert sys.getswitchinterval() == pytest.approx(0.002)
    sys.setswitchinterval(before)
