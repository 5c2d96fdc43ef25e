"""Read CAN frames from captures: pcap, pcapng (drafts of the IETF opsawg), and MCAP (can_msgs/Frame). Link types: 227
(SocketCAN, CAN ID in network byte order), and Linux' cooked captures 113 and 276 with protocols 000Ch (CAN) and 000Dh
(CAN FD); the interfaces of 276 are named by their index: if3."""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.errors import InputError, LogError, needing
from tipforce.host.frames.frame_array import PACK_FRAME
from tipforce.host.frames.frame_block import BIT_RATE_SWITCH, ERROR_STATE, CandumpBlock, FdFrame
from tipforce.host.logs.lines import MOST_CHUNK_BYTES, Expansion, open_file, row_blocks, unpacked_chunk
from tipforce.host.logs.notes import FD, LogNotes

SOCKETCAN, COOKED, COOKED_2 = 227, 113, 276
_CAN, _CAN_FD = 0x000C, 0x000D
_FD_FLAG = 0x04  # CANFD_FDF in the byte after the length
_FD_BYTES = 72
_SECTION, _INTERFACE, _SIMPLE = 0x0A0D0D0A, 1, 3
_PACKETS = {2: "H2xIIII", 6: "IIIII"}  # the block of older files, and the enhanced one
_BYTE_ORDER_MAGIC = 0x1A2B3C4D
_NAME_OPTION, _RESOLUTION_OPTION, _OFFSET_OPTION = 2, 9, 14
_LONGEST_BLOCK = 1 << 20
_SOCKETCAN_HEAD = struct.Struct(">IBB")
_UNIT_OF_MAGIC = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}  # ns per unit of the fraction


class _Interface(NamedTuple):
    link: int
    channel: int
    ticks_per_s: int
    offset_ns: int = 0


_File: TypeAlias = "BufferedReader[FileIO]"
_Packet = tuple[int, _Interface, bytes]  # t_ns


def pcap_blocks(path: Path, notes: LogNotes) -> Iterator[CandumpBlock]:
    """Yield blocks of frames; other packets and a truncated file are noted as bad. Raises InputError for the file."""
    with BufferedReader(open_file(path)) as file:
        magic = int.from_bytes(file.peek(4)[:4], "little")
        order = "<" if magic in _UNIT_OF_MAGIC else ">"
        packets = _pcapng(file, path, notes) if magic == _SECTION else _pcap(file, order, path, notes)
        yield from row_blocks(path, (_packet_row(packet, path, notes) for packet in packets), notes)


def _packet_row(packet: _Packet, path: Path, notes: LogNotes) -> bytes | FdFrame:
    t_ns, interface, data = packet
    is_fd, is_can, channel = False, interface.link == SOCKETCAN, interface.channel
    if interface.link in {COOKED, COOKED_2}:
        start, size = (14, 16) if interface.link == COOKED else (0, 20)
        protocol = int.from_bytes(data[start : start + 2], "big")
        if start == 0 and protocol in {_CAN, _CAN_FD}:  # of any interface: its index is in the packet
            channel = _channel(f"if{int.from_bytes(data[4:8], 'big')}", path, notes)
        data, is_fd, is_can = data[size:], protocol == _CAN_FD, protocol in {_CAN, _CAN_FD}
    if is_can and len(data) >= 8:
        can_id, length, flags = _SOCKETCAN_HEAD.unpack_from(data)
        if is_fd or flags & _FD_FLAG or len(data) == _FD_BYTES:
            notes.skip(FD)
            data = data[8 : 8 + min(length, 64)]
            return FdFrame(0, t_ns, can_id, flags & (BIT_RATE_SWITCH | ERROR_STATE), data, channel, False)
        carried = 0 if can_id & REMOTE_FLAG else length
        payload = data[8 : 8 + carried]
        if length <= 8 and len(payload) == carried and 0 <= t_ns < 1 << 63:
            return PACK_FRAME(t_ns, can_id, length, channel, 0, payload)
    notes.note_bad("not CAN", f"{path}: a packet that is cut, or not a CAN frame (link type {interface.link})")
    return b""


