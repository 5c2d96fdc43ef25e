"""`tipforce dump` on text and on buses: what it prints, what it leaves out, and how it ends."""

import argparse
import errno
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from tipforce.errors import EnvironmentLackError
from tipforce.host.live import receive
from tipforce.host.live.receiver import Selection
from tipforce_tools.cli.listening import open_targets
from tools.rig import TIPFORCE, Printed, Streams, message, process, sending

GOOD = """\
(1700000000.000000) vcan0 285#2E1129239A110303
(1700000000.000500) vcan0 285#0080008000800204
(1700000000.001000) vcan1 185#0A0014001E000206
(1700000000.250000) vcan0 080#
(1700000000.250001) vcan0 181#R8
(1700000001.000000) vcan0 20000004#0004000000000000
(1700000001.000001) vcan0 12345678#AB
"""
DUMP = [*TIPFORCE, "dump"]
FD = """\
(1700000000.000000) vcan0 285##52E1129239A110303
(1700000000.000100) vcan0 285#2E1129239A110303
(1700000000.000200) vcan1 12345678##0000102030405060708090A0B
(1700000000.000300) vcan0 123##1
"""
CONTACT = bytes.fromhex("2E1129239A110303")
DECODED = (
    "285   [8]  2E 11 29 23 9A 11 03 03  node 5 (0x05) Contact  "
    "P=4.398 N phi=90.01 deg theta=45.06 deg contact calibrated #3\n"
)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run.log"
    path.write_text(GOOD)
    return path


Piped = Callable[..., Streams]


