"""The store file of a node: replaced as a whole, also by a process that is killed, readable or noted as damaged."""

import binascii
import json
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from canopen_device.errors import InputError
from canopen_device.running.store import FileStore
from fingertip.finger import SAVE, Finger, finger, record
from running import store_child

KILLS = int(os.environ.get("TIPFORCE_KILLS", "50"))
AT_ONCE = 2
LONGEST_US = 6000  # a few cycles of commit and store
CHILD = str(Path(__file__).with_name("store_child.py"))

Parent = subprocess.Popen[str]  # of the children that are killed: store_child.py


def node(path: Path) -> Finger:
    return finger(calibrated=False, store=FileStore(path))


def stored(path: Path, serial: int = 1) -> Finger:
    talk = node(path)
    talk.stage(record(serial=serial))
    assert talk.commit() == talk.put("I", 0x1010, 1, SAVE) == 0
    return talk


def failing(error: OSError) -> Callable[..., Any]:
    def refuse(*_arguments: object, **_names: object) -> None:
        raise error

    return refuse


FULL = OSError(28, "No space left on device")


def test_what_is_stored_is_there_after_a_restart_and_no_file_yet_is_no_damage(tmp_path: Path) -> None:
    talk = node(tmp_path / "node.json")
    assert (talk.calibration()[1], talk.device.storage.damaged, list(tmp_path.iterdir())) == (0, [], [])
    stored(tmp_path / "node.json")
    again = node(tmp_path / "node.json")
    assert again.upload(0x2140) == record()
    assert again.device.storage.damaged == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["node.json", "node.json.2"]


def test_file_is_flushed_then_renamed_then_its_directory_is_flushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    fsync, replace = os.fsync, os.replace

    def note_fsync(number: int) -> None:
        seen.append("fsync")
        fsync(number)

    def note_replace(old: Path, new: Path) -> None:
        assert json.loads(old.read_bytes())["groups"] == {"a": "07"}
        seen.append("rename")
        replace(old, new)

    monkeypatch.setattr(os, "fsync", note_fsync)
    monkeypatch.setattr(os, "replace", note_replace)
    assert FileStore(tmp_path / "node.json").save("a", b"\7")
    assert seen == ["fsync", "rename", "fsync"] if os.name == "posix" else ["fsync", "rename"]


@pytest.mark.parametrize("call", ["os.fsync", "os.replace", "builtins.open"])
def test_disk_that_refuses_leaves_the_old_file_and_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "node.json"
    talk = stored(path)
    for serial in (2, 3):
        before = slots(path)[0].read_bytes()
        talk.stage(record(serial=serial))
        assert talk.commit() == 0
        caplog.clear()
        with monkeypatch.context() as patch:
            patch.setattr(call, failing(FULL))
            assert [talk.put("I", 0x1010, 4, SAVE) for _ in range(5)] == [0x06060000] * 5
        assert slots(path)[0].read_bytes() == before
        assert not (tmp_path / "node.json.new").exists()
        # It is said once until a save succeeds. What is active stays active; it is only not stored.
        assert caplog.text.count("No space left on device; nothing was changed") == 1
        assert talk.upload(0x2140) == record(serial=serial)
        assert talk.put("I", 0x1010, 4, SAVE) == 0
        assert node(path).upload(0x2140) == record(serial=serial)


