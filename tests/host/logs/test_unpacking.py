"""Packed logs that unpack to more than they may: refused after a bounded number of bytes; real ones are read."""

import gzip
import sqlite3
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import can
import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from tipforce.errors import InputError, LogError
from tipforce.host.frames.frame_array import MAX_CHANNELS
from tipforce.host.logs import captures, lines
from tipforce.host.logs.reader import open_log
from tipforce_tools.cli.main import main

FREE, CHUNK, LINE = 1 << 20, 1 << 20, 1 << 16
PEAK_BYTES = 64 << 20  # one step of zstd is 32 MiB
LINES = b"".join(b"(1700000000.%06d) can0 285#%016X\n" % (k, k * 2654435761) for k in range(20_000))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "FREE_BYTES", FREE)
    monkeypatch.setattr(lines, "MOST_CHUNK_BYTES", CHUNK)
    monkeypatch.setattr(lines, "LONGEST_LINE", LINE)


def gz(data: bytes) -> bytes:
    return gzip.compress(data, 9)


def blf(*contents: bytes, size: int | None = None) -> bytes:
    """A BLF file with a packed container for each content."""
    found = struct.pack("<4sL8xQQLL16x16x", b"LOGG", 144, 0, 0, 0, 0).ljust(144, b"\0")
    for content in contents:
        data = struct.pack("<H6xL4x", 2, len(content)) + zlib.compress(content, 9)
        found += struct.pack("<4sHHLL", b"LOBJ", 16, 1, size or 16 + len(data), 10) + data + bytes(len(data) % 4)
    return found


def blf_object(size: int, kind: int = 1, version: int = 1) -> bytes:
    """An object in a container, which says that it has ``size`` bytes."""
    return struct.pack("<4sHHLL", b"LOBJ", 32, version, size, kind) + bytes(32)


