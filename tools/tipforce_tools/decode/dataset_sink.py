"""Write parts of a recording into a dataset: ``rows/hand=/date=/node=``, one Parquet file each."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.host.dataset.manifest import NO_DATE, ROWS, DataFile
from tipforce.host.dataset.store import FOLDER, Store
from tipforce.host.decoding.sample_table import NODE_BITS, Column, Table
from tipforce_tools.decode.text_rows import CHANNEL, COUNTER, NODE, TIME
from tipforce_tools.decode.writers import Shape

BASE = (TIME, CHANNEL, NODE, COUNTER)
_DAY_NS = 86_400 * 10**9


class FilesOfPart(NamedTuple):
    """The files of one part, and the columns that these have."""

    files: list[DataFile]
    columns: tuple[Column, ...]


class DatasetSink:
    """Writes files whose names contain ``token``, which no other run has. It can be sent to another process."""

    def __init__(self, directory: str, token: str, hand: str | None) -> None:
        """``hand``: value of the first partition; None: the name of the interface."""
        self._directory, self._token, self._hand = directory, token, hand
        self.names: list[str] = []
        """Of the parts by number."""

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> FilesOfPart:
        """Write the rows of a part; each file appears when it is complete."""
        store = Store(self._directory)
        with store.scratch(f"{FOLDER}/{self._token}") as scratch:
            return self._write(store, scratch, number, tables, shape)

    def _write(self, store: Store, scratch: Path, number: int, tables: Iterable[Table], shape: Shape) -> FilesOfPart:
        writing: dict[str, _Open] = {}
        schema: Any = None
        try:
            for table in tables:
                from tipforce_tools.decode.parquet import Parts, arrow_table  # not before there are rows

                shape.fits(table)
                if schema is None or len(schema) + 1 != len(shape.base) + len(shape.columns):
                    schema = rows_schema(shape)
                order, cuts = _partitions(table)
                ordered = replace(table, t_ns=table.t_ns // 1000 * 1000).take(order)  # as the file has it
                rows = arrow_table(ordered, schema)
                for start, end in pairwise(cuts):
                    place = _place(ordered, start, self._hand)
                    if place not in writing:
                        file = scratch / f"{self.names[number]}-{len(writing)}"
                        writing[place] = _Open(file, Parts(file), int(ordered.node[start]))
                    writing[place].add(rows.slice(start, end - start), ordered.t_ns[start:end])
            return FilesOfPart([one.kept(store, place, self.names[number], shape) for place, one in writing.items()],
                               shape.columns)  # fmt: skip
        except BaseException:
            for one in writing.values():
                one.parts.abort()
            raise


def rows_schema(shape: Shape) -> Any:
    """Return the schema of a file of rows: the node stands in its path."""
    from tipforce_tools.decode.parquet import schema_of

    schema = schema_of(shape)
    return schema.remove(schema.get_field_index(NODE))


def put_file(store: Store, file: Path, path: str) -> tuple[int, str]:
    """Move a complete file into a dataset; return its size in bytes and its SHA-256. Raises OSError."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    size = os.path.getsize(file)
    store.put(file, path)
    return size, digest


class _Open:
    """One file being written."""

    def __init__(self, file: Path, parts: object, node: int) -> None:
        from tipforce_tools.decode.parquet import Parts

        assert isinstance(parts, Parts)
        self.file, self.parts, self.node = file, parts, node
        self.rows = 0
        self.first_ns, self.last_ns = np.iinfo(np.int64).max, np.iinfo(np.int64).min

    def add(self, rows: Any, t_ns: npt.NDArray[np.int64]) -> None:
        """Append rows with these times."""
        self.rows += len(rows)
        self.first_ns, self.last_ns = min(self.first_ns, int(t_ns.min())), max(self.last_ns, int(t_ns.max()))
        self.parts.add(rows)

    def kept(self, store: Store, place: str, name: str, shape: Shape) -> DataFile:
        """Complete the file and give it its name."""
        self.parts.finish(rows_schema(shape), shape.channel)
        size, digest = put_file(store, self.file, path := f"{place}/{name}.parquet")
        return DataFile(path, self.node, self.rows, size, digest, self.first_ns, self.last_ns)


def _partitions(table: Table) -> tuple[npt.NDArray[np.intp], list[int]]:
    """Return the order of rows by node and day, and where each of these begins and the last one ends."""
    day = table.t_ns // _DAY_NS if table.timed else np.zeros(len(table), dtype=np.int64)
    order = np.argsort(table.key, kind="stable") if (day == day[0]).all() else np.lexsort((day, table.key))
    key, day = table.key[order], day[order]
    cuts = np.flatnonzero((key[1:] != key[:-1]) | (day[1:] != day[:-1])) + 1
    return order, [0, *cuts.tolist(), len(key)]


def _place(table: Table, row: int, hand: str | None) -> str:
    key = int(table.key[row])
    date = str(np.datetime64(int(table.t_ns[row]), "ns"))[:10] if table.timed else NO_DATE
    hand = _folder(hand or table.channels[key >> NODE_BITS])
    return f"{ROWS}/hand={hand}/date={date}/node={key & (1 << NODE_BITS) - 1}"


def _folder(name: str) -> str:
    """Return a name without characters that a path or a partition cannot have."""
    return "".join(mark if mark.isalnum() or mark in "-_." else "_" for mark in name) or "_"
