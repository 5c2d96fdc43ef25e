"""Writers of tables: stdout or a file, in the format of its suffix."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.decoding.sample_table import Column, Table
from tipforce.host.decoding.services import BusEvent
from tipforce.host.frames.frame_array import FrameArray
from tipforce.output_file import CONTACT_TEXT, CSV, JSON_LINES, NewFile
from tipforce.visible_text import visible_lines
from tipforce_tools.decode import text_rows
from tipforce_tools.decode.text_rows import CHANNEL, COUNTER, NODE, TIME

FORMATS = ("text", "csv", "jsonl", "parquet", "mcap")
_SUFFIXES = {
    ".csv": "csv", ".jsonl": "jsonl", ".ndjson": "jsonl", ".json": "jsonl", ".parquet": "parquet", ".pq": "parquet",
    ".mcap": "mcap", ".txt": "text",
}  # fmt: skip
_EXTRAS = {"parquet": ("pyarrow", "parquet"), "mcap": ("mcap", "mcap")}
_COPY_BYTES = 1 << 20


class Writer(Protocol):
    """Write tables; the output is complete after ``close``, and removed after ``abort``."""

    def write(self, table: Table) -> None:
        """Append the rows of a table. Raises OSError."""

    def close(self) -> None:
        """Complete the output. Raises OSError."""

    def abort(self) -> None:
        """Abort: remove partial files."""


class FrameWriter(Writer, Protocol):
    """Keeps the frames and the events, too."""

    def frames(self, frames: FrameArray, channels: Sequence[str]) -> None:
        """Append FRAME (n,); ``channels`` are the interfaces by number. Raises OSError."""

    def events(self, events: Iterable[BusEvent]) -> None:
        """Append EMCYs and changes of NMT states. Raises OSError."""


def format_of(output: str | None, wanted: str | None) -> str:
    """Return the format of an output. Raises InputError for a name without a known suffix."""
    if wanted is not None:
        return wanted
    if output is None or output == "-":
        return "text"
    if is_directory(output):
        return "parquet"
    suffix = Path(output).suffix.lower()
    if suffix not in _SUFFIXES:
        known = ", ".join(sorted(_SUFFIXES))
        raise InputError(f"--output {output}: unknown suffix: allowed are {known}, a name that ends in / "
                         "for a dataset, or --format")  # fmt: skip
    return _SUFFIXES[suffix]


def is_directory(output: str) -> bool:
    """Return whether an output is a directory: a dataset."""
    return output.endswith("/") or Path(output).is_dir()


def open_writer(
    output: str | None,
    kind: str,
    *,
    rate_base: tuple[str, ...] = (COUNTER,),
    inputs: Sequence[str] = (),
) -> Writer:
    """Return a writer. Raises InputError for a path that cannot be written, EnvironmentLackError for a missing library.

    ``rate_base``: the columns after time and node that every table has. ``inputs`` are refused as output.
    """
    if kind in _EXTRAS:
        library, extra = _EXTRAS[kind]
        from importlib.util import find_spec

        if find_spec(library) is None:
            raise EnvironmentLackError(f"{kind} needs {library}: `pip install 'tipforce[{extra}]'`")
        if output is None or output == "-":
            raise InputError(f"--format {kind}: needs --output FILE")
    base = (TIME, NODE, *rate_base)
    if output is None or output == "-":
        return StreamWriter(sys.stdout.buffer, kind, base)
    if kind == "parquet":
        from tipforce_tools.decode import parquet

        return parquet.FileWriter(Path(output), base, inputs)
    if kind == "mcap":
        from tipforce_tools.decode.mcap_file import McapWriter

        return McapWriter(Path(output), inputs)
    if kind == "csv":
        return CsvWriter(Path(output), base, inputs)
    return LinesWriter(Path(output), kind, base, inputs)


class Shape:
    """The columns of an output so far. New ones are appended and empty in earlier rows."""

    def __init__(self, base: tuple[str, ...]) -> None:
        self.base = base
        self.columns: tuple[Column, ...] = ()
        self.channel = ""
        self._begun = False

    def copy(self) -> Shape:
        """Return a shape that grows on its own."""
        found = Shape(self.base)
        found.columns, found.channel, found._begun = self.columns, self.channel, self._begun
        return found

    def fits(self, table: Table) -> bool:
        """Add the columns of a table; return False if there are new ones after the first table."""
        return self.take(table.columns, table.channels)

    def take(self, columns: Iterable[Column], channels: Sequence[str]) -> bool:
        """Add columns of a table with these channels; return as ``fits`` does."""
        known = {column.name for column in self.columns}
        new = tuple(column for column in columns if column.name not in known)
        several = len(channels) > 1 and CHANNEL not in self.base and CHANNEL not in known
        begun, self._begun = self._begun, True
        self.columns += new
        if several and not begun:
            self.base = (self.base[0], CHANNEL, *self.base[1:])
        elif several:
            self.channel = channels[0]
            self.columns += (Column(CHANNEL, CHANNEL, "word", None, "", 0),)
        return not begun or not (new or several)

    def of(self, table: Table) -> Table:
        """Return the table with `channel` among its values, if that column was added later."""
        if not any(column.name == CHANNEL for column in self.columns):
            return table
        names = np.array([name.encode() for name in table.channels])[table.channel]
        column = next(column for column in self.columns if column.name == CHANNEL)
        return replace(table, columns=(*table.columns, column), values={**table.values, CHANNEL: names})


class StreamWriter:
    """Text, CSV or JSON lines on stdout, unbuffered."""

    def __init__(self, stream: BinaryIO, kind: str, base: tuple[str, ...]) -> None:
        self._stream, self._kind = stream, kind
        self._shape = Shape(base)
        self._shown: tuple[Column, ...] | None = None
        self.left_out: set[str] = set()

    def write(self, table: Table) -> None:
        """Append the rows of a table. CSV keeps its first columns: ``left_out`` names the others."""
        self._shape.fits(table)
        self._stream.write(self._text(table))
        self._stream.flush()

    def _text(self, table: Table) -> bytes:
        base = self._shape.base
        if self._kind != "csv":
            if len(table.channels) > 1 and CHANNEL not in base:
                base = (base[0], CHANNEL, *base[1:])
            if self._kind == "jsonl":
                return text_rows.json_rows(table, base)
            return visible_lines(text_rows.people_rows(table, base).decode()).encode()
        start = b""
        if self._shown is None:
            self._shown, start = self._shape.columns, text_rows.csv_header(base, self._shape.columns)
        self.left_out |= {column.name for column in self._shape.columns if column not in self._shown}
        return start + text_rows.csv_rows(table, base, self._shown)

    def close(self) -> None:
        """Do nothing: all output is written."""

    def abort(self) -> None:
        """Do nothing: written output cannot be removed."""


class LinesWriter:
    """JSON lines or text in a file."""

    def __init__(self, path: Path, kind: str, base: tuple[str, ...], inputs: Iterable[str] = ()) -> None:
        """Raises InputError."""
        self._file = NewFile(path, JSON_LINES if kind == "jsonl" else CONTACT_TEXT, inputs)
        self._stream = self._file.partial.open("wb")
        self._lines = StreamWriter(self._stream, kind, base)

    def write(self, table: Table) -> None:
        """Append the rows of a table."""
        self._lines.write(table)

    def close(self) -> None:
        """Complete the file."""
        self._stream.close()
        self._file.keep()

    def abort(self) -> None:
        """Remove the file."""
        _close_quietly(self._stream.close)
        self._file.drop()


class CsvWriter:
    """CSV in a file. For columns added later, earlier rows are written again with empty cells."""

    def __init__(self, path: Path, base: tuple[str, ...], inputs: Iterable[str] = ()) -> None:
        """Raises InputError."""
        self._file = NewFile(path, CSV, inputs)
        self._stream = self._file.partial.open("wb")
        self._shape = Shape(base)
        self._pieces: list[tuple[int, int]] = []  # (offset, number of columns) from there on

    def write(self, table: Table) -> None:
        """Append the rows of a table."""
        first = not self._pieces
        if not self._shape.fits(table) or first:
            if first:
                self._stream.write(text_rows.csv_header(self._shape.base, self._shape.columns))
            self._pieces.append((self._stream.tell(), len(self._shape.columns)))
        self._stream.write(text_rows.csv_rows(self._shape.of(table), self._shape.base, self._shape.columns))

    def close(self) -> None:
        """Complete the file."""
        if not self._pieces:
            self._stream.write(text_rows.csv_header(self._shape.base, ()))
        self._stream.close()
        if len(self._pieces) > 1:
            self._write_again()
        self._file.keep()

    def _write_again(self) -> None:
        wider = self._file.partial.with_suffix(".wide")
        try:
            with wider.open("wb") as new:
                new.write(text_rows.csv_header(self._shape.base, self._shape.columns))
                copy_widened(self._file.partial, self._pieces, self._shape, new)
            wider.replace(self._file.partial)
        finally:
            wider.unlink(missing_ok=True)

    def abort(self) -> None:
        """Remove the file."""
        _close_quietly(self._stream.close)
        self._file.drop()


def copy_widened(part: Path, pieces: Sequence[tuple[int, int]], shape: Shape, out: BinaryIO) -> None:
    """Append rows of a CSV file; ``pieces``: from which offset on they have how many columns."""
    names = [column.name for column in shape.columns]
    ends = [where for where, _ in pieces[1:]] + [None]
    with part.open("rb") as old:
        for (where, count), end in zip(pieces, ends, strict=True):
            fill = "".join(f",{shape.channel if name == CHANNEL else ''}" for name in names[count:]).encode()
            old.seek(where)
            for block in _blocks(old, None if end is None else end - where):
                out.write(block.replace(b"\n", fill + b"\n") if fill else block)


def _blocks(stream: BinaryIO, count: int | None) -> Iterator[bytes]:
    left = count
    while block := stream.read(_COPY_BYTES if left is None else min(_COPY_BYTES, left)):
        left = None if left is None else left - len(block)
        yield block


def _close_quietly(close: Callable[[], Any]) -> None:
    with suppress(OSError):
        close()
