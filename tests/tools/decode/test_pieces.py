"""A large log in pieces, each decoded by a process: the same output, counts and bad lines as in one."""

import argparse
from itertools import pairwise
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.host.decoding import recording
from tipforce.host.decoding.log_part import Piece, Reading, Source
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.logs.lines import line_borders
from tipforce.host.logs.notes import LogNotes
from tipforce_tools.decode import add_arguments, session
from tools.decode.logs import decode, log_lines, rows_of, write_log
from tools.rig import Printed, Streams

PIECE_BYTES = 20_000


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs are cut from 20 kB on, and a piece's start is decided after few frames."""
    monkeypatch.setattr(session, "_LEAST_PIECE_BYTES", PIECE_BYTES)
    monkeypatch.setattr(session, "_PIECE_BYTES", 3 * PIECE_BYTES)
    monkeypatch.setattr(recording, "_STEP_FRAMES", 50)
    monkeypatch.setattr(recording, "_HEAD_FRAMES", 100)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Health of each node in the first block, so that all columns are known there; two buses; losses."""
    lines = log_lines(2000, (1, 5), health=30) + log_lines(600, (2,), seed=3, bus="can1")
    lines.sort(key=lambda line: line.split()[0])
    lines[40:40] = ["(1700000000.000001) vcan0 500##1AABB", "(1700000000.000001) vcan0 181#R"]
    return write_log(tmp_path / "run.log", lines)


def spoil(log: Path, share: float) -> int:
    """Replace a line behind this share of a log by one that is bad; its number."""
    lines = log.read_text().splitlines()
    number = int(share * len(lines))
    lines[number] = "(1700000000.5) vcan0 181#01"
    write_log(log, lines)
    return number + 1


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_the_same_bytes(log: Path, tmp_path: Path, form: str) -> None:
    one, *several = (tmp_path / f"{jobs}.{form}" for jobs in (1, 2, 3))
    for path in (one, *several):
        assert decode(log, "-o", path, "--jobs", path.stem) == 0
    assert one.stat().st_size > 10_000
    for path in several:
        if form == "parquet":  # their row groups differ
            assert pq.read_table(path).equals(pq.read_table(one), check_metadata=True)
        else:
            assert path.read_bytes() == one.read_bytes()


@pytest.mark.parametrize("form", ["csv", "jsonl", "parquet"])
def test_columns_and_buses_that_come_late(tmp_path: Path, form: str) -> None:
    lines = [line for line in log_lines(1500, (1,), seed=4) if " 281#" in line]
    lines += log_lines(900, (2,), health=50, bus="can1")
    log = write_log(tmp_path / "late.log", lines)
    for jobs in (1, 3):
        assert decode(log, "-o", tmp_path / f"{jobs}.{form}", "--jobs", jobs) == 0
    one, several = (table_rows(tmp_path / f"{jobs}.{form}") for jobs in (1, 3))
    assert len(one) > 2000
    assert several == one


def table_rows(path: Path) -> list[dict[str, object]]:
    if path.suffix == ".parquet":
        rows = pq.read_table(path).to_pylist()
    else:
        rows = rows_of(path) if path.suffix == ".csv" else Streams(path.read_text(), "").records
    drop = ("channel",) if path.suffix == ".jsonl" else ()  # a line has it from the second bus on
    return [{k: v for k, v in row.items() if v not in (None, "") and k not in drop} for row in rows]


def test_the_log_is_really_cut(log: Path) -> None:
    def cut(*words: str) -> list[Piece]:
        parser = argparse.ArgumentParser()
        add_arguments(parser)
        return session.pieces_of(parser.parse_args([str(log), "-j", "3", *words]), "csv", [str(log)])

    pieces = cut("-o", "a.csv", "--strict")
    assert len(pieces) > 3
    assert [piece.start for piece in pieces[1:]] == [piece.end for piece in pieces[:-1]]
    for words in (["-o", "a.csv", "--deltas"], ["-o", "a.csv", "--strict", "--json"], ["--strict"], ["-j", "1"]):
        assert cut(*words) == []


def test_the_same_summary_and_notes(log: Path, printed: Printed) -> None:
    spoil(log, 0.9)
    number = spoil(log, 0.6)
    said = [printed(0, f"decode {log} --json --summary --jobs {jobs}") for jobs in (1, 3)]
    assert said[1] == said[0]
    (record,) = said[0].records
    assert sum(record["bad"].values()) == 2
    assert record["lost"] > 0
    assert set(record["skipped"]) == {"CAN FD frame", "remote frame"}
    assert f"line {number}:" in said[0].err


def test_the_same_first_bad_line(log: Path, tmp_path: Path, printed: Printed) -> None:
    spoil(log, 0.95)
    number = spoil(log, 0.7)
    said = []
    for jobs in (1, 3):
        said.append(printed(1, f"decode -q {log} --strict -o {tmp_path}/a[1].csv --jobs {jobs}").err)
        assert [*tmp_path.iterdir()] == [log]
    assert said[1] == said[0]
    assert f"{log}: line {number}:" in said[0]


def test_a_time_range_in_pieces(log: Path, tmp_path: Path) -> None:
    for jobs in (1, 3):
        assert decode(log, "--from", "0.5", "--to", "1.5", "-o", tmp_path / f"{jobs}.csv", "--jobs", jobs) == 0
    assert table_rows(tmp_path / "3.csv") == table_rows(tmp_path / "1.csv")


LINES = st.lists(
    st.sampled_from(
        [
            b"(1700000000.000001) can0 181#0102030405060708", b"(1700000000.000002) can1 281#01", b"", b"what",
            b"(1700000000.000003) can0 500##1AABB", b"x" * 200, b"\xef\xbb\xbf(1700000000.000004) can0 080#",
            b"  can2  181   [2]  01 02", b"(1700000000.000005) can0 181#R\r",
        ]
    ),
    max_size=40,
)  # fmt: skip


@given(LINES, st.integers(1, 9), st.booleans())
@settings(max_examples=150, deadline=None)
def test_any_lines(tmp_path_factory: pytest.TempPathFactory, lines: list[bytes], count: int, ended: bool) -> None:
    log = tmp_path_factory.mktemp("pieces") / "a.log"
    log.write_bytes(b"\n".join(lines) + (b"\n" if ended else b""))
    borders = line_borders(log, count)
    assert (borders[0], borders[-1]) == (0, log.stat().st_size)
    text = log.read_bytes()
    assert all(text[place - 1 : place] == b"\n" for place in borders[1:-1])
    whole, notes = _read(log, [(0, None)])
    pieces, joined = _read(log, list(pairwise(borders)))
    assert pieces == whole
    assert (joined.frames, joined.bad, joined.first_bad, joined.skipped, joined.channels) == (
        notes.frames, notes.bad, notes.first_bad, notes.skipped, notes.channels,
    )  # fmt: skip


def _read(log: Path, ranges: list[tuple[int, int | None]]) -> tuple[list[tuple[object, ...]], LogNotes]:
    found: list[tuple[object, ...]] = []
    notes: list[LogNotes] = []
    for start, end in ranges:
        source = Source(Piece(str(log), start, end), Reading(Layouts()))
        for block in source:
            found += [(source.channels[row["channel"]], *row.tolist()[:3], row["data"].tobytes()) for row in block]
        notes.append(source.copy())
    for more in notes[1:]:
        notes[0].append(more)
    return found, notes[0]
