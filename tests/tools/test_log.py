"""`tipforce log` and `tipforce replay`: what files hold by format, what reaches the buses, what is refused."""

import gzip
import io
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import can
import pytest

from canopen_device.core.codes import ERROR_FLAG
from tipforce.host.logs.notes import LogNotes
from tipforce.host.logs.recorder import Recorder
from tipforce_tools.cli import listening as module
from tipforce_tools.log import default_name
from tipforce_tools.replay import timed_frames
from tools.blocks import MIXED, MIXED_LOG, block_of_text, written
from tools.rig import Printed, message, process, sending

COUNT = 60
KINDS = [(can_id & ~ERROR_FLAG, kind & 3 if isinstance(kind, int) else kind) for can_id, kind in MIXED]


def counting(channel: str) -> AbstractContextManager[None]:
    return sending(channel, lambda number: [message(0x285, number.to_bytes(4, "little"))], 0.002)


def text_of(path: Path) -> str:
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode()


def test_the_file_is_candumps(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "run.log"
    before = time.time()
    with counting("log1"):
        ended = printed(0, f"log -i virtual -c log1 -o {path} -n {COUNT} --json")
    lines = path.read_text().splitlines()
    assert len(lines) == COUNT
    found = [re.fullmatch(r"\((\d{10}\.\d{6})\) log1 285#([0-9A-F]{8})", line) for line in lines]
    assert all(found)
    assert is_counted(numbers_of(path.read_text()))
    assert before - 1 < float(found[0][1] if found[0] else 0) < time.time() + 1
    first, second, *_ = ended.err.splitlines()
    assert first == f"tipforce log: recording to {path}"
    assert re.match(rf"tipforce log: {COUNT} frames in \d+\.\d s to .*run\.log, 0 dropped", second)
    (record,) = ended.records
    assert (record["frames"], record["dropped"], record["files"]) == (COUNT, 0, [str(path)])


def test_the_default_name_is_candumps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    monkeypatch.chdir(tmp_path)
    with counting("log2"):
        assert printed(0, "log -i virtual -c log2 -n 1 -q").err == ""
    (path,) = tmp_path.iterdir()
    assert re.fullmatch(r"candump-\d{4}-\d\d-\d\d_\d{6}\.log", path.name)
    assert default_name(time.mktime((2026, 5, 17, 9, 30, 0, 0, 0, -1))) == "candump-2026-05-17_093000.log"


@pytest.mark.parametrize("name", ["run.asc", "run.blf", "run.csv", "run.trc", "run.db", "run.asc.gz", "run.csv.gz"])
def test_python_cans_formats(name: str, tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / name
    with counting("log3"):
        printed(0, f"log -i virtual -c log3 -o {path} -n {COUNT} -q")
    with can.LogReader(path) as reader:
        numbers = [int.from_bytes(message.data, "little") for message in reader]
    assert (len(numbers), is_counted(numbers)) == (COUNT, True)


@pytest.mark.parametrize("name", ["run.log", "run.log.gz"])
def test_every_kind_of_frame_as_candump_writes_it(name: str, tmp_path: Path) -> None:
    assert text_of(written(tmp_path / name)) == MIXED_LOG


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


def test_rotation_by_time(tmp_path: Path, printed: Printed) -> None:
    with counting("log4"):
        printed(0, f"log -i virtual -c log4 -o {tmp_path}/run.log.gz -n 300 --rotate-time 0.2 -q")
    paths = sorted(tmp_path.iterdir())
    assert len(paths) >= 2
    assert paths[0].name == "run-0001.log.gz"
    numbers = numbers_of("".join(map(text_of, paths)))
    assert (len(numbers), is_counted(numbers)) == (300, True)


def test_silence_ends_it(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "run.log"
    for overwrite in ("", "--overwrite"):
        printed(0, f"log -i virtual -c log5 -o {path} -T 100 -q {overwrite}")
        assert path.read_text() == ""
        path.write_text("old")


def test_what_came_before_the_end_is_received_however_late_the_end_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process stands still after an empty look, and after the signal."""
    now_s, looks = [100.0], iter([[], ["late"]])

    def receive_block(_timeout_s: float) -> list[str]:
        now_s[0] += 60.0
        return next(looks, [])

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    receiver, args = Mock(receive_block=receive_block), Namespace(timeout_ms=30_000)
    received: Any = module.received
    assert list(received(receiver, args, "log")) == [["late"]]
    hours = itertools.count(3600.0, 3600.0)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(hours)))
    looks = iter([["late"]])
    assert list(received(receiver, args, "log", lambda: True)) == [["late"]]


def signalled(number: int, code: str, path: Path, *first: str) -> str:
    """What a program writes to stderr after its first line, which, as that of stdout, is one of ``first``."""
    words = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        for stream, line in zip((running.stdout, running.stderr), first, strict=False):
            assert stream.readline() == line
        os.kill(running.pid, number)
        said = running.stderr.read()
        assert running.wait(30) == 130
    assert "Traceback" not in said
    return said


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
    said = signalled(number, CHILD, path, "100 frames\n", f"tipforce log: recording to {path}\n")
    numbers = numbers_of(text_of(path))
    assert len(numbers) > 20
    assert is_counted(numbers)
    assert said.startswith(f"tipforce log: {len(numbers)} frames in ")


@contextmanager
def listening(*channels: str) -> Iterator[list[can.BusABC]]:
    with ExitStack() as opened:
        yield [opened.enter_context(can.Bus(channel, interface="virtual")) for channel in channels]


def received(bus: can.BusABC) -> list[can.Message]:
    return list(iter(lambda: bus.recv(0), None))


def numbers_of(text: str) -> list[int]:
    """What ``counting`` has sent, by candump's lines."""
    return [int.from_bytes(bytes.fromhex(line.rpartition("#")[2]), "little") for line in text.splitlines()]


def is_counted(numbers: list[int]) -> bool:
    """Whether nothing is lost."""
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def shown(message: can.Message) -> tuple[int, str | int]:
    """Identifier and kind, as MIXED has them."""
    kind: str | int = "remote" if message.is_remote_frame else "error" if message.is_error_frame else "data"
    if message.is_fd:
        kind = message.bitrate_switch + 2 * message.error_state_indicator
    return message.arbitration_id, kind


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run.log"
    path.write_text(MIXED_LOG)
    return path


def test_all_frames_to_one_bus(log: Path, printed: Printed) -> None:
    with listening("replay1") as (bus,):
        ended = printed(0, f"replay -i virtual -c replay1 {log} --json")
        messages = received(bus)
    assert [shown(message) for message in messages] == KINDS
    assert messages[0].data.hex() == "2e1129239a110303"
    assert messages[4].dlc == 8
    assert messages[8].data == bytes(range(12))
    (record,) = ended.records
    assert (record["sent"], record["left_out"], record["bad_lines"]) == (9, {}, {})
    assert record["seconds"] >= 0.03
    assert ended.err.startswith("tipforce replay: 9 frames sent in 0.")


@pytest.mark.parametrize("name", ["run.log.gz", "run.blf", "run.asc"])
def test_other_formats(name: str, tmp_path: Path, printed: Printed) -> None:
    path = written(tmp_path / name)
    assert len(printed(0, f"dump {path}").out.splitlines()) == len(KINDS)
    with listening("replay2") as (bus,):
        printed(0, f"replay -i virtual -c replay2 -q {path}")
        found = [shown(message) for message in received(bus)]
    # ASC does not hold the class of an error frame.
    assert [one for one in found if one[1] != "error"] == [one for one in KINDS if one[1] != "error"]
    assert [kind for _, kind in found] == [kind for _, kind in KINDS]


def test_a_truncated_log_is_sent_up_to_there_and_refused(tmp_path: Path, printed: Printed) -> None:
    path = written(tmp_path / "run.log.gz")
    path.write_bytes(path.read_bytes()[:-9])
    err = printed(2, f"replay -i virtual -c replay8 {path}").err
    assert re.search(r"[1-9] frames sent.*damaged or truncated: .*ended before", err, re.DOTALL)


def test_assignments(log: Path, printed: Printed) -> None:
    with listening("replay3", "replay4", "replay5") as (first, second, other):
        err = printed(0, f"replay -i virtual {log} replay3=can1 replay4=can1").err
        expected = [0x185, 0x12345678, 0x123]
        assert [message.arbitration_id for message in received(first)] == expected
        assert [message.arbitration_id for message in received(second)] == expected
        assert received(other) == []
    assert "6 frames sent" in err
    assert "6 frames left out: of vcan0, which no assignment names" in err
    with listening("vcan0", "can1") as buses:  # without assignments frames go where they came from
        printed(0, f"replay -i virtual -q {log}")
        assert [len(received(bus)) for bus in buses] == [6, 3]


@pytest.mark.parametrize(
    ("speed", "max_gap_s", "due_s"),
    [
        (1, None, [0, 1, 1, 1, 96, 96, 97, 97, 97, 192]),
        (10, 1e300, [0, 0.1, 0.1, 0.1, 9.6, 9.6, 9.7, 9.7, 9.7, 19.2]),
        (2, 1.0, [0, 0.5, 0.5, 0.5, 1.0, 1.0, 1.5, 1.5, 1.5, 2.0]),
        (float("inf"), None, [0] * 10),
    ],
)
def test_when_frames_are_due(tmp_path: Path, speed: float, max_gap_s: float | None, due_s: list[float]) -> None:
    path = tmp_path / "run.log"
    path.write_text("".join(f"({t_s}.000000) vcan0 285#00\n" for t_s in (5, 6, 6, 5, 100)))
    args = Namespace(log=str(path), strict=False, speed=speed, max_gap=max_gap_s, loop=2)
    assert [due for due, _, _ in timed_frames(args, LogNotes())] == pytest.approx(due_s)


def test_loops_speed_and_gaps(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "run.log"
    path.write_text("(1700000000.000000) vcan0 285#00\n(1700009999.000000) vcan0 285#01\n")
    with listening("replay7") as (bus,):
        for words, loops in (("--loop 3 --max-gap 0.02 --speed 2", 3), ("--speed inf", 1)):
            printed(0, f"replay -i virtual -q -c replay7 {path} {words}")
            assert [message.data[0] for message in received(bus)] == loops * [0, 1]


def test_stdin_and_bad_lines() -> None:
    text = MIXED_LOG + "rubbish\n" + MIXED_LOG
    words = "replay -i virtual -c x --speed inf -"
    done = process(words, input=text)
    assert done.returncode == 0
    assert "18 frames sent" in done.stderr
    assert "bad lines left out (1 not a candump line), first line 10: 'rubbish'" in done.stderr
    done = process(f"{words} --strict", input=text)
    assert done.returncode == 1
    assert "tipforce replay: line 10: 'rubbish': not a candump line" in done.stderr
    assert "9 frames sent" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_signal_ends_a_silent_stdin(monkeypatch: pytest.MonkeyPatch) -> None:
    reads, writes = os.pipe()
    with os.fdopen(reads) as stdin, os.fdopen(writes, "w"):
        monkeypatch.setattr(sys, "stdin", stdin)
        args = Namespace(log="-", loop=1, max_gap=None, speed=1.0, strict=False)
        assert list(timed_frames(args, LogNotes(), lambda: True)) == []


def test_a_signal_ends_an_endless_loop(log: Path) -> None:
    code = (
        "import sys, threading, can\nfrom tipforce_tools.cli.main import main\n"
        "bus = can.Bus(interface='virtual', channel='x')\n"
        "threading.Thread(target=lambda: print(bus.recv() and 'sent', flush=True), daemon=True).start()\n"
        "sys.exit(main(['replay', '-i', 'virtual', '-c', 'x', sys.argv[1], '--loop', 'inf']))\n"
    )
    assert signalled(signal.SIGTERM, code, log, "sent\n").startswith("tipforce replay: ")


def test_a_real_bus_is_asked_for_first(log: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    asked = f"replay -i socketcan {log} can7=vcan0"
    assert "this sends the frames of" in printed(2, asked).err
    assert "interface socketcan, channel can7: " in printed({2, 9}, f"{asked} --yes").err
