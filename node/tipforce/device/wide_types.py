"""Data types that a fingertip does not use: BOOLEAN, 24 to 64 bits, REAL64 (CiA 301, 7.1.4). Import it to add them."""

from .object_dictionary import FORMATS, RANGES, SIZES

SIZES["?"], SIZES["d"] = 1, 8
RANGES["?"] = (0, 1)
for _letter in "?dQq":
    FORMATS[_letter] = "<" + _letter
for _size, _unsigned, _signed in ((3, "u3", "i3"), (5, "u5", "i5"), (6, "u6", "i6"), (7, "u7", "i7"), (8, "Q", "q")):
    SIZES[_unsigned] = SIZES[_signed] = _size
    RANGES[_unsigned] = (0, (1 << 8 * _size) - 1)
    RANGES[_signed] = (-(1 << 8 * _size - 1), (1 << 8 * _size - 1) - 1)