def mcap(path: Path, kind: CompressionType, message: bytes) -> None:
    """An MCAP file with one large message."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1, compression=kind)
        writer.start()
        schema = writer.register_schema(captures.SCHEMA, "ros2msg", b"")
        channel = writer.register_channel("can0", "cdr", schema)
        writer.add_message(channel, 0, message, 0)
        writer.finish()  # type: ignore[no-untyped-call]


def database(path: Path, sql: str) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute(sql)
    connection.close()


ROWS = "WITH RECURSIVE n(k) AS (SELECT 0 UNION ALL SELECT k + 1 FROM n) SELECT k, 5, 0, 0, 0, 1, x'00' FROM n"
COLUMNS = "ts REAL, id INTEGER, ext INTEGER, remote INTEGER, error INTEGER, dlc INTEGER"
BOMB = bytes(24 << 20)
LONG = b"1" * (2 << 20)
RATIO = r"unpack to more than \d+; allowed is 200 times as many, or \d+"
CHUNKS = rf"a chunk of \d+ bytes unpacks to more than {CHUNK}, the limit"
HOSTILE: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "gzip": ("x.log.gz", lambda path: path.write_bytes(gz(BOMB)), RATIO),
    "gzip of lines": ("x.log.gz", lambda path: path.write_bytes(gz(LINES[:34] * 100_000)), RATIO),
    "gzip in parts": ("x.log.gz", lambda path: path.write_bytes(gz(bytes(1 << 19)) * 10), RATIO),
    "zstd": ("x.log.zst", lambda path: path.write_bytes(zstandard.compress(BOMB)), RATIO),
    "zstd in parts": ("x.log", lambda path: path.write_bytes(zstandard.compress(bytes(1 << 19)) * 50), RATIO),
    "gzip of ASC": ("x.asc.gz", lambda path: path.write_bytes(gz(b"// a line\n" * 300_000)), RATIO),
    "gzip of BLF": ("x.blf.gz", lambda path: path.write_bytes(gz(blf() + BOMB)), "object of|unpack to"),
    "container of BLF": ("x.blf", lambda path: path.write_bytes(blf(BOMB)), CHUNKS),
    "containers of BLF": (
        "x.blf", lambda path: path.write_bytes(blf(*[blf_object(1 << 20, 2).ljust(1 << 20, b"\0")] * 5)), RATIO
    ),
    "object of BLF of no bytes": ("x.blf", lambda path: path.write_bytes(blf(blf_object(0))), "an object of 0 bytes"),
    "unknown object of no bytes": (
        "x.blf", lambda path: path.write_bytes(blf(blf_object(0, version=9))), "an object of 0 bytes"
    ),
    "endless object of BLF": (
        "x.blf", lambda path: path.write_bytes(blf(blf_object(0xFFFFFFFF) + bytes(1000))), "4294967295 bytes"
    ),
    "container of no bytes": ("x.blf", lambda path: path.write_bytes(blf(b"", size=1)), "an object of 1 bytes"),
    "long line of ASC": ("x.asc", lambda path: path.write_bytes(LONG), f"a line of more than {LINE}"),
    "long line of CSV": ("x.csv", lambda path: path.write_bytes(LONG), f"a line of more than {LINE}"),
    "long line of TRC": ("x.trc", lambda path: path.write_bytes(LONG), f"a line of more than {LINE}"),
    "view of SQLite": ("x.db", lambda path: database(path, f"CREATE VIEW messages AS {ROWS}"), "messages is a view"),
    "computed column": (
        "x.db", lambda path: database(path, f"CREATE TABLE messages ({COLUMNS}, data BLOB AS (zeroblob(1 << 30)))"),
        "computed columns",
    ),
    "virtual table": (
        "x.db", lambda path: database(path, "CREATE VIRTUAL TABLE messages USING fts5(data)"), "a plain table"
    ),
    "zstd chunk of MCAP": ("x.mcap", lambda path: mcap(path, CompressionType.ZSTD, BOMB), CHUNKS),
    "lz4 chunk of MCAP": ("x.mcap", lambda path: mcap(path, CompressionType.LZ4, BOMB), CHUNKS),
}  # fmt: skip


def read(path: Path) -> None:
    frames = 0
    with open_log(path, strict=True) as log:
        for block in log:
            frames += len(block)
            assert frames < 1_000_000


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_log_is_refused_in_bounded_memory(name: str, tmp_path: Path) -> None:
    file, write, message = HOSTILE[name]
    path = tmp_path / file
    write(path)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message) as refused:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < PEAK_BYTES
    finally:
        tracemalloc.stop()
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("length", "bad"), [(8, {}), (9, {"not CAN": 1})])
def test_a_message_of_mcap_with_more_than_8_bytes_is_bad(length: int, bad: dict[str, int], tmp_path: Path) -> None:
    """can_msgs/Frame has eight bytes for the data of a classic frame."""
    message = struct.pack("<xBxxiII4xI3xB8s", 1, 1, 0, 1, 0x285, length, bytes(range(8)))
    mcap(tmp_path / "x.mcap", CompressionType.NONE, message)
    with open_log(tmp_path / "x.mcap") as log:
        assert [block["length"].tolist() for block in log] == [[8]] * (not bad)
    assert log.bad == bad


def test_a_real_log_is_read_however_it_is_packed(tmp_path: Path) -> None:
    """Lines that differ by a few digits are packed by less than the limit; larger than FREE_BYTES."""
    contents = {"x.log": LINES, "x.log.gz": gz(LINES), "x.zst": zstandard.compress(LINES, 19)}
    assert len(LINES) < FREE < 2 * len(LINES) + FREE
    contents |= {"y.log.gz": gz(LINES * 3), "y.zst": zstandard.compress(LINES * 3, 19)}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with open_log(tmp_path / name, strict=True) as log:
            count = sum(len(block) for block in log)
        assert count == (3 if name.startswith("y") else 1) * 20_000, name
    for kind in ("zlib", "zstd", "lz4"):
        pack = {"zlib": zlib.compress, "zstd": zstandard.compress, "lz4": lz4.frame.compress}[kind]
        assert lines.unpacked_chunk("x", kind, pack(bytes(CHUNK))) == bytes(CHUNK)
        with pytest.raises(LogError, match=CHUNKS):
            lines.unpacked_chunk("x", kind, pack(bytes(CHUNK + 1)))


def test_a_large_blf_is_read_and_of_a_cut_one_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    with can.BLFWriter(path) as writer:
        for k in range(8_000):
            writer(can.Message(1.7e9 + k * 1e-3, 0x181, is_extended_id=False, data=k.to_bytes(8)))
    for content, whole in ((path.read_bytes(), True), (path.read_bytes()[:-9000], False)):
        path.write_bytes(content)
        with open_log(path) as log:
            numbers = np.concatenate([block["data"] for block in log]).view(">u8")[:, 0]
        assert numbers.tolist() == list(range(len(numbers)))
        assert 1000 < len(numbers) <= 8_000
        assert (len(numbers) == 8_000, log.bad) == (whole, {} if whole else {"unreadable": 1})


@pytest.mark.parametrize("interfaces", [MAX_CHANNELS, MAX_CHANNELS + 3])
@pytest.mark.parametrize("output", ["-", "out.csv", "--summary"])
def test_decode_fails_where_interfaces_are_left_out(
    interfaces: int, output: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "run.log"
    log.write_text("".join(f"(1700000000.{k:06d}) c{k} 285#E8030000000003{k % 250:02X}\n" for k in range(interfaces)))
    words = [output] if output == "--summary" else ["-o", output if output == "-" else str(tmp_path / output)]
    code = main(["decode", str(log), *words, "-q"])
    err = capsys.readouterr().err
    if interfaces == MAX_CHANNELS:
        assert (code, err) == (0, "")
    else:
        assert code == 1
        assert "3 frames left out: a log may have 256 interfaces; decode the others apart, as with `grep" in err
