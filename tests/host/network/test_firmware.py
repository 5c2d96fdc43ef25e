"""`tipforce firmware` and its library on a bus: progress, versions, and every refusal with its message."""

import json
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from host.bus_with_nodes import new_channel, running
from microcontroller import program_board
from microcontroller.program_board import Board, image
from tipforce.errors import RefusedError
from tipforce.fingertip.node import fingertip_node
from tipforce.host.network import firmware as module
from tipforce.host.network.bus import Bus
from tipforce.host.network.firmware import Firmware, install, node_program
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools.cli.main import main

NODE_ID = program_board.NODE_ID


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_POLL_S", 0.01)


@pytest.fixture
def channel() -> str:
    return new_channel()


@pytest.fixture
def board(channel: str) -> Iterator[Board]:
    board = Board()
    with can.Bus(interface="virtual", channel=channel) as bus, program_board.running(board, bus):
        yield board


def written(tmp_path: Path, content: bytes) -> str:
    path = tmp_path / "program.bin"
    path.write_bytes(content)
    return str(path)


def command(channel: str, *words: str) -> int:
    action = "install" if words else "show"
    return main(["firmware", action, str(NODE_ID), *words, "-i", "virtual", "-c", channel])


def test_progress_and_the_program_that_the_node_confirms(board: Board, channel: str, tmp_path: Path) -> None:
    arrived, firmware = list[int](), Firmware.read(written(tmp_path, image(size=20000)))
    with Bus.open(channel, "virtual", timeout_s=3.0) as bus:
        after = install(bus, NODE_ID, firmware, progress=arrived.append)
        assert (after.version, after.identification, after.reason) == ("0.2.0", firmware.header.crc, "")
        assert board.slot == 0
        assert node_program(bus.sdo(NODE_ID)) == after
    assert arrived == sorted(arrived)
    assert len(arrived) > 20
    assert arrived[-1] == len(firmware.content)


@pytest.mark.usefixtures("board")
def test_the_command_shows_versions(channel: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(channel) == 0
    assert capsys.readouterr().out == "   5 (0x05)  0.1.0  0x00000000\n"
    assert main(["sdo", "dump", str(NODE_ID), "--json", "-q", "-i", "virtual", "-c", channel]) == 0
    assert '"index":"0x1F57"' in capsys.readouterr().out.replace(" ", "")
    file = written(tmp_path, image())
    assert command(channel, file, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "node_id": 5, "version": "0.2.0", "identification": f"0x{Firmware.read(file).header.crc:08X}",
        "version_before": "0.1.0", "reason": "",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("content", "code", "said"),
    [
        (image(key=b"stolen"), 12, "node 5 (0x05) refuses the image: the signature is wrong; sign"),
        (image(product=0x12340003), 12, "the image is for product 0x12340003, the node is 0x54500103; equal upper 16"),
        (image((0, 0, 9)), 12, "0.0.9 is older than the installed 0.1.0; add --allow-downgrade"),
        (image()[:-1], 2, "program.bin: the length or the CRC-32 of the image is wrong: the file is damaged"),
        (b"#!/bin/sh\n", 2, "program.bin: not a program image of format 1"),
        (image(size=1 << 17), 12, "refuses the image: the image is larger than a slot; it keeps 0.1.0"),
    ],
)
def test_refusals(
    content: bytes, code: int, said: str, board: Board, channel: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(channel, written(tmp_path, content)) == code
    assert board.slot == 2
    out, err = capsys.readouterr()
    assert said in err
    assert (err.count("\n"), out) == (1, "")


@pytest.mark.usefixtures("board")
def test_a_downgrade_that_is_asked_for(channel: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(channel, written(tmp_path, image((0, 0, 9))), "--allow-downgrade") == 0
    assert "0.1.0 -> 0.0.9" in capsys.readouterr().out


def test_an_unhealthy_program_is_reported(board: Board, channel: str, tmp_path: Path) -> None:
    with Bus.open(channel, "virtual", timeout_s=3.0) as bus:
        board.healthy = False
        with pytest.raises(RefusedError, match=r"runs 0.1.0: the new program did not start and communicate"):
            install(bus, NODE_ID, Firmware.read(written(tmp_path, image())))
        assert node_program(bus.sdo(NODE_ID)).reason.startswith("the new program did not start")


def test_a_linux_node_says_why_not(channel: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    node = fingertip_node(NODE_ID, SimulatedSource([[0.0] * 3] * 3))
    with running([node], channel):
        assert command(channel, written(tmp_path, image())) == 12
    assert "has no program slots (1F56h: abort 0x06020000): update a Linux node on its own" in capsys.readouterr().err
