"""Write tables as Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tipforce.host.decoding.sample_table import Column, Table, is_missing
from tipforce.host.decoding.services import NO_TIME, BusEvent
from tipforce_tools.writing.text_rows import BASE, CHANNEL, COUNTER, EVENT_COLUMNS, NODE, TIME, event_rows

if TYPE_CHECKING:
    from tipforce_tools.writing.writers import Shape

ROW_GROUP_ROWS = 1 << 18
_MOST_VALUES = 1 << 14
"""Different values of a column in a row group that are worth a dictionary."""
_TYPES = {
    "real": pa.float64(), "flag": pa.bool_(), "integer": pa.int64(),
    TIME.kind: pa.timestamp("us", tz="UTC"),  # a bit on the bus takes a microsecond; Spark has no finer time
    CHANNEL.kind: pa.string(), NODE.kind: pa.uint8(), COUNTER.kind: pa.int64(),
}  # fmt: skip
_EVENT_TYPES = *(_TYPES[column.kind] for column in (TIME, CHANNEL, NODE)), pa.string(), pa.string(), pa.string()
EVENTS = pa.schema(zip(EVENT_COLUMNS, _EVENT_TYPES, strict=True))


def schema_of(shape: Shape) -> pa.Schema:
    """Return the schema of an output, with units as metadata of the fields."""
    return pa.schema(
        pa.field(column.name, _TYPES[column.kind], metadata={"unit": column.unit} if column.unit else None)
        for column in (*shape.base, *shape.columns)
    )


def arrow_table(table: Table, schema: pa.Schema) -> pa.Table:
    """Return the rows with the columns of ``schema``; missing values are null."""
    columns = {column.name: column for column in (*BASE, *table.columns)}
    arrays = [
        _array(columns[field.name], table, field.type) if field.name in columns else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _array(column: Column, table: Table, kind: Any) -> Any:
    if column == TIME:
        return _as_array(table.t_ns // 1000, kind) if table.timed else pa.nulls(len(table), kind)
    if column == NODE:
        return _as_array(table.node, kind)
    if column == CHANNEL and len(table.channels) == 1:
        return pa.repeat(pa.scalar(table.channels[0], kind), len(table))
    if column == CHANNEL:
        indices = _as_array(table.channel, pa.int32())
        return pa.DictionaryArray.from_arrays(indices, pa.array(table.channels)).cast(kind)
    values = table.counter if column == COUNTER else table.values[column.name]
    missing = is_missing(column, values)
    mask = missing if missing.any() else None
    if column.kind == "flag":
        present = None if mask is None else _bits(~mask)
        return pa.Array.from_buffers(kind, len(values), [present, _bits(values == 1)])
    return _as_array(values, kind, mask)


def _as_array(values: Any, kind: Any, mask: Any = None) -> Any:
    """Wrap numbers without a copy. pyarrow's ``array`` imports pandas if installed, which takes half a second."""
    present = None if mask is None else _bits(~mask)
    # to_pandas_dtype() of the kind would need pandas. A time is its integer.
    code = "f" if pa.types.is_floating(kind) else "u" if pa.types.is_unsigned_integer(kind) else "i"
    values = np.ascontiguousarray(values, dtype=f"{code}{kind.bit_width // 8}")
    return pa.Array.from_buffers(kind, len(values), [present, pa.py_buffer(values)])


def _bits(values: Any) -> Any:
    return pa.py_buffer(np.packbits(values, bitorder="little"))