def _pcap(file: _File, order: str, path: Path, notes: LogNotes) -> Iterator[_Packet]:
    magic, _, _, _, _, _, link = struct.unpack(f"{order}IHHiIII", _exactly(file, 24))
    unit = _UNIT_OF_MAGIC[magic]
    interface = _Interface(link & 0x0FFFFFFF, _channel("can", path, notes, link), 1_000_000_000 // unit)
    head = struct.Struct(f"{order}IIII")
    while file.peek(1):
        seconds, fraction, length, _ = head.unpack(_exactly(file, head.size))
        yield seconds * 1_000_000_000 + fraction * unit, interface, _exactly(file, length)


def _pcapng(file: _File, path: Path, notes: LogNotes) -> Iterator[_Packet]:
    order = "<"
    interfaces: list[_Interface] = []
    while file.peek(1):
        head = _exactly(file, 8)
        if int.from_bytes(head[:4], "little") == _SECTION:
            magic = file.peek(4)[:4]
            order = "<" if int.from_bytes(magic, "little") == _BYTE_ORDER_MAGIC else ">"
            interfaces = []
        kind, length = struct.unpack(f"{order}II", head)
        if length < 12 or length % 4:
            raise ValueError(f"a block of {length} bytes")
        body = _exactly(file, length - 8)[:-4]
        if kind == _INTERFACE:
            unnamed = f"if{len(interfaces)}" if interfaces else "can"
            interfaces.append(_interface(body, order, unnamed, path, notes))
        elif kind in _PACKETS:
            number, high, low, captured, _ = struct.unpack_from(order + _PACKETS[kind], body)
            if number >= len(interfaces):
                raise ValueError(f"a packet of interface {number}, which is not described")
            source = interfaces[number]
            t_ns = (high << 32 | low) * 1_000_000_000 // source.ticks_per_s
            yield t_ns + source.offset_ns, source, body[20 : 20 + captured]
        elif kind == _SIMPLE:
            notes.timed = False
            if not interfaces:
                raise ValueError("a packet before its interface is described")
            yield 0, interfaces[0], body[4:]


def _interface(body: bytes, order: str, name: str, path: Path, notes: LogNotes) -> _Interface:
    link = struct.unpack_from(f"{order}H", body)[0]
    ticks_per_s, offset_s, place = 1_000_000, 0, 8
    while place + 4 <= len(body):
        code, length = struct.unpack_from(f"{order}HH", body, place)
        value = body[place + 4 : place + 4 + length]
        if code == _NAME_OPTION:
            name = value.decode("utf-8", "replace").rstrip("\0") or name
        elif code == _RESOLUTION_OPTION and value:
            ticks_per_s = 1 << (value[0] & 0x7F) if value[0] & 0x80 else 10 ** min(value[0], 18)
        elif code == _OFFSET_OPTION and length == 8:
            (offset_s,) = struct.unpack(f"{order}q", value)
        elif code == 0:
            break
        place += 4 + (length + 3) // 4 * 4
    return _Interface(link, _channel(name, path, notes, link), ticks_per_s, offset_s * 1_000_000_000)


def _channel(name: str, path: Path, notes: LogNotes, link: int = SOCKETCAN) -> int:
    channel = 0 if link & 0x0FFFFFFF == COOKED_2 else notes.channel(name, path)  # its packets have their own
    if channel is None:
        raise InputError(f"{path}: more than {len(notes.channels)} different interfaces")
    return channel


def _exactly(file: _File, count: int) -> bytes:
    if count > _LONGEST_BLOCK:
        raise ValueError(f"a packet of {count} bytes")
    data = file.read(count)
    if len(data) < count:
        raise ValueError("the end of the last packet is missing")
    return data


SCHEMA = "can_msgs/msg/Frame"
_HEAD = {0: struct.Struct(">iII"), 1: struct.Struct("<iII")}  # stamp, length of frame_id; by the byte order of CDR
_REST = {0: struct.Struct(">I???B8s"), 1: struct.Struct("<I???B8s")}
_CDR_HEADER = 4


def mcap_blocks(path: Path, notes: LogNotes) -> Iterator[CandumpBlock]:
    """Yield blocks of frames in the order of the file. A damaged file is noted as bad. Raises EnvironmentLackError
    without the package mcap, LogError for a file that has no CAN frames."""
    with needing(f"{path} is MCAP: `pip install 'tipforce[mcap]'`"):
        from mcap.stream_reader import StreamReader
    empty = True
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=MOST_CHUNK_BYTES)
        messages = _messages(reader.records, path)
        for block in row_blocks(path, (_message_row(path, notes, *message) for message in messages), notes):
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


def _message_row(path: Path, notes: LogNotes, topic: str, log_time_ns: int, data: bytes) -> bytes:
    try:
        order = data[1] & 1
        sec, nanosec, size = _HEAD[order].unpack_from(data, _CDR_HEADER)
        start = _CDR_HEADER + _HEAD[order].size
        name, end = data[start : start + size - 1].decode(errors="replace") or topic, start + size
        can_id, remote, extended, error, length, payload = _REST[order].unpack_from(data, end + -end % 4)
        if length > len(payload):
            raise IndexError(length)
    except (IndexError, struct.error):
        notes.note_bad("not CAN", f"{path}: a message of {topic} that is cut, or no {SCHEMA}")
        return b""
    channel = notes.channel(name, path)
    if channel is None:
        return b""
    can_id |= (EXTENDED_FLAG if extended else 0) | (REMOTE_FLAG if remote else 0) | (ERROR_FLAG if error else 0)
    t_ns = sec * 1_000_000_000 + nanosec
    return PACK_FRAME(t_ns or log_time_ns, can_id, length, channel, 0, payload)
