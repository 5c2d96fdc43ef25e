"""Parse digits in words: eight characters as one little-endian uint64, so the first character is the low byte."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[np.uint64]
Rows = npt.NDArray[np.bool_]


def _repeat(byte: int) -> np.uint64:
    return np.uint64(byte * 0x0101010101010101)


_ZEROS = _repeat(ord("0"))
_HIGH_BITS = _repeat(0x80)
_CASE_FROM = _repeat(0x40)
_LOW, _SIX, _ONES, _HIGH_NIBBLES = _repeat(0x0F), _repeat(6), _repeat(1), _repeat(0xF0)
# Added to a character to set its byte's top bit from "0", ":", "A" and "G" on.
_HEX_EDGES = tuple(_repeat(0x80 - ord(character)) for character in "0:AG")
_BYTES_16, _BYTES_32 = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF)
_1, _4, _6, _8, _9, _16, _32 = (np.uint64(number) for number in (1, 4, 6, 8, 9, 16, 32))
_PAIRS = tuple(np.uint64(number) for number in (10 << 8 | 1, 100 << 16 | 1, 10_000 << 32 | 1))

FIRST = np.array([(1 << 8 * count) - 1 for count in range(9)], dtype=np.uint64)
"""FIRST[k] keeps the first k characters of a word."""

LAST = FIRST[8] ^ FIRST[::-1]
"""LAST[k] keeps the last k characters."""


def decimal(words: Words, keep: np.uint64) -> tuple[Words, Rows]:
    """Convert words (n,) of decimal digits to (values (n,), validity (n,)); characters not in ``keep`` are 0."""
    digits = (words ^ _ZEROS) & keep
    wrong = (digits | (digits + _SIX)) & _HIGH_NIBBLES
    digits *= _PAIRS[0]
    digits >>= _8
    digits &= _BYTES_16
    digits *= _PAIRS[1]
    digits >>= _16
    digits &= _BYTES_32
    digits *= _PAIRS[2]
    digits >>= _32
    return digits, wrong == 0


def fill(words: Words, keep: Words | np.uint64) -> Words:
    """Return the words with "0" in place of the characters that are not in ``keep``."""
    found: Words = ((words ^ _ZEROS) & keep) ^ _ZEROS
    return found


def hexadecimal(words: Words) -> tuple[Words, Rows]:
    """Convert words (k, n) of hexadecimal digits to (values (k, n), whether all k are valid (n,)).

    A value has four bytes in the order of the text.
    """
    valid = _valid(words)
    if not valid.all():  # lower case is rare
        words = words & ~((words & _CASE_FROM) >> _1)
        valid = _valid(words)
    nibbles = words >> _6
    nibbles &= _ONES
    nibbles *= _9
    nibbles += words & _LOW
    high = nibbles << _4
    nibbles >>= _8
    nibbles |= high
    nibbles &= _BYTES_16
    nibbles |= nibbles >> _8
    nibbles &= _BYTES_32
    nibbles |= nibbles >> _16
    nibbles &= FIRST[4]
    return nibbles, valid


def _valid(words: Words) -> Rows:
    """Return which words are valid: a digit is past an odd number of edges; its own top bit spoils the sums."""
    marks = words + _HEX_EDGES[0]
    for edge in _HEX_EDGES[1:]:
        marks ^= words + edge
    marks &= ~words
    together: Words = np.bitwise_and.reduce(marks, axis=0)
    valid: Rows = (together & _HIGH_BITS) == _HIGH_BITS
    return valid
