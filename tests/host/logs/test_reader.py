"""Logs of every format and in every state of repair: the frames, the counts, and never a traceback."""

import gzip
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest
import zstandard

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.frames.frame_array import SENT, FrameArray, frame_array
from tipforce.host.logs import lines
from tipforce.host.logs.reader import LogReader, log_kind, open_log
from tools.rig import Clock, until

LOGS = Path(__file__).parent / "broken"
LINES = [f"(1700000000.{k:06d}) can{k % 2} {0x181 + k % 15:03X}#{k:016X}\n" for k in range(20_000)]
TEXT = "".join(LINES).encode()


def read(source: Path | str, **options: object) -> tuple[FrameArray, LogReader]:
    with open_log(source, **options) as log:  # type: ignore[arg-type]
        blocks = list(log)
    assert all(len(block) for block in blocks)
    return np.concatenate(blocks) if blocks else frame_array([]), log


BROKEN = {
    "bad_times.log": (2, {"timestamp": 5, "not a candump line": 1}, {}),
    "binary_junk.log": (2, {"not a candump line": 2}, {}),
    "byte_order_mark.log": (2, {}, {}),
    "crlf.log": (4, {}, {}),
    "cut_lines.log": (3, {"not a candump line": 3, "data": 1}, {}),  # a cut line can be a good one
    "empty.log": (0, {}, {}),
    "far_years.log": (4, {"timestamp": 3}, {}),
    "gzip_checksum.log.gz": (200, {"unreadable": 1}, {}),
    "gzip_cut.log.gz": (None, {"unreadable": 1}, {}),
    "gzip_empty.log.gz": (0, {"unreadable": 1}, {}),
    "huge_line.log": (2, {"not a candump line": 1, "length": 1}, {}),
    "mixed_formats.log": (
        7,
        {"not a candump line": 2},
        {"CAN FD frame": 1, "error frame": 1, "remote frame": 2, "frame dropped by candump": 7},
    ),
    "no_interface.log": (2, {"not a candump line": 3}, {}),
    "no_last_line_end.log": (3, {}, {}),
    "nul_bytes.log": (2, {"data": 1, "not a candump line": 1}, {}),
    "odd_digits.log": (2, {"data": 2, "identifier": 1}, {}),
    "only_line_ends.log": (0, {}, {}),
    "time_backwards.log": (5, {}, {}),
    "too_long.log": (2, {"length": 4}, {}),
    "wrong_hex.log": (2, {"data": 2, "identifier": 1}, {}),
}


def test_the_corpus_is_listed() -> None:
    assert sorted(BROKEN) == sorted(path.name for path in LOGS.iterdir())


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_log_gives_its_counts(name: str) -> None:
    count, bad, skipped = BROKEN[name]
    frames, log = read(LOGS / name)
    assert (log.bad, log.skipped) == (bad, skipped)
    assert (log.first_bad is None) == (not bad)
    assert count is None or len(frames) == count


@pytest.mark.parametrize("name", [name for name, (_, bad, _) in BROKEN.items() if bad])
def test_strict_stops_at_the_first_bad_line_after_the_frames_before(name: str) -> None:
    _, lenient = read(LOGS / name)
    with open_log(LOGS / name, strict=True) as log:
        blocks = iter(log)
        if name != "gzip_empty.log.gz":
            assert len(next(blocks)) > 0
        with pytest.raises(InputError) as caught:
            next(blocks)
    assert str(caught.value) == str(lenient.first_bad)