def test_directory_that_vanishes(tmp_path: Path) -> None:
    directory = tmp_path / "nodes"
    directory.mkdir()
    talk = stored(directory / "node.json")
    shutil.rmtree(directory)
    assert talk.put("I", 0x1010, 1, SAVE) == 0x06060000
    assert talk.put("I", 0x1011, 1, 0x64616F6C) == 0x06060000
    # The node itself goes on.
    assert talk.upload(0x2140) == record()


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"null", b'"text"', b"\xff\xfe\x00", b"[" * 100_000,
        b'{"calibration": 5, "application": "zz", "communication": null}',
        b'{"calibration": "00", "application": "0", "communication": []}',
    ],
)  # fmt: skip
def test_damaged_file_gives_defaults_and_is_noted(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "node.json"
    path.write_bytes(content)
    talk = node(path)
    assert talk.device.storage.damaged == ["communication", "application", "calibration"]
    assert talk.calibration() == (bytes(158), 0, 0)
    # Storing anew heals it.
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    assert node(path).device.storage.damaged == []


def slots(path: Path) -> list[Path]:
    """Both files, the one that was written last first."""
    both = [path, path.with_name(path.name + ".2")]
    return sorted(both, key=lambda one: -json.loads(one.read_bytes())["sequence"])


def test_one_damaged_group_leaves_the_others(tmp_path: Path) -> None:
    path = tmp_path / "node.json"
    stored(path)
    newest, older = slots(path)
    older.unlink()
    content = json.loads(newest.read_bytes())
    content["groups"]["application"] = "00" + content["groups"]["application"]
    newest.write_text(json.dumps(content), encoding="utf-8")
    talk = node(path)
    assert talk.device.storage.damaged == ["application"]
    assert talk.upload(0x2140) == record()


def test_a_corrupt_newest_slot_falls_back_to_the_older(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "node.json"
    talk = stored(path, serial=1)
    talk.put("I", 0x1010, 1, SAVE)  # the same once more, so that both slots hold all of it
    talk.stage(record(serial=2))
    assert talk.commit() == talk.put("I", 0x1010, 4, SAVE) == 0
    assert node(path).upload(0x2140) == record(serial=2)
    newest, _older = slots(path)
    newest.write_bytes(newest.read_bytes().replace(b'"calibration": "', b'"calibration": "ff', 1))
    caplog.clear()
    again = node(path)
    assert again.upload(0x2140) == record(serial=1)
    assert again.device.storage.damaged == []
    assert caplog.text.count("is damaged") == caplog.text.count("the other slot applies") == 1
    # The next save replaces the damaged slot, never the sound one.
    again.stage(record(serial=3))
    assert again.commit() == again.put("I", 0x1010, 4, SAVE) == 0
    assert slots(path)[0] == newest
    assert node(path).upload(0x2140) == record(serial=3)


def test_a_cut_at_every_byte_of_a_slot_is_noticed(tmp_path: Path) -> None:
    """Groups are kept apart, the slots take turns, and what an interrupted write left is overwritten."""
    (tmp_path / "node.json.new").write_bytes(b"half a")
    store = FileStore(tmp_path / "node.json")
    assert store.save("b", b"")
    for value in (b"\1", b"\2", b"\1", b"\2"):
        assert store.save("a", value)
        newest, older = slots(tmp_path / "node.json")
        assert (newest.name == "node.json") == (value == b"\2"), older
    assert (store.load("b"), store.load("c")) == (b"", None)
    whole = newest.read_bytes()
    for length in range(len(whole) - 2):  # but for the last brace's line end, which carries nothing
        newest.write_bytes(whole[:length])
        assert FileStore(tmp_path / "node.json").load("a") == b"\1", length
    newest.write_bytes(whole)
    assert FileStore(tmp_path / "node.json").load("a") == b"\2"


def test_the_form_before_there_were_two_slots_is_read(tmp_path: Path) -> None:
    path = tmp_path / "node.json"
    path.write_text('{"a": "0102"}')
    store = FileStore(path)
    assert store.load("a") == b"\1\2"
    assert store.save("b", b"\3")
    assert FileStore(path).load("a") == b"\1\2"


def test_file_that_cannot_be_read_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # A disk that fails for a moment must not cost the groups that a save does not carry.
    path = tmp_path / "node.json"
    stored(path)
    store = FileStore(path)
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(Path, "read_bytes", failing(PermissionError(13, "Permission denied")))
        assert not store.save("application", b"\1")
        assert node(path).device.storage.damaged == ["communication", "application", "calibration"]
    assert "Permission denied" in caplog.text
    assert node(path).upload(0x2140) == record()


def test_path_that_cannot_be_a_store_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a directory; give the name of a file"):
        FileStore(tmp_path)
    with pytest.raises(InputError, match="does not exist; create it first"):
        FileStore(tmp_path / "missing" / "node.json")
    (tmp_path / "node.toml").write_text("[node]\nid = 5\n")
    with pytest.raises(InputError, match="is not a store of a node; give the name of a new file"):
        FileStore(tmp_path / "node.toml")


def test_calibration_group_of_another_number_of_gauges_is_not_taken(tmp_path: Path) -> None:
    stored(tmp_path / "node.json")
    assert finger(4, calibrated=False, store=FileStore(tmp_path / "node.json")).calibration() == (bytes(198), 0, 0)


def survive(parent: Parent, path: Path, first: int, wait_us: int) -> tuple[int, int]:
    """Let a child store calibrations from ``first`` on and kill it; the last confirmed number, and the one found."""
    assert parent.stdin is not None
    assert parent.stdout is not None
    parent.stdin.write(f"{first}\n")
    parent.stdin.flush()
    child = int(parent.stdout.readline())
    confirmed = int(parent.stdout.readline())
    until_ns = time.perf_counter_ns() + 1000 * wait_us
    while time.perf_counter_ns() < until_ns:
        pass  # sleep() is too coarse for an instant within a write
    os.kill(child, signal.SIGKILL)
    while not (line := parent.stdout.readline()).startswith("ended"):
        confirmed = int(line)  # one write to a pipe each: a number is said as a whole or not at all
    assert line == f"ended {int(signal.SIGKILL)}\n", "the child must have been killed, not have ended by itself"
    talk = node(path)
    active = talk.upload(0x2140)
    assert isinstance(active, bytes)
    found = int(talk.get("I", 0x2102, 1))
    assert active == store_child.record(found)
    assert talk.get("I", 0x2103, 3) == binascii.crc32(active)
    assert talk.upload(0x2141) == active
    assert talk.device.storage.damaged == []
    return confirmed, found


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="SIGKILL is POSIX")
def test_calibration_survives_sigkill_at_any_instant(tmp_path: Path) -> None:
    rng = random.Random(200)
    waits = [[rng.randrange(LONGEST_US) for _ in range(KILLS // AT_ONCE)] for _ in range(AT_ONCE)]

    def series(worker: int) -> list[tuple[int, int]]:
        path, first, seen = tmp_path / f"node-{worker}.json", 1, []
        # -I -S: a start without site packages is faster; the paths of the package and of the tests are handed over.
        roots = [str(Path(str(sys.modules[name].__file__)).parents[1]) for name in ("tipforce", "fingertip.finger")]
        run = f"import sys, runpy; sys.path[:0] = {roots!r}; runpy.run_path({CHILD!r}, run_name='__main__')"
        command = [sys.executable, "-I", "-S", "-c", run, str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
            for wait_us in waits[worker]:
                seen.append(survive(parent, path, first, wait_us))
                first = seen[-1][1] + 1  # each child goes on from what the one before left behind
        return seen

    with ThreadPoolExecutor(AT_ONCE) as pool:
        results = [pair for seen in pool.map(series, range(AT_ONCE)) for pair in seen]
    assert len(results) == KILLS
    for confirmed, found in results:
        assert found in (confirmed, confirmed + 1)