def events_table(events: Sequence[BusEvent]) -> pa.Table:
    """Return events as the rows of a dataset's file of events."""
    times = (event.t_ns // 1000 if event.t_ns != NO_TIME else None for event in events)
    rows = [(t_us, *row[1:]) for t_us, row in zip(times, event_rows(events), strict=True)]
    columns = zip(*rows, strict=True)
    return pa.table([pa.array(column, kind) for column, kind in zip(columns, EVENTS.types, strict=True)], EVENTS)


def join_widened(paths: Sequence[Path], output: Path, schema: Any, channel: str) -> None:
    """Join files to one with this schema, and remove them; ``channel`` for rows without one. Raises OSError."""
    with _open(output, schema) as writer:
        for path in paths:
            for batch in pq.ParquetFile(path).iter_batches(ROW_GROUP_ROWS):
                writer.write_table(widened(pa.Table.from_batches([batch]), schema, channel))
            path.unlink()


class Parts(AbstractContextManager["Parts"]):
    """One file to write. New columns begin a new part; ``finish`` merges the parts, an error in ``with`` drops them. A
    thread encodes a row group while the next one is gathered: pyarrow does it without the interpreter's lock."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._paths: list[Path] = []
        self._writer: Any = None
        self._waiting: list[Any] = []
        self._rows = 0
        self._thread = ThreadPoolExecutor(1)
        self._encoded: Future[None] | None = None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            with suppress(OSError, pa.ArrowException):
                self._end_part()
            for path in [*self._paths, self.path.with_name(f"{self.path.name}.whole")]:
                path.unlink(missing_ok=True)

    def add(self, rows: Any) -> None:
        """Append rows; they are written in large row groups."""
        if self._waiting and rows.schema != self._waiting[0].schema:
            self._write()
        self._waiting.append(rows)
        self._rows += len(rows)
        if self._rows >= ROW_GROUP_ROWS:
            self._write(whole_groups=True)

    def _write(self, *, whole_groups: bool = False) -> None:
        """Write the pending rows as one block, so that the file does not depend on how the rows arrived."""
        if not self._waiting:
            return
        group = pa.concat_tables(self._waiting)
        count = self._rows // ROW_GROUP_ROWS * ROW_GROUP_ROWS if whole_groups else self._rows
        self._rows -= count
        self._waiting = [group.slice(count)] if self._rows else []
        group = group.slice(0, count).combine_chunks()
        if self._writer is None or group.schema != self._writer.schema:
            self._end_part()
            place = self.path if not self._paths else self.path.with_name(f"{self.path.name}.{len(self._paths)}")
            self._paths.append(place)
            self._writer = _open(place, group.schema)
        self._wait()
        self._encoded = self._thread.submit(self._writer.write_table, group, row_group_size=ROW_GROUP_ROWS)

    def _wait(self) -> None:
        if self._encoded is not None:
            encoded, self._encoded = self._encoded, None
            encoded.result()

    def _end_part(self) -> None:
        self._wait()
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def finish(self, schema: Any, channel: str) -> None:
        """Write the pending rows; merge the parts, with ``channel`` for rows that had only one."""
        self._write()
        complete = self._writer is not None and len(self._paths) == 1 and self._writer.schema == schema
        self._end_part()
        if not complete:
            whole = self.path.with_name(f"{self.path.name}.whole")
            join_widened(self._paths, whole, schema, channel)
            whole.replace(self.path)


def _open(path: Path, schema: Any) -> Any:
    names = set(schema.names)
    # A converter has few different values: their numbers take a third of the bytes that compressed doubles take. Beyond
    # these many, doubles are noise, which costs more time to compress than it saves bytes.
    real = [field.name for field in schema if field.type == _TYPES["real"]]
    return pq.ParquetWriter(
        path, schema, compression={name: "none" if name in real else "snappy" for name in names},
        data_page_size=1 << 20, dictionary_pagesize_limit=_MOST_VALUES * 8,
        use_dictionary=[*(column.name for column in (CHANNEL, NODE) if column.name in names), *real],
        # Increasing values are smaller as differences, and faster to write.
        column_encoding={of.name: "DELTA_BINARY_PACKED" for of in (TIME, COUNTER) if of.name in names},
    )  # fmt: skip


def widened(rows: Any, schema: Any, channel: str) -> Any:
    """Return rows with the columns of ``schema``, null where they have none; ``channel`` for rows without one."""
    if CHANNEL.name in schema.names and CHANNEL.name not in rows.schema.names:
        rows = rows.append_column(CHANNEL.name, pa.repeat(pa.scalar(channel, pa.string()), len(rows)))
    # A file may have a column that a damaged manifest does not name.
    return pa.concat_tables([schema.empty_table(), rows], promote_options="default").select(schema.names)
