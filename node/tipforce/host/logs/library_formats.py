"""Read every log format that python-can reads (ASC, BLF, TRC, CSV, MF4, SQLite) as blocks of frames."""

import re
import sqlite3
import struct
from collections.abc import Generator, Iterator
from contextlib import closing
from decimal import Decimal
from functools import partial
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import Any

import can

from tipforce.errors import EnvironmentLackError, LogError, TipforceError
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame, packed
from tipforce.host.logs.lines import BoundedLines, Expansion, decompressed, open_file, row_blocks, unpacked_chunk
from tipforce.host.logs.notes import FD, UNREADABLE, LogNotes, suffix_of

_OBJECT = struct.Struct("<4sHHII")  # of BLF: signature, length of the header, version, length, type
_CONTAINER, _CONTAINER_HEAD = 10, 16
_LONGEST_OBJECT = 1 << 20
_ASC_BASE = re.compile(r"\s*base\s+(?:hex|dec)(\s+timestamps\s+relative)?", re.IGNORECASE)
_ASC_TIME = re.compile(r"\s*(\d+\.\d+)(?=\s)", re.ASCII)
_COMPUTED = re.compile(r"\bAS\s*\(|\bVIRTUAL\b", re.IGNORECASE)


def message_blocks(path: Path, notes: LogNotes) -> Iterator[CandumpBlock]:
    """Yield blocks of at most BLOCK_ROWS frames. A truncated log is noted as bad. Raises LogError for a file that is
    not of the format in its name, EnvironmentLackError for a missing package."""
    try:
        reader = message_reader(path)
    except NotImplementedError as error:  # python-can names the package
        raise EnvironmentLackError(f"{path}: {error}; for .mf4: pip install asammdf") from error
    except TipforceError:
        raise
    except Exception as error:  # readers raise various exceptions for a damaged file
        raise LogError(
            f"{path}: can't be read as {path.suffix}: {error or type(error).__name__}; the file is damaged or of "
            "another format"
        ) from error
    messages = iter(reader)
    empty = True
    try:
        for block in row_blocks(path, map(partial(_row, path, notes), messages), notes):
            empty = False
            yield block
        if empty and not notes.bad and not notes.skipped:
            notes.note_bad(UNREADABLE, f"{path}: no message in it, or damaged")
    finally:
        reader.stop()


def message_reader(path: Path) -> Any:
    """Return python-can's reader of a file that unpacks within limits: what it gets are bounded lines or containers."""
    suffix, _ = suffix_of(path)
    kind = {".asc": can.ASCReader, ".csv": can.CSVReader, ".trc": can.TRCReader}.get(suffix)
    if suffix == ".db":
        _check_table(path)
    if kind is None and suffix != ".blf":
        return can.LogReader(path)
    file = open_file(path)
    try:
        source: Any = decompressed(file, str(path))
        if kind is None:
            return _BlfReader(BufferedReader(source), path)
        lines = BufferedReader(BoundedLines(source, file, str(path)))
        if suffix == ".asc":
            return kind(_AscText(lines, "utf-8", "replace"), relative_timestamp=False)
        return kind(TextIOWrapper(lines, "utf-8", "replace"))
    except BaseException:
        file.close()
        raise


class _AscText(TextIOWrapper):
    """The lines of an ASC file with times since its start. python-can takes times since the event before ("timestamps
    relative") for them, and discards the line that ends the header, even a frame: here an empty line ends it."""

    _next, _in_header, _relative, _time_s = "", False, False, Decimal(0)

    def __next__(self) -> str:  # type: ignore[override]
        line, self._next = self._next or super().__next__(), ""
        if base := _ASC_BASE.match(line):
            self._in_header, self._relative = True, base[1] is not None
        elif (self._in_header or self._relative) and (stamp := _ASC_TIME.match(line)):
            if self._in_header:
                self._in_header, self._next = False, line
                return "\n"
            self._time_s += Decimal(stamp[1])
            line = f"{self._time_s}{line[stamp.end() :]}"
        return line


def _check_table(path: Path) -> None:
    """Raise LogError for an SQLite file whose table of messages is computed: few bytes could be rows without end."""
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
        found = connection.execute("SELECT type, sql FROM sqlite_master WHERE name = 'messages'").fetchall()
    if any(kind != "table" or _COMPUTED.search(sql or "") for kind, sql in found):
        raise LogError(f"{path}: messages is a view, or has computed columns: allowed is a plain table")


class _BlfReader(can.BLFReader):
    """python-can's reader, which unpacks a container to any size, and never ends at an object of 0 bytes."""

    def __init__(self, file: BufferedReader, path: Path) -> None:
        super().__init__(file)
        self._place = str(path)

    def __iter__(self) -> Generator[can.Message, None, None]:
        expansion, packed_bytes = Expansion(self._place), 0
        while head := self.file.read(_OBJECT.size):
            signature, _, _, size, kind = _OBJECT.unpack(head)
            if signature != b"LOBJ" or size < _OBJECT.size:
                raise ValueError(f"an object of {size} bytes with the signature {signature!r}")
            data = self.file.read(size - _OBJECT.size)
            self.file.read(size % 4)
            packed_bytes += len(data)
            if kind != _CONTAINER:
                continue
            method, content = int.from_bytes(data[:2], "little"), data[_CONTAINER_HEAD:]
            if method:
                content = unpacked_chunk(self._place, "zlib", content)
                expansion.take(packed_bytes, len(content))
            self._check_objects(self._tail + content)
            yield from self._parse_container(content)
            if len(data) < size - _OBJECT.size:
                raise EOFError(f"an object of {size} bytes has {_OBJECT.size + len(data)}")
        self.stop()

    def _check_objects(self, data: bytes) -> None:
        place = 0
        while (place := data.find(b"LOBJ", place, place + 8)) >= 0 and place + _OBJECT.size <= len(data):
            size = _OBJECT.unpack_from(data, place)[3]
            if not _OBJECT.size <= size <= _LONGEST_OBJECT:
                raise ValueError(f"an object of {size} bytes: allowed are {_OBJECT.size} to {_LONGEST_OBJECT}")
            place += size


_LATEST_S = 9e9  # the nanoseconds of a frame have 63 bits


def _row(path: Path, notes: LogNotes, message: can.Message) -> bytes | FdFrame:
    name = "can" if message.channel is None else str(message.channel)
    channel = notes.channel(f"can{name}" if name.isdecimal() else name, path)
    if channel is None:
        return b""
    if not abs(message.timestamp) < _LATEST_S:
        notes.note_bad("timestamp", f"{path}: a timestamp of {message.timestamp:g} s: allowed is below {_LATEST_S:g}")
        return b""
    # A float has no nanosecond resolution for present times: digits below a microsecond are noise.
    row = packed(message, round(message.timestamp * 1e6) * 1000, channel)
    if isinstance(row, FdFrame):
        notes.skip(FD)
    return row
