"""`tipforce log` and `replay` beside canplayer, candump and tshark on a real vcan."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from vcan.support import WAIT_S, Command, Launch, RawBus, ip_link, wait_until
from vcan.test_dump_options import EVERYTHING, fd_bus, listening_candump, traffic


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


@pytest.mark.parametrize("player", ["canplayer", "replay"])
def test_each_plays_the_log_of_the_other(
    player: str, recording: tuple[Path, Path], launch: Launch, tmp_path: Path
) -> None:
    played, log = tmp_path / "played", recording[player == "replay"]
    with fd_bus("vcan1"), listening_candump(["-L", "vcan1,0:0,#FFFFFFFF"], played):
        if player == "canplayer":
            subprocess.run(["canplayer", "-t", "-I", str(log), "vcan1=vcan0"], check=True, timeout=WAIT_S)
        else:
            command = launch("replay", str(log), "vcan1=vcan0", "--speed", "5")
            assert command.wait() == 0, command.stderr
            assert f"{len(traffic())} frames sent" in command.stderr
        wait_until(lambda: played.read_bytes().count(b"\n") == len(traffic()), f"{player} has not played all")
    assert without_time(played) == [line.replace("vcan0", "vcan1") for line in without_time(log)]


def without_time(path: Path) -> list[str]:
    return [line.partition(") ")[2] for line in path.read_text().splitlines()]


def test_replay_on_an_interface_without_can_fd_says_what_it_left_out(launch: Launch, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text("(1700000000.000000) vcan0 123##0112233\n(1700000000.000000) vcan0 123#11\n")
    for change in (["down"], ["mtu", "16"], ["up"]):
        ip_link("set", "vcan1", *change)
    with fd_bus() as _:
        command = launch("replay", str(path), "vcan1=vcan0")
        assert command.wait() == 0
    assert "1 frame sent" in command.stderr
    assert "1 frame left out: because vcan1 carries no CAN FD frames" in command.stderr


def test_an_interface_that_goes_down_and_comes_back(launch: Launch, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    with logging(launch, path, "-D", "vcan1") as command:
        for change in ("down", "up"):
            ip_link("set", "vcan1", change)
        wait_until(lambda: "vcan1: interface down" in command.stderr, "the interface is not down")
        with RawBus("vcan1") as bus:
            bus.send(0x123, b"\x01")
            wait_until(lambda: path.stat().st_size > 0, "nothing is recorded afterwards")
    assert without_time(path) == ["vcan1 123#01"]
