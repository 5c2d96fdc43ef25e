"""`tipforce log` and `replay` beside canplayer, candump and tshark on a real vcan; and the receive path under load."""

import socket
import struct
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.live.receive import SocketReceiver, open_receiver, open_socket
from tipforce.host.live.receiver import Filter, Selection
from vcan.support import WAIT_S, Command, Launch, RawBus, wait_until
from vcan.test_dump_options import EVERYTHING, fd_bus, listening_candump, traffic

STORM = 5_000  # each counter wraps three times; `bench.live` sends more
PART = 100  # frames in one go; in User-mode Linux the receiver has the same one processor as the sender


@contextmanager
def logging(launch: Launch, path: Path, *words: str) -> Iterator[Command]:
    command = launch("log", "-o", str(path), *words)
    wait_until(lambda: "recording to" in command.stderr, "log does not listen")
    yield command
    assert command.end() == 130, command.stderr
    assert "Traceback" not in command.stderr


@pytest.fixture
def recording(launch: Launch, tmp_path: Path) -> tuple[Path, Path]:
    """What log and `candump -L` have of the same traffic, every kind of frame."""
    ours, theirs = tmp_path / "run.log", tmp_path / "candump.log"
    with fd_bus() as bus, logging(launch, ours, EVERYTHING), listening_candump(["-L", EVERYTHING], theirs):
        for frame in traffic():
            bus.send(frame)
        wait_until(lambda: theirs.read_bytes().count(b"\n") == len(traffic()), "candump lags")
    return ours, theirs


def test_the_log_is_candumps_to_the_byte(recording: tuple[Path, Path]) -> None:
    ours, theirs = recording
    assert ours.read_text() == theirs.read_text()


def test_canplayer_plays_our_log(recording: tuple[Path, Path], tmp_path: Path) -> None:
    played = tmp_path / "played"
    with fd_bus("vcan1"), listening_candump(["-L", "vcan1,0:0,#FFFFFFFF"], played):
        subprocess.run(["canplayer", "-t", "-I", str(recording[0]), "vcan1=vcan0"], check=True, timeout=WAIT_S)
        wait_until(lambda: played.read_bytes().count(b"\n") == len(traffic()), "canplayer has not played all")
    assert without_time(played) == [line.replace("vcan0", "vcan1") for line in without_time(recording[0])]


def test_replay_plays_candumps_log(recording: tuple[Path, Path], launch: Launch, tmp_path: Path) -> None:
    played = tmp_path / "played"
    with fd_bus("vcan1"), listening_candump(["-L", "vcan1,0:0,#FFFFFFFF"], played):
        command = launch("replay", str(recording[1]), "vcan1=vcan0", "--speed", "5")
        assert command.wait() == 0, command.stderr
        wait_until(lambda: played.read_bytes().count(b"\n") == len(traffic()), "replay has not played all")
    assert f"{len(traffic())} frames sent" in command.stderr
    assert without_time(played) == [line.replace("vcan0", "vcan1") for line in without_time(recording[1])]


def without_time(path: Path) -> list[str]:
    return [line.partition(") ")[2] for line in path.read_text().splitlines()]


def test_replay_on_an_interface_without_can_fd_says_what_it_left_out(launch: Launch, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text("(1700000000.000000) vcan0 123##0112233\n(1700000000.000000) vcan0 123#11\n")
    for change in (["down"], ["mtu", "16"], ["up"]):
        subprocess.run(["ip", "link", "set", "vcan1", *change], check=True, timeout=WAIT_S)
    with fd_bus() as _:
        command = launch("replay", str(path), "vcan1=vcan0")
        assert command.wait() == 0
    assert "1 frame sent" in command.stderr
    assert "1 frame left out: because vcan1 carries no CAN FD frames" in command.stderr


def test_an_interface_that_goes_down_and_comes_back(launch: Launch, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    with logging(launch, path, "-D", "vcan1") as command:
        for change in ("down", "up"):
            subprocess.run(["ip", "link", "set", "vcan1", change], check=True, timeout=WAIT_S)
        wait_until(lambda: "vcan1: interface down" in command.stderr, "the interface is not down")
        with RawBus("vcan1") as bus:
            bus.send(0x123, b"\x01")
            wait_until(lambda: path.stat().st_size > 0, "nothing is recorded afterwards")
    assert without_time(path) == ["vcan1 123#01"]


def test_the_receive_path_loses_nothing() -> None:
    """Contact PDOs of five nodes and frames that the kernel's filter leaves out, in parts that the buffer holds."""
    contact = struct.Struct("=IB3xHhhBB")
    taken = threading.Semaphore(2)
    selection = Selection((Filter(0x280, 0x780),))

    def send() -> None:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            bus.bind(("vcan0",))
            for number in range(STORM):
                if number % PART == 0:
                    assert taken.acquire(timeout=WAIT_S)
                bus.send(contact.pack(0x281 + number % 5, 8, number % 30_000, 1, 2, 3, number // 5 % 256))
                bus.send(contact.pack(0x181, 8, 0, 0, 0, 0, 0))

    thread = threading.Thread(target=send)
    decoder = Decoder(node_ids=range(1, 6))
    numbers: dict[int, list[int]] = {node_id: [] for node_id in range(1, 6)}
    stamps: list[int] = []
    with open_receiver({"interface": "socketcan", "channel": "vcan0"}, selection) as receiver:
        thread.start()
        done = 0
        while done < STORM:
            frames = receiver.receive(WAIT_S)
            assert len(frames), "nothing comes"
            for samples in decoder.decode(frames).values():
                numbers[samples.node_id] += np.round(samples.columns["P"] * 1000).astype(int).tolist()
            stamps += frames["t_ns"].tolist()
            for _ in range((done + len(frames)) // PART - done // PART):
                taken.release()
            done += len(frames)
        thread.join()
        assert receiver.dropped == 0
    for node_id, found in numbers.items():
        assert found == [number % 30_000 for number in range(node_id - 1, STORM, 5)]
    assert stamps == sorted(stamps)


def test_what_the_kernel_dropped_is_counted(bus: RawBus) -> None:
    one = open_socket("vcan0", Selection())
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    with SocketReceiver(one, "vcan0") as receiver:
        for number in range(2000):  # far more than the buffer of the socket holds
            bus.send(0x123, struct.pack("<q", number))
        count = 0
        while len(frames := receiver.receive(0.5)):
            count += len(frames)
        bus.send(0x124, b"")  # the counter travels with a frame
        count += len(receiver.receive(WAIT_S))
        assert count + receiver.dropped == 2001
        assert receiver.dropped > 0
