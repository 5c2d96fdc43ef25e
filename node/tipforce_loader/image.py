"""A program image: one file with the compiled modules of a program, its check, and its files as a read-only file system
of MicroPython, so that modules are imported from the image.

    offset  bytes
    0       4      "TIPF"
    4       1      format, 1
    5       3      version: major, minor, patch
    8       4      product, the upper 16 bits of 1018h:2
    12      4      length of the body
    16      4      CRC-32 of bytes 0 to 15 and the body
    20      32     HMAC-SHA256 (RFC 2104) of bytes 0 to 19 and the body
    52             body: for each file the length of its path (1 byte), its size (4 bytes), its path, its content

Numbers are little-endian."""

import binascii
import hashlib
import io
import struct

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import BinaryIO

HEAD_SIZE, SIGNED_SIZE, CHECKED_SIZE = 52, 20, 16
FORMAT = 1
PRODUCT_SHIFT = 16  # the lower bits of 1018h:2 are the gauges and options of one node: any program serves them
_MAGIC = b"TIPF"
_PART = 1024
_CLOSE, _BUFFER_SIZE, _BUFFER = 4, 11, 255  # requests to ``ioctl`` of a stream; the size in which to read one
_FOLDER, _FILE = 0x4000, 0x8000  # st_mode

# Why a program was refused or given up: bits 16 to 31 of 1F57h.
NOT_AN_IMAGE, OTHER_PRODUCT, DAMAGED, WRONG_SIGNATURE, FLASH_FAILED, TOO_LARGE, UNHEALTHY = 1, 2, 3, 4, 5, 6, 7


class Header:
    """The head of an image, 52 bytes. Raises ValueError for other bytes."""

    def __init__(self, head: bytes) -> None:
        if len(head) < HEAD_SIZE or head[:4] != _MAGIC or head[4] != FORMAT:
            raise ValueError("not a program image of format %d" % FORMAT)
        self.head = head[:HEAD_SIZE]
        self.version = head[5], head[6], head[7]
        product, length, crc = struct.unpack("<III", head[8:20])
        self.product: int = product
        self.length: int = length
        self.crc: int = crc

    def version_text(self) -> str:
        """Return the version as ``1.2.3``."""
        return "%d.%d.%d" % self.version

    def fits(self, product: int) -> bool:
        """Return whether the image is for a node with this product code (1018h:2)."""
        return self.product >> PRODUCT_SHIFT == product >> PRODUCT_SHIFT


class Hmac:
    """HMAC-SHA256 (RFC 2104): MicroPython has no module hmac. The key has 1 to 64 bytes."""

    def __init__(self, key: bytes) -> None:
        if not 1 <= len(key) <= 64:
            raise ValueError("key: %d bytes, allowed 1 to 64" % len(key))
        key = key + bytes(64 - len(key))
        self._outer = bytes([byte ^ 0x5C for byte in key])
        self._inner = hashlib.sha256(bytes([byte ^ 0x36 for byte in key]))

    def update(self, part: bytes) -> None:
        """Add the next bytes of the message."""
        self._inner.update(part)

    def digest(self) -> bytes:
        """Return the 32 bytes of the code. Call it once."""
        outer = hashlib.sha256(self._outer)
        outer.update(self._inner.digest())
        return outer.digest()


def _equal(one: bytes, other: bytes) -> bool:
    """Compare in a time that says nothing about the first difference."""
    different = len(one) ^ len(other)
    for k in range(min(len(one), len(other))):
        different |= one[k] ^ other[k]
    return not different


def check(file: "BinaryIO", key: bytes) -> "tuple[int, Header | None]":
    """Read an image from its first byte to its last; return (0, its head) or (the reason why it is none, None)."""
    try:
        header = Header(file.read(HEAD_SIZE))
    except ValueError:
        return NOT_AN_IMAGE, None
    crc = binascii.crc32(header.head[:CHECKED_SIZE])
    hmac = Hmac(key)
    hmac.update(header.head[:SIGNED_SIZE])
    left = header.length
    while left:
        part = file.read(min(left, _PART))
        if not part:
            return DAMAGED, None
        left -= len(part)
        crc = binascii.crc32(part, crc)
        hmac.update(part)
    if crc & 0xFFFFFFFF != header.crc or file.read(1):
        return DAMAGED, None
    if not _equal(hmac.digest(), header.head[SIGNED_SIZE:]):
        return WRONG_SIGNATURE, None
    return 0, header


def files(file: "BinaryIO") -> "Iterator[tuple[str, int, int]]":
    """Return (path, offset, size) of each file in a checked image."""
    end = HEAD_SIZE + Header(file.read(HEAD_SIZE)).length
    at = HEAD_SIZE
    while at < end:
        file.seek(at)
        name_size, size = struct.unpack("<BI", file.read(5))
        name = file.read(name_size).decode()
        at += 5 + name_size + size
        yield name, at - size, size


class ImageFile(io.IOBase):
    """One open file: ``size`` bytes from ``offset`` of the image."""

    def __init__(self, file: "BinaryIO", offset: int, size: int) -> None:
        file.seek(offset)
        self._file, self._left = file, size

    def readinto(self, buffer: bytearray) -> int:
        """Read up to the size of the buffer; return the number of bytes, 0 at the end."""
        part = self._file.read(min(len(buffer), self._left))
        buffer[: len(part)] = part
        self._left -= len(part)
        return len(part)

    def ioctl(self, request: int, _argument: int) -> int:
        """Close the file, or name the size in which to read it."""
        if request == _CLOSE:
            self._file.close()
        return _BUFFER if request == _BUFFER_SIZE else 0


class ImageFiles:
    """A file system for ``vfs.mount``. ``open_image`` opens the image."""

    def __init__(self, open_image: "Callable[[], BinaryIO]") -> None:
        self._open_image = open_image
        self._files: "dict[str, tuple[int, int]]" = {}
        self._folders: "set[str]" = set()
        with open_image() as file:
            for path, offset, size in files(file):
                self._files[path] = offset, size
                parts = path.split("/")
                for depth in range(1, len(parts)):
                    self._folders.add("/".join(parts[:depth]))

    def mount(self, *_arguments: bool) -> None:
        """Do nothing: MicroPython calls it."""

    umount = mount

    def stat(self, path: str) -> "tuple[int, ...]":
        """Return the type and size of a file or folder. Raises OSError if there is none."""
        path = path.strip("/")
        if path in self._folders:
            return (_FOLDER,) + (0,) * 9
        if path not in self._files:
            raise OSError(2)
        return (_FILE, 0, 0, 0, 0, 0, self._files[path][1], 0, 0, 0)

    def open(self, path: str, _mode: str) -> ImageFile:
        """Open a file. Raises OSError if there is none."""
        path = path.strip("/")
        if path not in self._files:
            raise OSError(2)
        return ImageFile(self._open_image(), *self._files[path])
