"""`tipforce dump` on buses: python-can's virtual bus, and the SocketCAN reader over sockets that carry can_frames."""

import argparse
import errno
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager

import can
import pytest

from tipforce.errors import EnvironmentLackError
from tipforce.host.live import receive, recvmmsg
from tipforce.host.live.receiver import Selection
from tipforce.host.live.targets import Target
from tipforce_tools.cli.listening import open_targets
from tipforce_tools.cli.main import main
from tools.rig import Printed, message, sending

CONTACT = bytes.fromhex("2E1129239A110303")


def repeated(channel: str, *messages: can.Message) -> AbstractContextManager[None]:
    """Sends these, over and over."""
    return sending(channel, lambda _number: messages)


def test_a_bus_of_python_can(capsys: pytest.CaptureFixture[str]) -> None:
    with repeated("dump1", message(0x285, CONTACT)):
        assert main(["dump", "-i", "virtual", "-c", "dump1", "-n", "3", "--decode"]) == 0
    assert capsys.readouterr().out.splitlines() == 3 * [
        "  dump1  285   [8]  2E 11 29 23 9A 11 03 03  node 5 (0x05) Contact  "
        "P=4.398 N phi=90.01 deg theta=45.06 deg contact calibrated #3"
    ]


def test_an_uncalibrated_finger_is_told_once_what_calibrates_it(capsys: pytest.CaptureFixture[str]) -> None:
    with repeated("dump5", message(0x285, bytes.fromhex("0080008000800003"))):
        assert main(["dump", "-i", "virtual", "-c", "dump5", "-n", "3", "--decode", "--json"]) == 0
    assert (
        capsys.readouterr().err
        == "node 5 (0x05): not calibrated: tipforce calibrate guide --node 5, or apply CAL.toml\n"
    )


def test_filters_remote_and_fd(capsys: pytest.CaptureFixture[str]) -> None:
    sent = [
        message(0x285, CONTACT),
        can.Message(arbitration_id=0x181, is_remote_frame=True, dlc=4, is_extended_id=False),
        message(0x123, bytes(12), is_fd=True),
        message(0x4, bytes(8), is_error_frame=True),
    ]
    with repeated("dump2", *sent):
        assert main(["dump", "-i", "virtual", "-n", "2", "--json", "dump2,285~7FF"]) == 0
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    shown = {(record["id"], record.get("length"), record.get("fd"), record.get("error")) for record in found}
    assert shown == {("181", 4, None, None), ("123", None, True, None)}
    with repeated("dump2", *sent):
        assert main(["dump", "-i", "virtual", "-n", "1", "dump2,0~0,#4"]) == 0
    assert capsys.readouterr().out == "  dump2  20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n"


def test_two_buses_align(capsys: pytest.CaptureFixture[str]) -> None:
    with repeated("d", message(0x181)), repeated("dump3", message(0x182)):
        assert main(["dump", "-i", "virtual", "-n", "40", "d", "dump3"]) == 0
    assert set(capsys.readouterr().out.splitlines()) == {"      d  181   [0] ", "  dump3  182   [0] "}


def test_silence_ends_it(printed: Printed) -> None:
    assert printed(0, ["dump", "-i", "virtual", "-c", "dump4", "-T", "100"]).out == ""


def test_a_bus_that_is_not_there() -> None:
    """In a process of its own: where the kernel has CAN, python-can leaves the socket that it could not bind."""
    words = [sys.executable, "-m", "tipforce_tools.cli.main", "dump", "nocan7"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode in {2, 9}
    assert done.stderr.startswith("tipforce: interface socketcan, channel nocan7: ")
    assert "Traceback" not in done.stderr


def test_a_bus_that_fails_later(monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    def fail(_bus: object, _timeout_s: float) -> None:
        raise can.CanOperationError("the interface went down")

    monkeypatch.setattr("can.interfaces.virtual.VirtualBus.recv", fail)
    assert "the interface went down" in printed(2, ["dump", "-i", "virtual", "-c", "dump5"]).err


@pytest.fixture
def buses(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, socket.socket]]:
    """Datagram sockets in place of raw CAN sockets, and by channel where to send their frames."""
    senders: dict[str, socket.socket] = {}
    opened: list[socket.socket] = []

    def open_socket(channel: str, _selection: Selection) -> socket.socket:
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        receiver.bind(("127.0.0.1", 0))
        receive.prepare_socket(receiver)
        senders[channel] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        senders[channel].connect(receiver.getsockname())
        opened.append(senders[channel])
        return receiver

    monkeypatch.setattr(receive, "open_socket", open_socket)
    yield senders
    for sender in opened:
        sender.close()


@pytest.mark.skipif(not recvmmsg.AVAILABLE, reason="this system has no recvmmsg of 64 bits")
def test_socketcan_frames(buses: dict[str, socket.socket], capsys: pytest.CaptureFixture[str]) -> None:
    def send() -> None:
        while len(buses) < 2:
            time.sleep(0.005)
        time.sleep(0.05)
        for k in range(3):
            buses["vcan0"].send(struct.pack("=IB3x8s", 0x285, 8, CONTACT))
            buses["can1"].send(struct.pack("=IB3x8s", 0x80000123, 1, bytes([k])))
        buses["vcan0"].send(struct.pack("=IBB2x64s", 0x285, 12, 3, bytes(64)))

    thread = threading.Thread(target=send)
    thread.start()
    assert main(["dump", "-x", "vcan0", "can1", "-n", "7"]) == 0
    thread.join()
    assert sorted(capsys.readouterr().out.splitlines()) == sorted(
        [
            "  vcan0  RX - -  285   [8]  2E 11 29 23 9A 11 03 03",
            *2 * ["  vcan0  RX - -       285   [8]  2E 11 29 23 9A 11 03 03"],
            *(f"   can1  RX - -  00000123   [1]  0{k}" for k in range(3)),
            "  vcan0  RX B E       285  [12] " + 12 * " 00",
        ]
    )


@pytest.mark.skipif(not recvmmsg.AVAILABLE, reason="this system has no recvmmsg of 64 bits")
def test_an_interface_that_goes_down(
    buses: dict[str, socket.socket], monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    down = [OSError(errno.ENETDOWN, "Network is down")]
    read = recvmmsg.DatagramBatch.read

    def fail_once(batch: recvmmsg.DatagramBatch) -> int:
        if down:
            raise down.pop()
        buses["vcan0"].send(struct.pack("=IB3x8s", 0x123, 0, b""))
        return read(batch)

    monkeypatch.setattr(recvmmsg.DatagramBatch, "read", fail_once)
    out, err = printed(0, ["dump", "-D", "-n", "1", "vcan0"])
    assert out == "  vcan0  123   [0] \n"
    assert "vcan0: interface down" in err
    down.append(OSError(errno.ENETDOWN, "Network is down"))
    assert "vcan0: interface down" in printed(2, ["dump", "-n", "1", "vcan0"]).err


@pytest.mark.skipif(not recvmmsg.AVAILABLE, reason="this system has no recvmmsg of 64 bits")
def test_a_bus_that_can_not_be_opened_closes_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[socket.socket] = []

    def open_socket(channel: str, _selection: Selection) -> socket.socket:
        if channel == "bad":
            raise EnvironmentLackError("no such interface")
        opened.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        return opened[-1]

    monkeypatch.setattr(receive, "open_socket", open_socket)
    with pytest.raises(EnvironmentLackError):
        open_targets([Target("good"), Target("bad")], argparse.Namespace(interface="socketcan"))
    assert opened[0].fileno() == -1
