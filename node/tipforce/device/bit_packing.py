"""PDOs whose mapped entries are not all whole values: a BOOLEAN of one bit, a string of some bytes (CiA 301, 7.4.7).

The first entry is in the lowest bits of the first byte.
"""

from .object_dictionary import encode

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .object_dictionary import Value


def pack(letters: "list[str]", widths: "list[int]", values: "list[Value]") -> bytes:
    """Return the data of a PDO: each value in its number of bits."""
    word, offset = 0, 0
    for letter, width, value in zip(letters, widths, values):  # noqa: B905
        word |= (int.from_bytes(encode(letter, value), "little") & (1 << width) - 1) << offset
        offset += width
    return word.to_bytes((offset + 7) // 8, "little")


def unpack(widths: "list[int]", data: bytes) -> "list[bytes]":
    """Return the bytes of each entry; ``data`` is at least as long as the mapping."""
    word, parts = int.from_bytes(data, "little"), []
    for width in widths:
        parts.append((word & (1 << width) - 1).to_bytes((width + 7) // 8, "little"))
        word >>= width
    return parts
