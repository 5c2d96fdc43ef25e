"""`tipforce log`: what its files hold, by format; how it ends; rotation; what it refuses."""

from __future__ import annotations

import gzip
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path

import can
import pytest

from tipforce.host.logs.recorder import Recorder
from tipforce_tools.cli.main import main
from tipforce_tools.log import default_name
from tools.blocks import MIXED, MIXED_LOG, block_of_text, written
from tools.rig import message, sending

COUNT = 60


def counting(channel: str) -> AbstractContextManager[None]:
    """Sends frames 285h with a running number."""
    return sending(channel, lambda number: [message(0x285, number.to_bytes(4, "little"))], 0.002)


def text_of(path: Path) -> str:
    """What a text file holds, unzipped."""
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode()


def log(channel: str, *words: str) -> int:
    return main(["log", "-i", "virtual", "-c", channel, *words])


def test_the_file_is_candumps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.log"
    before = time.time()
    with counting("log1"):
        assert log("log1", "-o", str(path), "-n", str(COUNT), "--json") == 0
    out, err = capsys.readouterr()
    lines = path.read_text().splitlines()
    assert len(lines) == COUNT
    found = [re.fullmatch(r"\((\d{10}\.\d{6})\) log1 285#([0-9A-F]{8})", line) for line in lines]
    assert all(found)
    numbers = [int.from_bytes(bytes.fromhex(match[2]), "little") for match in found if match]
    assert numbers == list(range(numbers[0], numbers[0] + COUNT)), "nothing is lost"
    assert before - 1 < float(found[0][1] if found[0] else 0) < time.time() + 1
    assert err.splitlines()[0] == f"tipforce log: recording to {path}"
    assert re.match(rf"tipforce log: {COUNT} frames in \d+\.\d s to .*run\.log, 0 dropped", err.splitlines()[1])
    record = json.loads(out)
    assert (record["frames"], record["dropped"], record["files"]) == (COUNT, 0, [str(path)])


def test_the_default_name_is_candumps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with counting("log2"):
        assert log("log2", "-n", "1", "-q") == 0
    assert capsys.readouterr().err == ""
    (path,) = tmp_path.iterdir()
    assert re.fullmatch(r"candump-\d{4}-\d\d-\d\d_\d{6}\.log", path.name)
    assert default_name(time.mktime((2026, 5, 17, 9, 30, 0, 0, 0, -1))) == "candump-2026-05-17_093000.log"


@pytest.mark.parametrize("name", ["run.asc", "run.blf", "run.csv", "run.trc", "run.db", "run.asc.gz", "run.csv.gz"])
def test_python_cans_formats(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with counting("log3"):
        assert log("log3", "-o", str(path), "-n", str(COUNT), "-q") == 0
    with can.LogReader(path) as reader:
        found = [int.from_bytes(message.data, "little") for message in reader]
    assert found == list(range(found[0], found[0] + COUNT))


@pytest.mark.parametrize("name", ["run.log", "run.log.gz"])
def test_every_kind_of_frame_as_candump_writes_it(name: str, tmp_path: Path) -> None:
    assert text_of(written(tmp_path / name)) == MIXED_LOG


def test_every_kind_of_frame_as_messages(tmp_path: Path) -> None:
    with can.LogReader(written(tmp_path / "run.blf")) as reader:
        messages = list(reader)
    assert [message.arbitration_id for message in messages] == [can_id & 0x1FFFFFFF for can_id, _ in MIXED]
    assert [message.is_fd for message in messages] == [isinstance(kind, int) for _, kind in MIXED]
    assert [message.is_remote_frame for message in messages] == [kind == "remote" for _, kind in MIXED]
    assert [message.is_error_frame for message in messages] == [kind == "error" for _, kind in MIXED]


def test_a_database_holds_all_that_was_written_at_once(tmp_path: Path) -> None:
    """python-can's own stop() loses most of them."""
    text = "".join(f"(1700000000.{k:06d}) vcan0 285#{k:08X}\n" for k in range(20_000))
    with can.LogReader(written(tmp_path / "run.db", text)) as reader:
        assert sum(1 for _ in reader) == 20_000


def test_rotation_by_size(tmp_path: Path) -> None:
    block = block_of_text("".join(f"(1700000000.{k:06d}) vcan0 285#{k:08X}\n" for k in range(100)))
    with Recorder(tmp_path / "run.log", limit_bytes=10_000) as recorder:
        for _ in range(10):
            recorder.write(block)
    names = [f"run-000{k}.log" for k in range(1, 5)]
    assert [path.name for path in recorder.paths] == names
    assert sum(len(path.read_text().splitlines()) for path in recorder.paths) == recorder.frames == 1000
    assert all(path.stat().st_size < 10_000 + 100 * 40 for path in recorder.paths)


def test_rotation_by_time(tmp_path: Path) -> None:
    with counting("log4"):
        words = ("-o", str(tmp_path / "run.log.gz"), "-n", "300", "--rotate-time", "0.2", "-q")
        assert log("log4", *words) == 0
    paths = sorted(tmp_path.iterdir())
    assert len(paths) >= 2
    assert paths[0].name == "run-0001.log.gz"
    lines = [line for path in paths for line in text_of(path).splitlines()]
    numbers = [int.from_bytes(bytes.fromhex(line.rpartition("#")[2]), "little") for line in lines]
    assert numbers == list(range(numbers[0], numbers[0] + 300)), "nothing is lost between two files"


def test_silence_ends_it(tmp_path: Path) -> None:
    assert log("log5", "-o", str(tmp_path / "run.log"), "-T", "100", "-q") == 0
    assert (tmp_path / "run.log").read_text() == ""


CHILD = """
import sys, threading, can
from can.interfaces.virtual import channels
from tipforce_tools.cli.main import main
def send():
    with can.Bus("x", interface="virtual") as bus:
        number = 0
        while len(channels["x"]) < 2:  # the recorder's bus
            threading.Event().wait(0.001)
        while True:
            bus.send(can.Message(arbitration_id=0x285, data=number.to_bytes(4, "little"), is_extended_id=False))
            number += 1
            if number == 100:
                print("100 frames", flush=True)
            threading.Event().wait(0.001)
threading.Thread(target=send, daemon=True).start()
sys.exit(main(["log", "-i", "virtual", "-c", "x", "-o", sys.argv[1]]))
"""


@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "run.log"), (signal.SIGTERM, "run.log.gz")])
def test_a_signal_closes_the_file(number: int, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, path], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stderr.readline() == f"tipforce log: recording to {path}\n"
        assert process.stdout.readline() == "100 frames\n"
        os.kill(process.pid, number)
        said = process.stderr.read()
        assert process.wait(30) == 130
    lines = text_of(path).splitlines()
    numbers = [int.from_bytes(bytes.fromhex(line.rpartition("#")[2]), "little") for line in lines]
    assert len(numbers) > 20
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert said.startswith(f"tipforce log: {len(numbers)} frames in ")
    assert "Traceback" not in said


def test_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text("old")
    assert log("log7", "-o", str(path), "-T", "50", "--overwrite", "-q") == 0
    assert path.read_text() == ""