def cut(packed: bytes) -> bytes:
    return packed[: len(packed) * 2 // 3]


@pytest.mark.parametrize("pack", [bytes, gzip.compress, zstandard.compress], ids=["plain", "gzip", "zstd"])
@pytest.mark.parametrize("name", ["a.log", "b.txt", "without_suffix", "c.log.gz"])
def test_packed_or_not_by_the_first_bytes(tmp_path: Path, pack: Callable[[bytes], bytes], name: str) -> None:
    path = tmp_path / name
    path.write_bytes(pack(TEXT))
    frames, log = read(path, strict=True)
    assert log.channels == ["can0", "can1"]
    np.testing.assert_array_equal(frames["channel"], np.arange(len(LINES)) % 2)
    np.testing.assert_array_equal(frames["data"].view(">u8")[:, 0], np.arange(len(LINES)))


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_packed_in_parts_and_cut(tmp_path: Path, pack: Callable[[bytes], bytes]) -> None:
    """What comes before the cut, or before what is no part, is read, and the rest is noted."""
    path = tmp_path / "x.log"
    halves = [pack(TEXT[: len(TEXT) // 2]), pack(TEXT[len(TEXT) // 2 :])]
    path.write_bytes(b"".join(halves))
    assert len(read(path)[0]) == len(LINES)
    for end in (cut(halves[1]), b"rubbish behind it"):
        path.write_bytes(halves[0] + end)
        frames, log = read(path)
        assert log.bad["unreadable"] == 1
        assert len(LINES) // 2 - 1 <= len(frames) < len(LINES)
        np.testing.assert_array_equal(frames["t_ns"], 1_700_000_000_000_000_000 + np.arange(len(frames)) * 1000)


def test_zstd_without_its_library_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.zst"
    path.write_bytes(zstandard.compress(TEXT))
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(EnvironmentLackError, match=r"pip install 'tipforce\[zstd\]'"):
        open_log(path)


def test_lines_across_blocks_and_lines_longer_than_a_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "BLOCK_BYTES", 4096)
    path = tmp_path / "x.log"
    long = b"x" * 10_000 + b"\n"
    path.write_bytes(TEXT[: 46 * 100] + long + TEXT[46 * 100 : 46 * 101] + long + b"y" * 5000)
    frames, log = read(path)
    assert len(frames) == 101
    assert log.bad == {"not a candump line": 3}
    assert log.first_bad == f"{path}: a line of more than 4096 bytes is not a line of a log"


def test_a_part_by_time() -> None:
    start = 1_700_000_000_000_003_000
    frames, _ = read(LOGS / "time_backwards.log")
    assert (frames["t_ns"] - start).tolist() == [2000, 1000, 0, -1000, 6000]  # as they are
    frames, _ = read(LOGS / "time_backwards.log", start_ns=start, end_ns=start + 2000)
    assert (frames["t_ns"] - start).tolist() == [1000, 0]
    with pytest.raises(InputError, match="no timestamps"):
        read(LOGS / "mixed_formats.log", start_ns=start)


def test_follow_a_file_that_grows_and_starts_again(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    path.write_text(LINES[0] + LINES[1][:20])
    texts = iter([path.read_text() + LINES[1][20:] + LINES[2], LINES[7]])

    def stop() -> bool:
        """At each end of the file it is written again, until nothing is left to write."""
        if log.position < path.stat().st_size:
            return False
        text = next(texts, None)
        if text is not None:
            path.write_text(text)
        return text is None

    with open_log(path, follow=True, stop=stop) as log:
        assert [block["data"][:, 7].tolist() for block in log] == [[0], [1, 2], [7]]


def test_lines_written_just_before_the_stop_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    path.write_text(LINES[0])
    looks = iter([False, True])

    def stop() -> bool:
        stopped = next(looks, True)
        if stopped and path.stat().st_size == len(LINES[0]):
            with path.open("a") as file:
                file.write(LINES[1])
        return stopped

    frames, _ = read(path, follow=True, stop=stop)
    assert len(frames) == 2


def test_lines_that_came_before_a_late_end_of_the_wait_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, looks = Clock(), iter([list[int]()])

    def select(*_: object) -> tuple[object, ...]:
        clock.sleep(10.0)
        return next(looks, [1]), [], []

    monkeypatch.setattr(lines, "time", SimpleNamespace(monotonic=clock))
    monkeypatch.setattr(lines, "select", SimpleNamespace(select=select))
    path = tmp_path / "x.log"
    path.write_text(LINES[0])
    assert len(read(path, timeout_s=1.0)[0]) == 1


def test_stdin_gives_what_has_arrived() -> None:
    program = (
        "from tipforce.host.logs.reader import open_log\nfor block in open_log('-'): print(len(block), flush=True)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for count in (1, 3):
            process.stdin.write("".join(LINES[:count]).encode())
            process.stdin.flush()
            assert int(process.stdout.readline()) == count
        process.stdin.close()
        assert process.wait(10) == 0


START = 1_700_000_000
MESSAGES = [
    can.Message(START + 0.25, 0x285, is_extended_id=False, data=bytes(range(8)), channel=0),
    can.Message(START + 0.5, 0x1234567, data=b"\x07", channel=0),
    can.Message(START + 1.5, 0x181, is_extended_id=False, is_remote_frame=True, dlc=3, channel=0),
    can.Message(START + 2.0, 0x285, is_extended_id=False, is_fd=True, data=bytes(64), channel=0),
]


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".trc", ".log", ".asc.gz"])
def test_what_python_can_writes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    with can.Logger(path) as writer:
        for message in MESSAGES:
            writer(message)
        if suffix == ".db":
            until(writer.buffer.empty)  # type: ignore[attr-defined]  # what is not taken when it is closed may be lost
    frames, log = read(path)
    assert log.bad == {}
    assert log.skipped.get("CAN FD frame") == (None if suffix == ".trc" else 1)  # its writer leaves them out
    expected = [0x285, 0x81234567, 0x40000181]
    if suffix == ".trc":
        expected.pop()  # its writer and its reader do not agree on remote frames
        frames = frames[frames["can_id"] & 0x40000000 == 0]
    assert frames["can_id"].tolist() == expected
    remote_length = 0 if suffix == ".log" else 3  # its writer drops that length
    assert frames["length"].tolist() == [8, 1, remote_length][: len(expected)]
    assert frames["data"][0].tolist() == list(range(8))
    steps = np.diff(frames["t_ns"]) / 1e9
    np.testing.assert_allclose(steps, [0.25, 1.0][: len(steps)], atol=2e-3 if suffix == ".asc.gz" else 1e-3)
    assert not (frames["flags"] & SENT).any()


def test_times_since_the_event_before_and_a_header_without_an_end(tmp_path: Path) -> None:
    path = tmp_path / "x.asc"
    frames = [f" 0.250000 {channel}  285             Rx   d 1 07\n" for channel in (1, 2, "Statistic:", 1)]
    for header, times_ms in (("relative", [250, 500, 1000]), ("absolute", [250, 250, 250])):
        path.write_text(f"base hex timestamps {header}\n{''.join(frames)}")
        found, _ = read(path)
        assert (found["t_ns"] // 10**6).tolist() == times_ms


def test_a_time_that_no_frame_can_have_costs_its_record_alone(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    with can.Logger(path) as writer:
        for t_s in (1.0, float("nan"), 1e300, 2.0):
            writer(can.Message(t_s, 0x285, is_extended_id=False, data=bytes(8)))
    frames, log = read(path)
    assert (frames["t_ns"].tolist(), log.bad) == ([10**9, 2 * 10**9], {"timestamp": 2})


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".mf4", ".trc"])
def test_junk_under_any_name_is_no_traceback(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    random = np.random.default_rng(3)
    for junk in (b"", b"hello\n", bytes(1000), random.bytes(5000), b"1.0 1 285x Rx d 8 00\n1.1 x\n"):
        path.write_bytes(junk)
        with suppress(InputError, EnvironmentLackError):  # asammdf may be missing
            assert len(read(path)[0]) == 0


def test_what_can_not_be_opened(tmp_path: Path) -> None:
    for name in ("missing.log", "missing.blf"):
        with pytest.raises(InputError, match="No such file"):
            open_log(tmp_path / name)
    with pytest.raises(InputError, match="Is a directory"):
        open_log(tmp_path)


def test_kinds(tmp_path: Path) -> None:
    path = tmp_path / "x.blf.GZ"
    path.write_bytes(b"")
    assert log_kind(path) == "messages"
    assert log_kind(LOGS / "crlf.log") == "text"


def test_what_is_read_ahead_is_not_told_ahead(tmp_path: Path) -> None:
    """Interfaces and missing times are known with the block in which they occur; a reader that is left ends."""
    later = "".join(line.replace("can0", "can9") for line in LINES[:10])
    (tmp_path / "a.log").write_bytes(TEXT * 9 + later.encode() + b"  can0  181   [1]  01\n")
    threads = set(threading.enumerate())
    with open_log(tmp_path / "a.log") as log:
        told = [(list(log.channels), log.timed) for _ in log]
    assert told[0] == (["can0", "can1"], True)
    assert told[-1] == (["can0", "can1", "can9"], False)
    with open_log(tmp_path / "a.log") as log:
        next(iter(log))
    assert set(threading.enumerate()) <= threads
