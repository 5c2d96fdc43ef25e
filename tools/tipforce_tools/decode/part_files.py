"""Write parts of a recording as temporary files, and join these to one output: CSV, JSON lines or Parquet."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import BinaryIO

from tipforce.host.decoding.sample_table import Table
from tipforce.output_file import CSV, JSON_LINES, PARQUET, NewFile
from tipforce_tools.decode import text_rows
from tipforce_tools.decode.files import append_bytes
from tipforce_tools.decode.parts import Written
from tipforce_tools.decode.writers import Shape, copy_widened

KINDS = {"csv": CSV, "jsonl": JSON_LINES, "parquet": PARQUET}


class PartFile:
    """Writes part ``number`` beside the output, in its format; the record are the pieces of a CSV."""

    def __init__(self, output: Path, kind: str) -> None:
        self._output, self._kind = output, kind

    def path(self, number: int) -> Path:
        """Return the file of a part."""
        return self._output.with_name(f"{self._output.name}.{number}")

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> list[tuple[int, int]]:
        """Write the rows."""
        if self._kind == "parquet":
            from tipforce_tools.decode import parquet

            parquet.write_part(self.path(number), tables, shape)
            return []
        pieces: list[tuple[int, int]] = []
        with self.path(number).open("wb") as file:
            for table in tables:
                if not shape.fits(table) or not pieces:
                    pieces.append((file.tell(), len(shape.columns)))
                if self._kind == "csv":
                    file.write(text_rows.csv_rows(shape.of(table), shape.base, shape.columns))
                else:
                    file.write(text_rows.json_rows(table, _json_base(table, shape)))
        return pieces


def _json_base(table: Table, shape: Shape) -> tuple[str, ...]:
    several = len(table.channels) > 1 and text_rows.CHANNEL not in shape.base
    return (shape.base[0], text_rows.CHANNEL, *shape.base[1:]) if several else shape.base


class JoinedFile:
    """One output from the files of its parts, which come in order."""

    def __init__(self, path: Path, kind: str, shape: Shape, inputs: Iterable[str] = ()) -> None:
        """Raises InputError."""
        self._file = NewFile(path, KINDS[kind], inputs)
        self._kind, self._shape = kind, shape
        self.sink = PartFile(self._file.partial.absolute(), kind)
        self._parts: list[Written] = []

    def add(self, part: Written) -> None:
        """Take the next part."""
        self._shape = part.shape
        self._parts.append(part)
        if self._kind == "jsonl":
            with self._file.partial.open("ab") as out:
                self._append(part, out)

    def close(self) -> None:
        """Complete the output."""
        if self._kind == "parquet":
            from tipforce_tools.decode import parquet

            paths = [self.sink.path(part.number) for part in self._parts]
            parquet.join(paths, self._file.partial, self._shape)
        elif self._kind == "csv":
            with self._file.partial.open("wb") as out:
                out.write(text_rows.csv_header(self._shape.base, self._shape.columns))
                out.flush()
                for part in self._parts:
                    self._append(part, out)
        self._file.keep()

    def _append(self, part: Written, out: BinaryIO) -> None:
        path = self.sink.path(part.number)
        pieces: Sequence[tuple[int, int]] = part.record
        if self._kind == "csv" and any(count < len(self._shape.columns) for _, count in pieces):
            copy_widened(path, pieces, self._shape, out)
        else:
            out.flush()
            append_bytes(path, 0, path.stat().st_size, out)
        path.unlink()

    def abort(self) -> None:
        """Remove the output and the files of its parts."""
        self._file.drop()
        for path in self._file.partial.parent.glob(f"{self._file.partial.name}.*"):
            path.unlink()
