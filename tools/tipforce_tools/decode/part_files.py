"""Write parts of a recording as temporary files, and join these to one output: CSV, JSON lines or Parquet."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from tipforce.host.decoding.sample_table import Table
from tipforce.output_file import NewFile
from tipforce_tools.decode import parquet_join, text_rows
from tipforce_tools.decode.parquet_join import append_bytes
from tipforce_tools.decode.writers import KINDS, Shape, copy_widened, lines_of

Pieces = list[tuple[int, int]]
"""From which byte of a part on rows have how many columns."""


class PartFile:
    """Writes a part beside the output, in its format."""

    def __init__(self, output: Path, kind: str) -> None:
        self._output, self._kind = output, kind

    def path(self, number: int) -> Path:
        """Return the file of a part."""
        return self._output.with_name(f"{self._output.name}.{number}")

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> Pieces:
        """Write the rows."""
        if self._kind == "parquet":
            from tipforce_tools.decode import parquet

            parquet.write_part(self.path(number), tables, shape)
            return [(0, len(shape.columns))]
        pieces: Pieces = []
        with self.path(number).open("wb") as file:
            for table in tables:
                if not shape.fits(table) or not pieces:
                    pieces.append((file.tell(), len(shape.columns)))
                if self._kind == "csv":
                    file.write(text_rows.csv_rows(shape.of(table), shape.base, shape.columns))
                else:
                    file.write(lines_of(table, self._kind, shape.base))
        return pieces


class JoinedFile:
    """One output from the files of its parts, which come in order."""

    def __init__(self, path: Path, kind: str, shape: Shape, inputs: Iterable[str] = ()) -> None:
        """Raises InputError."""
        self._file = NewFile(path, KINDS[kind], inputs)
        self._kind, self._shape = kind, shape
        self._beside = self._file.partial.absolute()
        if self._file.partial == path:  # a device or a pipe
            import tempfile

            self._beside = Path(tempfile.gettempdir(), f".{path.name}.{os.getpid()}.part")
        self.sink = PartFile(self._beside, kind)
        self._parts: list[tuple[Path, Pieces]] = []

    def add(self, number: int, pieces: Pieces, shape: Shape) -> None:
        """Take the next part; ``shape``: its columns, and those of the parts in front."""
        self._shape = shape
        self._parts.append((self.sink.path(number), pieces))
        if self._kind == "jsonl":
            with self._file.partial.open("ab") as out:
                self._append(*self._parts.pop(), out)

    def close(self) -> None:
        """Complete the output."""
        if self._kind == "parquet":
            self._join_parquet()
        elif self._kind == "csv":
            with self._file.partial.open("wb") as out:
                out.write(text_rows.csv_header(self._shape.base, self._shape.columns))
                out.flush()
                for part in self._parts:
                    self._append(*part, out)
        self._file.keep()

    def _join_parquet(self) -> None:
        paths = [path for path, _ in self._parts]
        if any(self._is_narrow(pieces) for _, pieces in self._parts):
            from tipforce_tools.decode import parquet  # its import costs time

            parquet.join_widened(paths, self._file.partial, self._shape)
            return
        with self._file.partial.open("wb") as out:
            parquet_join.join(paths, out, append_bytes)
        for path in paths:
            path.unlink()

    def _is_narrow(self, pieces: Pieces) -> bool:
        return any(count < len(self._shape.columns) for _, count in pieces)

    def _append(self, path: Path, pieces: Pieces, out: BinaryIO) -> None:
        if self._kind == "csv" and self._is_narrow(pieces):
            copy_widened(path, pieces, self._shape, out)
        else:
            out.flush()
            append_bytes(path, 0, path.stat().st_size, out)
        path.unlink()

    def abort(self) -> None:
        """Remove the output and the files of its parts."""
        self._file.drop()
        for path in self._beside.parent.glob(f"{self._beside.name}.*"):
            path.unlink()
