"""Formats of outputs, the columns of an output, and the writers of rows in one stream, and in a file of parts."""

import glob
import os
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO

from canopen_device.visible_text import visible_lines
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.dataset.reader import need_pyarrow
from tipforce.host.decoding.sample_table import Column, Table
from tipforce.output_file import CONTACT_TEXT, CSV, JSON_LINES, MCAP, PARQUET, NewFile
from tipforce_tools.writing import parquet_join, text_rows
from tipforce_tools.writing.text_rows import CHANNEL

_SUFFIXES = {
    ".csv": "csv", ".jsonl": "jsonl", ".ndjson": "jsonl", ".json": "jsonl", ".parquet": "parquet", ".pq": "parquet",
    ".mcap": "mcap", ".txt": "text",
}  # fmt: skip
_LIBRARIES = {"parquet": "pyarrow", "mcap": "mcap"}
KINDS = {"csv": CSV, "jsonl": JSON_LINES, "text": CONTACT_TEXT, "parquet": PARQUET, "mcap": MCAP}
_COPY_BYTES = 1 << 20


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
        known = f"{', '.join(sorted(_SUFFIXES))}, a name that ends in / for a dataset, or --format"
        raise InputError(f"--output {output}: unknown suffix: allowed are {known}")
    return _SUFFIXES[suffix]


def is_directory(output: str) -> bool:
    """Return whether an output is a directory: a dataset."""
    return output.endswith("/") or Path(output).is_dir()


def check_format(output: str | None, kind: str) -> None:
    """Raise EnvironmentLackError for a missing library, InputError for a format that needs a file."""
    if kind in _LIBRARIES:
        if find_spec(_LIBRARIES[kind]) is None:
            raise EnvironmentLackError(f"{kind} needs {_LIBRARIES[kind]}: `pip install 'tipforce[{kind}]'`")
        if output in {None, "-"}:
            raise InputError(f"--format {kind}: needs --output FILE")
        if kind == "parquet":
            need_pyarrow(str(output))


class Shape:
    """The columns of an output so far. New ones are appended and empty in earlier rows."""

    def __init__(self, base: tuple[Column, ...]) -> None:
        self.base = base
        self.columns: tuple[Column, ...] = ()
        """After ``base``; CHANNEL among them where a second interface came late."""
        self.channel = ""
        """Of the rows before it."""
        self._begun = False

    def take(self, columns: Iterable[Column], channels: Sequence[str]) -> bool:
        """Add columns of a table with these channels; return False if there are new ones after the first table."""
        known = {column.name for column in self.columns}
        new = tuple(column for column in columns if column.name not in known)
        several = len(channels) > 1 and CHANNEL not in self.base and CHANNEL.name not in known
        begun, self._begun = self._begun, True
        self.columns += new
        if several and not begun:
            self.base = (self.base[0], CHANNEL, *self.base[1:])
        elif several:
            self.channel = channels[0]
            self.columns += (CHANNEL,)
        return not begun or not (new or several)


def lines_of(table: Table, kind: str, base: tuple[Column, ...], columns: tuple[Column, ...]) -> bytes:
    """Format CSV with these columns, or JSON lines or text, with the channel where there are several."""
    if kind == "csv":
        return text_rows.csv_rows(table, (*base, *columns))
    if len(table.channels) > 1 and CHANNEL not in base:
        base = (base[0], CHANNEL, *base[1:])
    if kind == "jsonl":
        return text_rows.json_rows(table, base)
    return visible_lines(text_rows.people_rows(table, base).decode()).encode()


class StreamWriter:
    """Text, CSV or JSON lines in a stream, each table at once."""

    def __init__(self, stream: BinaryIO, kind: str, base: tuple[Column, ...]) -> None:
        self._stream, self._kind, self._shape = stream, kind, Shape(base)
        self._shown: tuple[Column, ...] | None = None
        self.left_out: set[str] = set()

    def write(self, table: Table) -> None:
        """Append the rows of a table. CSV keeps its first columns: ``left_out`` names the others. Raises OSError."""
        shape, is_csv = self._shape, self._kind == "csv"
        shape.take(table.columns, table.channels)
        header = text_rows.csv_header((*shape.base, *shape.columns)) if is_csv and self._shown is None else b""
        self._shown = shape.columns if self._shown is None else self._shown
        self._stream.write(header + lines_of(table, self._kind, shape.base, self._shown))
        self._stream.flush()
        if is_csv:
            self.left_out |= {column.name for column in shape.columns if column not in self._shown}


