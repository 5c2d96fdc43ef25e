"""Sending on a raw CAN socket, as far as it goes without one: a full queue, no CAN FD, a bus that is down."""

import errno
import socket
from collections.abc import Callable

import pytest

from tipforce.errors import EnvironmentLackError
from tipforce.host.live import send
from tipforce.host.live.send import NotCarriedError, SocketCanSender

FD = 0x123, 12, bytes(range(12)), 1
Make = Callable[..., SocketCanSender]


@pytest.fixture
def sent() -> list[bytes]:
    return []


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch, sent: list[bytes]) -> Make:
    """A sender whose socket fails with these errors, one a call, and then sends."""

    class Socket:
        errors: tuple[int, ...] = ()

        def __init__(self, *_: int) -> None:
            self.left = list(self.errors)

        def setsockopt(self, *_: object) -> None: ...

        def bind(self, _address: object) -> None: ...

        def close(self) -> None: ...

        def send(self, frame: bytes) -> None:
            if self.left:
                number = self.left.pop(0)
                raise OSError(number, errno.errorcode[number])
            sent.append(frame)

    def made(*errors: int) -> SocketCanSender:
        Socket.errors = errors
        return SocketCanSender("can7")

    monkeypatch.setattr(socket, "socket", Socket)
    monkeypatch.setattr(socket, "AF_CAN", 29, raising=False)
    monkeypatch.setattr(socket, "CAN_RAW", 1, raising=False)
    return made


def test_frames_as_the_kernel_has_them(make: Make, sent: list[bytes]) -> None:
    with make() as sender:
        sender.send(0x40000181, 8, b"")
        sender.send(*FD)
    assert sent[0].hex() == "8101004008" + "00" * 11
    assert len(sent[1]) == 72
    assert sent[1].hex().startswith("230100000c010000000102030405060708090a0b00")


def test_a_full_queue_is_waited_for(make: Make, sent: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    with make(errno.ENOBUFS, errno.ENOBUFS) as sender:
        sender.send(0x123, 0, b"")
    assert len(sent) == 1
    monkeypatch.setattr(send, "_GIVE_UP_S", 0.01)
    with make(*1000 * [errno.ENOBUFS]) as sender, pytest.raises(EnvironmentLackError, match="acknowledge"):
        sender.send(0x123, 0, b"")


def test_a_bus_without_can_fd(make: Make) -> None:
    with make(errno.EINVAL) as sender, pytest.raises(NotCarriedError, match="can7 carries no CAN FD frames"):
        sender.send(*FD)
    with make(errno.ENETDOWN) as sender, pytest.raises(EnvironmentLackError, match="can7: ENETDOWN"):
        sender.send(*FD)
