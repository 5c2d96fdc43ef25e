"""`tipforce dump` on buses: python-can's virtual bus, and the SocketCAN reader over sockets that carry can_frames."""

import argparse
import json
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can
import numpy as np
import pytest

from tipforce.errors import EnvironmentLackError
from tipforce_tools.dump import live_source
from tipforce_tools.dump.live_source import LiveSource
from tipforce_tools.dump.targets import Target, parse_target
from tipforce_tools.main import main

CONTACT = bytes.fromhex("2E1129239A110303")
SO_TIMESTAMPNS = 35


@contextmanager
def sending(channel: str, *messages: can.Message) -> Iterator[None]:
    """Sends these, over and over, until the with block ends."""
    stop = threading.Event()

    def send() -> None:
        with can.Bus(channel, interface="virtual") as bus:
            while not stop.wait(0.005):
                for message in messages:
                    bus.send(message)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def message(can_id: int, data: bytes = b"", **options: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=options.pop("is_extended_id", False), **options)


def test_a_bus_of_python_can(capsys: pytest.CaptureFixture[str]) -> None:
    with sending("dump1", message(0x285, CONTACT)):
        assert main(["dump", "-i", "virtual", "-c", "dump1", "-n", "3", "--decode"]) == 0
    assert capsys.readouterr().out.splitlines() == 3 * [
        "  dump1  285   [8]  2E 11 29 23 9A 11 03 03  node 5 (0x05) Contact  "
        "P=4.398 N phi=90.01 deg theta=45.06 deg contact calibrated #3"
    ]


def test_filters_remote_and_fd(capsys: pytest.CaptureFixture[str]) -> None:
    sent = [
        message(0x285, CONTACT),
        can.Message(arbitration_id=0x181, is_remote_frame=True, dlc=4, is_extended_id=False),
        message(0x123, bytes(12), is_fd=True),
        message(0x4, bytes(8), is_error_frame=True),
    ]
    with sending("dump2", *sent):
        assert main(["dump", "-i", "virtual", "-n", "2", "--json", "dump2,285~7FF"]) == 0
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(record["id"], record.get("length"), record.get("error")) for record in found] == 2 * [("181", 4, None)]
    with sending("dump2", *sent):
        assert main(["dump", "-i", "virtual", "-n", "1", "dump2,0~0,#4"]) == 0
    assert capsys.readouterr().out == "  dump2  20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n"


def test_two_buses_align(capsys: pytest.CaptureFixture[str]) -> None:
    with sending("d", message(0x181)), sending("dump3", message(0x182)):
        assert main(["dump", "-i", "virtual", "-n", "40", "d", "dump3"]) == 0
    assert set(capsys.readouterr().out.splitlines()) == {"      d  181   [0] ", "  dump3  182   [0] "}


def test_silence_ends_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dump", "-i", "virtual", "-c", "dump4", "-T", "100"]) == 0
    assert capsys.readouterr().out == ""


def test_a_bus_that_is_not_there() -> None:
    """In a process of its own: where the kernel has CAN, python-can leaves the socket that it could not bind."""
    words = [sys.executable, "-m", "tipforce_tools.main", "dump", "nocan7"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode in {2, 9}
    assert done.stderr.startswith("tipforce: interface socketcan, channel nocan7: ")
    assert "Traceback" not in done.stderr


def test_a_bus_that_fails_later(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(_bus: object, _timeout_s: float) -> None:
        raise can.CanOperationError("the interface went down")

    monkeypatch.setattr("can.interfaces.virtual.VirtualBus.recv", fail)
    assert main(["dump", "-i", "virtual", "-c", "dump5"]) == 2
    assert "the interface went down" in capsys.readouterr().err


class SocketBus:
    """What LiveSource uses of python-can's SocketcanBus."""

    def __init__(self, one: socket.socket) -> None:
        self.socket = one

    def __enter__(self) -> "SocketBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., tuple[LiveSource, list[socket.socket]]]]:
    """A LiveSource over datagram sockets, and where to send its frames."""
    senders: list[socket.socket] = []

    def open_bus(_target: Target, _args: argparse.Namespace, _named: bool) -> SocketBus:
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sender.connect(receiver.getsockname())
        senders.append(sender)
        return SocketBus(receiver)

    monkeypatch.setattr(socket, "AF_CAN", socket.AF_INET, raising=False)
    monkeypatch.setattr(live_source, "_open_bus", open_bus)
    monkeypatch.setattr(live_source, "_configure", lambda _socket, _target: None)
    yield lambda *targets: (LiveSource([parse_target(text) for text in targets], argparse.Namespace()), senders)
    for sender in senders:
        sender.close()


def test_socketcan_frames(source: Callable[..., tuple[LiveSource, list[socket.socket]]]) -> None:
    live, (first, second) = source("vcan0", "can1")
    with live:
        for k in range(3):
            first.send(struct.pack("=IB3x8s", 0x285, 8, CONTACT))
            second.send(struct.pack("=IB3x8s", 0x80000123, 1, bytes([k])))
        first.send(bytes(72))
        blocks = list(live.blocks(timeout_ms=200))
    assert live.fd_frames == 1
    frames = np.concatenate([block.frames for block in blocks])
    interface = np.concatenate([block.interface for block in blocks])
    assert blocks[-1].names == ("vcan0", "can1")
    for block in blocks:
        assert block.frames["t_ns"].tolist() == sorted(block.frames["t_ns"])
    assert (frames["t_ns"] % 1000 != 0).any()  # nanoseconds, as the kernel has them
    assert frames["data"][interface == 0].tobytes() == 3 * CONTACT
    assert frames["data"][interface == 1, 0].tolist() == [0, 1, 2]
    assert frames["length"][interface == 1].tolist() == [1, 1, 1]


def test_a_bus_that_can_not_be_opened_closes_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[SocketBus] = []

    def open_bus(target: Target, _args: argparse.Namespace, _named: bool) -> SocketBus:
        if target.channel == "bad":
            raise EnvironmentLackError("no such interface")
        opened.append(SocketBus(socket.socket()))
        return opened[-1]

    monkeypatch.setattr(live_source, "_open_bus", open_bus)
    with pytest.raises(EnvironmentLackError):
        LiveSource([Target("good"), Target("bad")], argparse.Namespace())
    assert opened[0].socket.fileno() == -1