Pieces = list[tuple[int, int]]
"""From which byte of a part on rows have how many columns."""


class JoinedFile(AbstractContextManager["JoinedFile"]):
    """One output from the files of its parts, in order, which any process may write; a ``with`` block joins them."""

    def __init__(self, file: NewFile, kind: str, shape: Shape) -> None:
        self._partial, self._kind, self._shape = file.partial, kind, shape
        self._renamed = file.partial != file.path
        self._beside = file.partial.absolute()
        if not self._renamed:  # a pipe: not beside it
            import tempfile

            self._beside = Path(tempfile.gettempdir(), f".{file.path.name}.{os.getpid()}.part")
        self._parts: list[Pieces] = []
        self._added = 0

    def _path(self, number: int) -> Path:
        return self._beside.with_name(f"{self._beside.name}.{number}")

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> Pieces:
        """Write the rows of a part beside the output, in its format."""
        if self._kind == "parquet":
            from tipforce_tools.writing import parquet

            with parquet.Parts(self._path(number)) as parts:
                for table in tables:
                    shape.take(table.columns, table.channels)
                    parts.add(parquet.arrow_table(table, parquet.schema_of(shape)))
                parts.finish(parquet.schema_of(shape), shape.channel)
            return [(0, len(shape.columns))]
        pieces: Pieces = []
        with self._path(number).open("wb") as file:
            for table in tables:
                if (not shape.take(table.columns, table.channels) and self._kind == "csv") or not pieces:
                    if self._kind == "csv" and not pieces and number == 0:  # the header, if this is the whole file
                        file.write(text_rows.csv_header((*shape.base, *shape.columns)))
                    pieces.append((file.tell(), len(shape.columns)))
                file.write(lines_of(table, self._kind, shape.base, shape.columns))
        return pieces

    def add(self, pieces: Pieces, shape: Shape) -> None:
        """Take the next part; ``shape``: its columns, and those of the parts in front. Lines go behind those of the
        first part at once, while other parts are written."""
        self._shape = shape
        if self._added and self._kind != "parquet":
            path = self._path(self._added)
            with self._path(0).open("r+b") as out:
                start = out.seek(0, os.SEEK_END)
                if self._kind == "csv" and pieces and not start:
                    start = out.write(text_rows.csv_header((*shape.base, *shape.columns)))
                    out.flush()
                parquet_join.append_bytes(path, 0, path.stat().st_size, out)
            path.unlink()
            self._parts[0] += [(start + at, width) for at, width in pieces]
        else:
            self._parts.append(pieces)
        self._added += 1

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Join the parts, unless an error occurred, and remove them. Raises OSError."""
        try:
            if kind is None:
                self._join([self._path(number) for number in range(len(self._parts))])
        finally:
            for path in self._beside.parent.glob(f"{glob.escape(self._beside.name)}.*"):
                path.unlink()

    def _join(self, paths: list[Path]) -> None:
        shape, widths = self._shape, [width for pieces in self._parts for _, width in pieces]
        if len(paths) == 1 and (self._kind == "jsonl" or {*widths} == {len(shape.columns)}) and self._renamed:
            self._partial.unlink()  # ext4 writes a file to the disk that replaces another
            paths[0].rename(self._partial)
        elif self._kind == "parquet" and min(widths) < len(shape.columns):
            from tipforce_tools.writing import parquet  # its import costs time

            parquet.join_widened(paths, self._partial, parquet.schema_of(shape), shape.channel)
        else:
            with self._partial.open("wb") as out:
                if self._kind == "parquet":
                    parquet_join.join(paths, out)
                    return
                if self._kind == "csv":
                    out.write(text_rows.csv_header((*shape.base, *shape.columns)))
                self._append(paths[0], self._parts[0], out)

    def _append(self, path: Path, pieces: Pieces, out: BinaryIO) -> None:
        """Append the rows of a part; those of CSV with empty cells for columns that came later."""
        ends = [start for start, _ in pieces[1:]] + [path.stat().st_size]
        for (start, count), end in zip(pieces, ends, strict=False):  # a part without rows has no pieces
            later = self._shape.columns[count:] if self._kind == "csv" else ()
            fill = "".join(f",{self._shape.channel if one == CHANNEL else ''}" for one in later).encode()
            out.flush()
            if not fill:
                parquet_join.append_bytes(path, start, end, out)
                continue
            with path.open("rb") as rows:
                rows.seek(start)
                for at in range(start, end, _COPY_BYTES):
                    out.write(rows.read(min(_COPY_BYTES, end - at)).replace(b"\n", fill + b"\n"))