@pytest.fixture
def piped(printed: Printed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Piped:
    """`tipforce dump WORDS -` of a text on stdin, in this process; pipes proper are at the end of this file."""

    def run(text: str, words: str, code: int = 0) -> Streams:
        path = tmp_path / "stdin"
        path.write_text(text)
        with path.open() as stdin:
            monkeypatch.setattr(sys, "stdin", stdin)
            return printed(code, f"dump {words} -")

    return run


SHOWN = {
    "": (
        "  vcan0  285   [8]  2E 11 29 23 9A 11 03 03\n"
        "  vcan0  285   [8]  00 80 00 80 00 80 02 04\n"
        "  vcan1  185   [8]  0A 00 14 00 1E 00 02 06\n"
        "  vcan0  080   [0] \n"
        "  vcan0  181   [8]  remote request\n"
        "  vcan0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n"
        "  vcan0  12345678   [1]  AB\n"
    ),
    "-L": GOOD,
    "-e any,0~0,#FFFFFFFF": (
        "  vcan0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n\tcontroller-problem{rx-error-warning}\n"
    ),
    "--decode -n 4": (
        f"  vcan0  {DECODED}"
        "  vcan0  285   [8]  00 80 00 80 00 80 02 04  node 5 (0x05) Contact  "
        "P=unknown phi=unknown theta=unknown calibrated #4\n"
        "  vcan1  185   [8]  0A 00 14 00 1E 00 02 06  node 5 (0x05) Gauges  "
        "SG1=1.0 microstrain SG2=2.0 microstrain SG3=3.0 microstrain calibrated #6\n"
        "  vcan0  080   [0]                           SYNC\n"
    ),
    "-ta -n 1": " (1700000000.000000)  vcan0  285   [8]  2E 11 29 23 9A 11 03 03\n",
    "-tz vcan1": " (000.000000)  vcan1  185   [8]  0A 00 14 00 1E 00 02 06\n",
    "-td -n 2 any,080:7FF,181:7FF": (
        " (000.000000)  vcan0  080   [0] \n (000.000001)  vcan0  181   [8]  remote request\n"
    ),
    "-a -n 2": (
        "  vcan0  285   [8]  2E 11 29 23 9A 11 03 03   '..)#....'\n"
        "  vcan0  285   [8]  00 80 00 80 00 80 02 04   '........'\n"
    ),
}


@pytest.mark.parametrize("words", SHOWN)
def test_text(words: str, log: Path, printed: Printed) -> None:
    assert printed(0, ["dump", *words.split(), str(log)]) == (SHOWN[words], "")


def test_json(log: Path, printed: Printed) -> None:
    found = printed(0, f"dump --json --decode {log}").records
    assert found[0] == {
        "t": 1700000000.0, "interface": "vcan0", "id": "285", "data": "2E1129239A110303", "node": 5,
        "message": "Contact", "values": {"P": 4.398, "phi": 90.01, "theta": 45.06}, "status": ["contact", "calibrated"],
        "counter": 3,
    }  # fmt: skip
    assert found[1]["values"] == {"P": None, "phi": None, "theta": None}
    assert found[3] == {
        "t": 1700000000.25, "interface": "vcan0", "id": "080", "data": "", "service": "SYNC", "text": "SYNC",
    }  # fmt: skip
    assert (found[4]["remote"], found[4]["length"], found[5]["error"]) == (True, 8, True)
    assert found[6]["id"] == "12345678"


def test_no_time_and_health_and_more_gauges(piped: Piped) -> None:
    done = piped("  vcan0  285   [8]  2E 11 29 23 9A 11 03 03\n", "--json")
    assert done.records == [{"t": None, "interface": "vcan0", "id": "285", "data": "2E1129239A110303"}]
    health = "(1700000000.000000) vcan0 485#FFFFFFFF01080701\n"
    assert piped(health, "--decode --gauges 8 -L").out == health[:-1] + (
        "  node 5 (0x05) Health  temperature=-0.01 degC u_P=unknown configuration_counter=7 error_register=1 "
        "SG1_fault fault_supply\n"
    )


@pytest.mark.parametrize(
    ("targets", "shown"),
    [
        ("vcan0", 6), ("vcan1", 1), ("any", 7), ("vcan0,285:7FF", 2), ("vcan0,285:7FF vcan1", 3), ("any,285~7FF", 4),
        ("any,285:7FF,080:7FF", 3), ("any,285~7FF,080~7FF,j", 3), ("any,0~0,#4", 1), ("any,0~0,#3", 0),
        ("any,12345678:DFFFFFFF", 1), ("any,181:C00007FF", 0), ("can7", 0),
    ],
)  # fmt: skip
def test_filters(targets: str, shown: int, log: Path, printed: Printed) -> None:
    assert len(printed(0, ["dump", *targets.split(), str(log)]).out.splitlines()) == shown


def test_can_fd_frames_are_shown_counted_and_filtered_but_not_decoded(piped: Piped) -> None:
    lines = FD.splitlines(keepends=True)
    for words, shown in (("", 4), ("-n 3", 3), ("vcan0,285:7FF", 2)):
        assert piped(FD, f"-L {words}").out == "".join(lines[:shown])
    assert piped(FD, "-x --decode").out == (
        "  vcan0  RX B -  285  [08]  2E 11 29 23 9A 11 03 03\n"
        f"  vcan0  RX - -  {DECODED}"
        "  vcan1  RX - -  12345678  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B\n"
        "  vcan0  RX B -       123  [00] \n"
    )
    screen = piped(FD, "-ta -x").out
    assert piped(screen, "-ta -x").out == screen
    found = piped(FD, "--json --decode").records
    assert [record.get("fd", False) for record in found] == [True, False, True, True]
    assert found[0]["bit_rate_switch"]
    assert "values" in found[1]


def test_what_was_left_out_is_told_at_the_end(piped: Piped) -> None:
    text = GOOD + "rubbish\nmore\n(1700000000.000000) vcan0 123##50001\n(1700000000.0) vcan0 123#00\n"
    out, err = piped(text + "(1700000002.000000) vcan0 285#00\n", "--decode")
    assert len(out.splitlines()) == 9
    assert "  vcan0       123  [02]  00 01\n" in out
    lines = err.splitlines()
    assert lines[0].startswith(
        "tipforce dump: 3 bad lines left out (2 not a candump line, 1 timestamp), first line 8: 'rubbish': "
    )
    assert lines[1:] == ["tipforce dump: node 5 (0x05) Contact: 1 frame shorter than the mapping, not decoded"]
    assert piped(text, "-q").err == ""


def test_verbose_counts_messages_and_lost_samples_by_the_numbers_of_the_syncs(piped: Piped) -> None:
    text = "".join(f"(1700000000.{k:06d}) vcan0 285#00000000000002{k:02X}\n" for k in (0, 1, 1, 5))
    assert piped(text, "-v").err.splitlines()[-1].endswith("node 5 (0x05) Contact: 4 frames, 3 samples lost")
    sent = [("080", "")] + [("080", f"{k:02X}") for k in (239, 240, 1, 2, 4)]
    frames = [(f"{can_id}#{data}", f"285#00000000000002{data or 'F0'}") for can_id, data in sent]
    text = "".join(f"(1700000000.{k:06d}) vcan0 {one}\n" for k, one in enumerate(sum(frames, ())))
    assert piped(text, "-v").err.splitlines()[-1].endswith("node 5 (0x05) Contact: 6 frames, 1 sample lost")


def test_strict_stops_at_the_first_bad_line(piped: Piped) -> None:
    good = GOOD.splitlines(keepends=True)
    out, err = piped(good[0] + "rubbish\n" + good[1], "--strict -L", code=1)
    assert out == good[0]
    assert err.startswith("tipforce dump: line 2: 'rubbish': not a candump line: expected ")
    assert piped(GOOD.rstrip("\n"), "--strict -L").out == GOOD, "the last line may lack its end"


def test_a_live_pipe_is_shown_at_once() -> None:
    with subprocess.Popen([*DUMP, "--decode", "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for count in range(3):
            line = f"(1700000000.000000) vcan0 285#2E1129239A1103{count:02X}\n".encode()
            os.write(process.stdin.fileno(), line[:20])
            os.write(process.stdin.fileno(), line[20:])
            assert process.stdout.readline().endswith(f"#{count}\n".encode())  # stdin is still open
        process.stdin.close()
        assert process.wait(timeout=60) == 0


def test_silence_ends_it() -> None:
    with subprocess.Popen([*DUMP, "-T", "200", "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        start = time.monotonic()
        os.write(process.stdin.fileno(), GOOD.encode())
        assert process.wait(timeout=60) == 0
        assert time.monotonic() - start >= 0.2


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("-n 3 --decode BUS,285:7FF", {f"  BUS  {DECODED}"}),
        ("-n 2 BUS,285~7FF", {"  BUS  181   [4]  remote request\n", "  BUS  123  [12] " + 12 * " 00" + "\n"}),
        ("-n 1 BUS,0~0,#4", {"  BUS  20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n"}),
    ],
)
def test_a_bus_of_python_can(words: str, shown: set[str], printed: Printed, channel: str) -> None:
    sent = [
        message(0x285, CONTACT),
        can.Message(arbitration_id=0x181, is_remote_frame=True, dlc=4, is_extended_id=False),
        message(0x123, bytes(12), is_fd=True),
        message(0x4, bytes(8), is_error_frame=True),
    ]
    with sending(channel, lambda _number: sent):
        out = printed(0, f"dump -i virtual {words.replace('BUS', channel)}").out
    lines = out.replace(channel, "BUS").splitlines(keepends=True)
    assert (len(lines), set(lines)) == (int(words[3]), shown)


def test_a_bus_that_is_not_there() -> None:
    """In a process of its own: where the kernel has CAN, python-can leaves the socket that it could not bind."""
    done = process("dump nocan7")
    assert done.returncode in {2, 9}
    assert re.match(r"tipforce: interface socketcan, channel nocan7: .*ip -br link", done.stderr)
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


@pytest.mark.skipif(not receive.AVAILABLE, reason="needs the sockets of Linux")
def test_socketcan_frames(buses: dict[str, socket.socket], printed: Printed) -> None:
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
    out = printed(0, "dump -x vcan0 can1 -n 7").out
    thread.join()
    assert sorted(out.splitlines()) == sorted(
        [
            "  vcan0  RX - -  285   [8]  2E 11 29 23 9A 11 03 03",
            *2 * ["  vcan0  RX - -       285   [8]  2E 11 29 23 9A 11 03 03"],
            *(f"   can1  RX - -  00000123   [1]  0{k}" for k in range(3)),
            "  vcan0  RX B E       285  [12] " + 12 * " 00",
        ]
    )


@pytest.mark.skipif(not receive.AVAILABLE, reason="needs the sockets of Linux")
def test_an_interface_that_goes_down(
    buses: dict[str, socket.socket], monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    down = [OSError(errno.ENETDOWN, "Network is down")]
    read = receive.SocketReceiver._read

    def fail_once(batch: receive.SocketReceiver) -> int:
        if down:
            raise down.pop()
        buses["vcan0"].send(struct.pack("=IB3x8s", 0x123, 0, b""))
        return read(batch)

    monkeypatch.setattr(receive.SocketReceiver, "_read", fail_once)
    out, err = printed(0, ["dump", "-D", "-n", "1", "vcan0"])
    assert out == "  vcan0  123   [0] \n"
    assert "vcan0: interface down" in err
    down.append(OSError(errno.ENETDOWN, "Network is down"))
    assert "vcan0: interface down" in printed(2, ["dump", "-n", "1", "vcan0"]).err


@pytest.mark.skipif(not receive.AVAILABLE, reason="needs the sockets of Linux")
def test_a_bus_that_can_not_be_opened_closes_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[socket.socket] = []

    def open_socket(channel: str, _selection: Selection) -> socket.socket:
        if channel == "bad":
            raise EnvironmentLackError("no such interface")
        opened.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        return opened[-1]

    monkeypatch.setattr(receive, "open_socket", open_socket)
    with pytest.raises(EnvironmentLackError):
        open_targets([Selection(channel="good"), Selection(channel="bad")], argparse.Namespace(interface="socketcan"))
    assert opened[0].fileno() == -1
