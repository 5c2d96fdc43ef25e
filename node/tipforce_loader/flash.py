"""Parameters in flash: two slots, each with all groups and a CRC; a save overwrites the older one. A power failure at
any byte of a save leaves the other slot unchanged, so a load returns all old or all new content. A slot: magic,
sequence number, length, CRC-32 over these and the content; the content has one record per group."""

import binascii
import os
import struct

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Protocol

    class Slots(Protocol):
        """Memory for two slots; OSError where it fails."""

        def read(self, slot: int) -> bytes: ...  # the whole content; empty if there is none
        def write(self, slot: int, data: bytes) -> None: ...  # returns only when the content is in flash


_MAGIC = 0x31504954  # "TIP1"
_HEAD = "<IIII"
_HEAD_SIZE = 16
_LARGEST = 1 << 20
_NOTHING: "tuple[int, dict[str, bytes]]" = (0, {})


class FlashStore:
    """``save`` and ``load`` of a device with two slots. ``error`` holds the last failure, for a log."""

    def __init__(self, slots: "Slots") -> None:
        self._slots = slots
        self.error = ""
        self._sequence, self._slot = 0, 1
        self._groups: "dict[str, bytes]" = {}
        for slot in (0, 1):
            sequence, groups = self._read(slot)
            # Sequence numbers wrap, and the slots differ by one save.
            if sequence and (not self._sequence or 0 < (sequence - self._sequence & 0xFFFFFFFF) < 1 << 31):
                self._sequence, self._slot, self._groups = sequence, slot, groups

    def load(self, group: str) -> "bytes | None":
        """Return the data saved for a group; None if there is none."""
        return self._groups.get(group)

    def save(self, group: str, data: bytes) -> bool:
        """Save a group. Return False, with all data unchanged, if the flash does not read back as written."""
        if self._groups.get(group) == data:
            return True  # flash wears out: unchanged data is not written again
        groups = dict(self._groups)
        groups[group] = bytes(data)
        sequence = self._sequence + 1 & 0xFFFFFFFF or 1
        slot = 1 - self._slot
        content = b""
        for name in sorted(groups):
            content += struct.pack("<BI", len(name), len(groups[name])) + name.encode() + groups[name]
        head = struct.pack("<III", _MAGIC, sequence, len(content))
        try:
            self._slots.write(slot, head + struct.pack("<I", binascii.crc32(head + content) & 0xFFFFFFFF) + content)
        except OSError as error:
            self.error = "slot %d: %r" % (slot, error)
            return False
        if self._read(slot) != (sequence, groups):
            self.error = "slot %d: does not read back" % slot
            return False
        self._sequence, self._slot, self._groups = sequence, slot, groups
        return True

    def _read(self, slot: int) -> "tuple[int, dict[str, bytes]]":
        try:
            image = self._slots.read(slot)
        except OSError:
            return _NOTHING
        if len(image) < _HEAD_SIZE:
            return _NOTHING
        magic, sequence, length, crc = struct.unpack(_HEAD, image[:_HEAD_SIZE])
        if magic != _MAGIC or not sequence or length > len(image) - _HEAD_SIZE:
            return _NOTHING
        content = image[_HEAD_SIZE : _HEAD_SIZE + length]
        if binascii.crc32(image[:12] + content) & 0xFFFFFFFF != crc:
            return _NOTHING
        groups, at = {}, 0
        while at < len(content):
            size, count = struct.unpack("<BI", content[at : at + 5])
            at += 5 + size + count
            groups[content[at - count - size : at - count].decode()] = content[at - count : at]
        return sequence, groups


class FileSlots:
    """Two files in a directory of the board's file system (littlefs or FAT), which is created if it is missing."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        try:
            os.mkdir(folder)
        except OSError:
            pass  # it exists; if not, the first write raises the error

    def _path(self, slot: int) -> str:
        return "%s/slot%d.bin" % (self._folder, slot)

    def read(self, slot: int) -> bytes:
        """Return the content of the file."""
        with open(self._path(slot), "rb") as file:
            return file.read()

    def write(self, slot: int, data: bytes) -> None:
        """Replace the file; closing it writes it to flash, with ``os.sync`` if available."""
        with open(self._path(slot), "wb") as file:
            file.write(data)
        if hasattr(os, "sync"):
            os.sync()


class BlockSlots:
    """Two halves of a block device without a file system, such as ``esp32.Partition.find(label="tip")[0]``; a write
    erases the blocks first. Raises ValueError for a device with less than two blocks."""

    def __init__(self, device: "Any") -> None:
        count, self._size = device.ioctl(4, 0) or 0, device.ioctl(5, 0) or 512  # number and size of the blocks
        if count < 2:
            raise ValueError("block device: %d blocks, 2 are needed" % count)
        self._device, self._count = device, count // 2

    def read(self, slot: int) -> bytes:
        """Return whole blocks, as many as the header of the content requires."""
        first = bytearray(self._size)
        self._device.readblocks(slot * self._count, first)
        magic, _sequence, length, _crc = struct.unpack(_HEAD, first[:_HEAD_SIZE])
        blocks = (min(length, _LARGEST) + _HEAD_SIZE + self._size - 1) // self._size if magic == _MAGIC else 1
        if blocks == 1 or blocks > self._count:
            return bytes(first)
        rest = bytearray(self._size * (blocks - 1))
        self._device.readblocks(slot * self._count + 1, rest)
        return bytes(first + rest)

    def write(self, slot: int, data: bytes) -> None:
        """Erase and write the blocks; OSError if the content does not fit."""
        blocks = (len(data) + self._size - 1) // self._size
        if blocks > self._count:
            raise OSError(28)  # ENOSPC
        buffer = bytearray(data + b"\xff" * (blocks * self._size - len(data)))
        self._device.writeblocks(slot * self._count, buffer)
        self._device.ioctl(3, 0)  # sync
