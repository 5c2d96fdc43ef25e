"""Join Parquet files of one schema without decoding them: their row groups are copied, and one footer names all: a
FileMetaData of Thrift's compact protocol (parquet.thrift), in which the offsets of the column chunks are moved."""

import io
import os
import struct
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

_BLOCK_BYTES = 1 << 20


def append_bytes(path: Path, start: int, end: int, out: BinaryIO) -> None:
    """Append bytes of a file; where the system can, they do not pass through this process. ``out`` is flushed."""
    with path.open("rb") as file:
        file.seek(start)
        with suppress(AttributeError, OSError):
            while start < end and (count := os.copy_file_range(file.fileno(), out.fileno(), end - start, start)):
                start += count
        if out.seekable():  # not a pipe
            out.seek(0, os.SEEK_END)
        file.seek(start)
        while start < end:
            block = file.read(min(_BLOCK_BYTES, end - start))
            out.write(block)
            start += len(block)


_MAGIC = b"PAR1"
_BINARY, _LIST, _STRUCT = 8, 9, 12
_BOOLEANS = (1, 2)  # true and false: in a struct the type is the value
_INTEGERS = (4, 5, 6)
_BYTES = {1: 1, 2: 1, 3: 1, 7: 8}
"""Sizes of values that are kept as they are: booleans in a list, bytes, doubles."""

Struct = dict[int, tuple[int, Any]]
"""By field: its Thrift type and its value; a list's value is (type, values)."""

# Fields of FileMetaData, RowGroup, ColumnChunk and ColumnMetaData.
_NUM_ROWS, _ROW_GROUPS = 3, 4
_COLUMNS, _GROUP_OFFSET, _ORDINAL = 1, 5, 7
_CHUNK_OFFSET, _META_DATA = 2, 3
_CHUNK_INDEXES = (4, 5, 6, 7)
_PAGE_OFFSETS = (9, 10, 11)
_BLOOM_FILTER = (14, 15)


def join(paths: Sequence[Path], out: BinaryIO) -> None:
    """Write one file with the row groups of all, of equal schema. Raises ValueError for a file that is not Parquet."""
    out.write(_MAGIC)
    whole: Struct | None = None
    groups: list[Struct] = []
    rows = 0
    place = len(_MAGIC)
    for path in paths:
        footer, end = _footer(path)
        out.flush()
        append_bytes(path, len(_MAGIC), end, out)
        for group in footer[_ROW_GROUPS][1][1]:
            _move(group, place - len(_MAGIC), len(groups))
            groups.append(group)
        rows += footer[_NUM_ROWS][1]
        place += end - len(_MAGIC)
        whole = whole or footer
    assert whole is not None
    whole[_NUM_ROWS] = whole[_NUM_ROWS][0], rows
    whole[_ROW_GROUPS] = _LIST, (_STRUCT, groups)
    text = _written(_STRUCT, whole)
    out.write(text + struct.pack("<I", len(text)) + _MAGIC)


def _footer(path: Path) -> tuple[Struct, int]:
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 8, 0))
        length, magic = struct.unpack("<I4s", file.read(8).rjust(8, b"\0"))
        if magic != _MAGIC or length + 12 > size:
            raise ValueError(f"{path}: not a whole Parquet file")
        file.seek(size - 8 - length)
        return _read(io.BytesIO(file.read(length)), _STRUCT), size - 8 - length


def _move(group: Struct, by: int, ordinal: int) -> None:
    """Move the offsets of a row group. Page indexes and Bloom filters, which stay behind, are left out."""
    for chunk in group[_COLUMNS][1][1]:
        _add(chunk, (_CHUNK_OFFSET,), by)
        for index in _CHUNK_INDEXES:
            chunk.pop(index, None)
        meta: Struct = chunk[_META_DATA][1]
        _add(meta, _PAGE_OFFSETS, by)
        for index in _BLOOM_FILTER:
            meta.pop(index, None)
    _add(group, (_GROUP_OFFSET,), by)
    if _ORDINAL in group:
        group[_ORDINAL] = group[_ORDINAL][0], ordinal


def _add(fields: Struct, which: Sequence[int], by: int) -> None:
    for field in which:
        if field in fields and fields[field][1] > 0:  # 0: no such place
            fields[field] = fields[field][0], fields[field][1] + by


def _read_varint(data: BinaryIO) -> int:
    number = shift = 0
    while True:
        byte = data.read(1)[0]
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number
        shift += 7


def _read(data: BinaryIO, kind: int) -> Any:
    if kind in _INTEGERS:
        number = _read_varint(data)
        return number >> 1 ^ -(number & 1)
    if kind == _BINARY:
        return data.read(_read_varint(data))
    if kind == _LIST:
        head = data.read(1)[0]
        count = head >> 4 if head >> 4 < 15 else _read_varint(data)
        return head & 15, [_read(data, head & 15) for _ in range(count)]
    if kind == _STRUCT:
        fields: Struct = {}
        field = 0
        while head := data.read(1)[0]:
            field = field + (head >> 4) if head >> 4 else _read(data, _INTEGERS[0])
            of = head & 15
            fields[field] = of, b"" if of in _BOOLEANS else _read(data, of)
        return fields
    if kind in _BYTES:
        return data.read(_BYTES[kind])
    raise ValueError(f"Thrift type {kind} in a Parquet footer")


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _written(kind: int, value: Any) -> bytes:
    if kind in _INTEGERS:
        return _varint(value << 1 if value >= 0 else (-value << 1) - 1)
    if kind == _BINARY:
        return _varint(len(value)) + bytes(value)
    if kind == _LIST:
        of, values = value
        head = bytes([len(values) << 4 | of]) if len(values) < 15 else bytes([0xF0 | of]) + _varint(len(values))
        return head + b"".join(_written(of, each) for each in values)
    if kind == _STRUCT:
        out, before = bytearray(), 0
        for field, (of, content) in sorted(value.items()):
            step = field - before
            out += bytes([step << 4 | of]) if 0 < step < 16 else bytes([of]) + _written(_INTEGERS[0], field)
            out += _written(of, content)
            before = field
        return bytes(out) + b"\0"
    return bytes(value)
