"""Read CAN frames from pcap and pcapng files, as Wireshark, tcpdump and dumpcap record them from SocketCAN.

Link types: 227 (SocketCAN: CAN ID in network byte order, length, then the data) and Linux' cooked captures of the
pseudo interface "any", 113 and 276, of the protocols 000Ch (CAN) and 000Dh (CAN FD). Formats as in the drafts of the
IETF opsawg: pcap file format, PCAP Next Generation.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BufferedReader, FileIO
from pathlib import Path
from typing import NamedTuple, TypeAlias

from canopen_device.core.codes import REMOTE_FLAG
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import PACK_FRAME, FrameArray
from tipforce.host.logs.lines import open_file, row_blocks
from tipforce.host.logs.notes import FD, LogNotes

SOCKETCAN, COOKED, COOKED_2 = 227, 113, 276
_CAN, _CAN_FD = 0x000C, 0x000D
_FD_FLAG = 0x04  # CANFD_FDF in the byte after the length
_FD_BYTES = 72
_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6
_BYTE_ORDER_MAGIC = 0x1A2B3C4D
_NAME_OPTION, _RESOLUTION_OPTION = 2, 9
_LONGEST_BLOCK = 1 << 20
_HEAD = struct.Struct(">IBB")
_UNIT_OF_MAGIC = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}  # ns per unit of the fraction


class _Interface(NamedTuple):
    """Source of packets: link type, channel number, ticks of the clock per second."""

    link: int
    channel: int
    ticks_per_s: int


_File: TypeAlias = "BufferedReader[FileIO]"
_Packet = tuple[int, _Interface, bytes]  # t_ns


def pcap_blocks(path: Path, notes: LogNotes) -> Iterator[FrameArray]:
    """Yield blocks of frames. Packets that are not CAN, and a truncated file, are noted as bad.

    Raises InputError for a file that cannot be opened for reading.
    """
    with BufferedReader(open_file(path)) as file:
        magic = int.from_bytes(file.peek(4)[:4], "little")
        order = "<" if magic in _UNIT_OF_MAGIC else ">"
        packets = _pcapng(file, path, notes) if magic == _SECTION else _pcap(file, order, path, notes)
        yield from row_blocks(path, (_row(packet, path, notes) for packet in packets), notes)


def _row(packet: _Packet, path: Path, notes: LogNotes) -> bytes:
    """Return a packet as the bytes of a FRAME; empty for CAN FD, and for what is not a CAN frame, which is noted."""
    t_ns, interface, data = packet
    is_fd, is_can = False, interface.link == SOCKETCAN
    if interface.link in {COOKED, COOKED_2}:
        start, size = (14, 16) if interface.link == COOKED else (0, 20)
        protocol = int.from_bytes(data[start : start + 2], "big")
        data, is_fd, is_can = data[size:], protocol == _CAN_FD, protocol in {_CAN, _CAN_FD}
    if is_can and len(data) >= 8:
        can_id, length, flags = _HEAD.unpack_from(data)
        if is_fd or flags & _FD_FLAG or len(data) == _FD_BYTES:
            notes.skip(FD)
            return b""
        if length <= 8 and 0 <= t_ns < 1 << 63:
            payload = b"" if can_id & REMOTE_FLAG else data[8 : 8 + length]
            return PACK_FRAME(t_ns, can_id, length, interface.channel, 0, payload)
    notes.note_bad("not CAN", f"{path}: a packet that is not a CAN frame (link type {interface.link})")
    return b""


def _pcap(file: _File, order: str, path: Path, notes: LogNotes) -> Iterator[_Packet]:
    magic, _, _, _, _, _, link = struct.unpack(f"{order}IHHiIII", _exactly(file, 24))
    unit = _UNIT_OF_MAGIC[magic]
    interface = _Interface(link & 0x0FFFFFFF, _channel("can", path, notes), 1_000_000_000 // unit)
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
            interfaces.append(_interface(body, order, path, notes))
        elif kind == _ENHANCED:
            number, high, low, captured, _ = struct.unpack_from(f"{order}IIIII", body)
            if number >= len(interfaces):
                raise ValueError(f"a packet of interface {number}, which is not described")
            source = interfaces[number]
            t_ns = (high << 32 | low) * 1_000_000_000 // source.ticks_per_s
            yield t_ns, source, body[20 : 20 + captured]
        elif kind == _SIMPLE:
            notes.timed = False
            if not interfaces:
                raise ValueError("a packet before its interface is described")
            yield 0, interfaces[0], body[4:]


def _interface(body: bytes, order: str, path: Path, notes: LogNotes) -> _Interface:
    link = struct.unpack_from(f"{order}H", body)[0]
    name, ticks_per_s, place = "can", 1_000_000, 8
    while place + 4 <= len(body):
        code, length = struct.unpack_from(f"{order}HH", body, place)
        value = body[place + 4 : place + 4 + length]
        if code == _NAME_OPTION:
            name = value.decode("utf-8", "replace").rstrip("\0") or name
        elif code == _RESOLUTION_OPTION and value:
            ticks_per_s = 1 << (value[0] & 0x7F) if value[0] & 0x80 else 10 ** min(value[0], 18)
        elif code == 0:
            break
        place += 4 + (length + 3) // 4 * 4
    return _Interface(link, _channel(name, path, notes), ticks_per_s)


def _channel(name: str, path: Path, notes: LogNotes) -> int:
    channel = notes.channel(name, path)
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
