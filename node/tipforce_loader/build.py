"""Make a program image; not on the board."""

import binascii
import struct

from .image import CHECKED_SIZE, FORMAT, Hmac

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping


def image(version: "tuple[int, int, int]", product: int, contents: "Mapping[str, bytes]", key: bytes) -> bytes:
    """Return the signed image of ``contents``, by path. Raises ValueError for a key or version that is not allowed."""
    if not all(0 <= part <= 255 for part in version):
        raise ValueError("version %d.%d.%d: allowed are 0 to 255 in each place" % version)
    body = b""
    for path in sorted(contents):
        body += struct.pack("<BI", len(path), len(contents[path])) + path.encode() + contents[path]
    head = b"TIPF" + bytes((FORMAT,) + version) + struct.pack("<II", product, len(body))
    head += struct.pack("<I", binascii.crc32(head[:CHECKED_SIZE] + body) & 0xFFFFFFFF)
    hmac = Hmac(key)
    hmac.update(head + body)
    return head + hmac.digest() + body
