"""What devices of an EDS need and a fingertip does without: the other types of CiA 301, PDOs of single bits."""

from .object_dictionary import FORMATS, RANGES, SIZES, encode

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .object_dictionary import Value

SIZES["?"], SIZES["d"] = 1, 8
RANGES["?"] = (0, 1)
for _letter in "?dQq":
    FORMATS[_letter] = "<" + _letter
for _size, _unsigned, _signed in ((3, "u3", "i3"), (5, "u5", "i5"), (6, "u6", "i6"), (7, "u7", "i7"), (8, "Q", "q")):
    SIZES[_unsigned] = SIZES[_signed] = _size
    RANGES[_unsigned] = (0, (1 << 8 * _size) - 1)
    RANGES[_signed] = (-(1 << 8 * _size - 1), (1 << 8 * _size - 1) - 1)


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
