"""Read the CAN frames in an MCAP file: can_msgs/Frame of ROS 2, as ros2_socketcan and `tipforce decode` write them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.errors import EnvironmentLackError, LogError
from tipforce.host.frames.frame_array import PACK_FRAME, FrameArray
from tipforce.host.logs.lines import row_blocks
from tipforce.host.logs.notes import LogNotes
from tipforce.host.logs.unpacking import MOST_CHUNK_BYTES, Expansion, unpacked_chunk

SCHEMA = "can_msgs/msg/Frame"
_HEAD = {0: struct.Struct(">iII"), 1: struct.Struct("<iII")}  # stamp, length of frame_id; by the byte order of CDR
_REST = {0: struct.Struct(">I???B8s"), 1: struct.Struct("<I???B8s")}
_CDR_HEADER = 4


def mcap_blocks(path: Path, notes: LogNotes) -> Iterator[FrameArray]:
    """Yield blocks of frames in the order of the file. A damaged file is noted as bad.

    Raises EnvironmentLackError without the package mcap, LogError for a file that has no CAN frames.
    """
    try:
        from mcap.stream_reader import StreamReader
    except ImportError:
        raise EnvironmentLackError(f"{path} is MCAP: `pip install 'tipforce[mcap]'`") from None
    empty = True
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=MOST_CHUNK_BYTES)
        messages = _messages(reader.records, path)
        for block in row_blocks(path, (_row(path, notes, *message) for message in messages), notes):
            empty = False
            yield block
    if empty and not notes.bad:
        raise LogError(f"{path}: no CAN frames ({SCHEMA}) in it; `tipforce decode run.log -o run.mcap` writes them")


def _messages(records: Iterable[Any], path: Path) -> Iterator[tuple[str, int, bytes]]:
    from mcap.records import Channel, Message, Schema

    schemas: dict[int, str] = {}
    topics: dict[int, str] = {}
    for record in _unpacked(records, path):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            if schemas.get(record.schema_id) == SCHEMA and record.message_encoding == "cdr":
                topics[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in topics:
            yield topics[record.channel_id], record.log_time, record.data


def _unpacked(records: Iterable[Any], path: Path) -> Iterator[Any]:
    """Yield the records in the chunks, too; mcap itself unpacks a chunk to any size."""
    from mcap.records import Chunk
    from mcap.stream_reader import breakup_chunk

    expansion, packed_bytes = Expansion(str(path)), 0
    for record in records:
        if not isinstance(record, Chunk):
            yield record
            continue
        packed_bytes += len(record.data)
        if record.compression:
            content = unpacked_chunk(str(path), record.compression, record.data)
            expansion.take(packed_bytes, len(content))
            yield from breakup_chunk(replace(record, compression="", data=content))
        else:
            yield from breakup_chunk(record)


def _row(path: Path, notes: LogNotes, topic: str, log_time_ns: int, data: bytes) -> bytes:
    """Return one FRAME. Raises struct.error and IndexError for a message that is too short."""
    order = data[1] & 1
    sec, nanosec, size = _HEAD[order].unpack_from(data, _CDR_HEADER)
    start = _CDR_HEADER + _HEAD[order].size
    name = data[start : start + size - 1].decode() or topic
    end = start + size
    can_id, remote, extended, error, length, payload = _REST[order].unpack_from(data, end + -end % 4)
    channel = notes.channel(name, path)
    if channel is None:
        return b""
    can_id |= (EXTENDED_FLAG if extended else 0) | (REMOTE_FLAG if remote else 0) | (ERROR_FLAG if error else 0)
    t_ns = sec * 1_000_000_000 + nanosec
    return PACK_FRAME(t_ns or log_time_ns, can_id, min(length, 8), channel, 0, payload)
