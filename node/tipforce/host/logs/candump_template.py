"""Template of a line of candump text: the positions of the digits, and the characters between them."""

from __future__ import annotations

import re
from dataclasses import dataclass

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


FRONT = 8
"""Bytes in front of a line that belong to its row, so that a word can end near the start of the line."""

_STAMP = rb"\((?:(?P<seconds>[0-9]{1,10})\.|(?P<date>%s)\.)(?P<fraction>[0-9]{6}|[0-9]{9})\)" % (
    rb"[0-9]{4}-[0-9][0-9]-[0-9][0-9] [0-9][0-9]:[0-9][0-9]:[0-9][0-9]"
)
_ID = rb"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
_NAME = rb"(?P<name>[A-Za-z][A-Za-z0-9_.:-]*)"
_LOG = re.compile(_STAMP + rb" +" + _NAME + rb" +" + _ID + rb"#")
_SCREEN = re.compile(
    rb" *(?:" + _STAMP + rb" +)?" + _NAME + rb" +(?:(?P<way>[RT])X [-B] [-E] +)?" + _ID + rb" +\[(?P<length>[0-8])\] "
)
_LONGEST_HEAD = 96
_SCREEN_DATA = 24  # " 00" for each of eight bytes


@dataclass(frozen=True, slots=True)
class Template:
    """Lines that differ only in the digits of time, identifier, length and data.

    A row is FRONT bytes, then the line; all offsets count from the start of the row. ``fixed``: (offset, mask, value)
    of words that are the same in each line. ``stamp``: (offset, mask, ns per unit) of words of decimal digits;
    ``date``: offset of the 19 characters of a date. ``identifier``: (offset, mask) of a word of hexadecimal digits.
    ``data``: offset of the line's data. ``length``: offset of the length, None in the log format.
    """

    name: str
    row_bytes: int
    fixed: tuple[tuple[int, np.uint64, np.uint64], ...]
    stamp: tuple[tuple[int, np.uint64, int], ...]
    date: int | None
    identifier: tuple[int, np.uint64]
    extended: bool
    data: int
    length: int | None
    sent: bool

    @property
    def timed(self) -> bool:
        """True if the lines have a timestamp."""
        return bool(self.stamp)


class Templates:
    """Find the template of a line, and cache the templates."""

    def __init__(self) -> None:
        self._made: dict[bytes, Template | None] = {}

    def of(self, line: bytes) -> Template | None:
        """Return the template of lines like this one; None if this line is not suitable for a template."""
        match = _LOG.match(line) or _SCREEN.match(line)
        if match is None or match.end() > _LONGEST_HEAD or (match["date"] and len(match["fraction"]) != 6):
            return None
        key = _key(match)
        if key not in self._made:
            if len(self._made) >= 1024:  # a text full of names must not fill the memory
                self._made.clear()
            self._made[key] = _template(match)
        return self._made[key]


def _digit_spans(match: re.Match[bytes]) -> list[tuple[int, int]]:
    groups = match.groupdict()
    return [match.span(name) for name in ("seconds", "date", "fraction", "id", "length") if groups.get(name)]


def _key(match: re.Match[bytes]) -> bytes:
    """Return the start of a line with its digits replaced by zero bytes."""
    key = bytearray(match.group())
    for start, stop in _digit_spans(match):
        key[start:stop] = b"\0" * (stop - start)
    return bytes(key)


def _template(match: re.Match[bytes]) -> Template:
    log = match.re is _LOG
    way = None if log else match["way"]
    end = match.end() + FRONT
    row_bytes = 64 if end + (16 if log else _SCREEN_DATA) <= 64 else 128
    stop = match.end("id") + FRONT
    digits = len(match["id"])
    return Template(
        name=match["name"].decode(),
        row_bytes=row_bytes,
        fixed=_fixed(match),
        stamp=_stamp(match),
        date=match.start("date") + FRONT if match["date"] else None,
        identifier=(stop - 8, LAST[digits]),
        extended=digits == 8,
        data=end,
        length=None if log else match.start("length") + FRONT,
        sent=way == b"T",
    )


def _fixed(match: re.Match[bytes]) -> tuple[tuple[int, np.uint64, np.uint64], ...]:
    mask = bytearray(FRONT) + bytearray(b"\xff" * match.end()) + bytearray(8)
    for start, stop in _digit_spans(match):
        mask[start + FRONT : stop + FRONT] = bytes(stop - start)
    value = bytes(FRONT) + match.group() + bytes(8)
    found = []
    for offset in range(FRONT, FRONT + match.end(), 8):
        word_mask = int.from_bytes(mask[offset : offset + 8], "little")
        word = int.from_bytes(value[offset : offset + 8], "little") & word_mask
        if word_mask:
            found.append((offset, np.uint64(word_mask), np.uint64(word)))
    return tuple(found)


def _stamp(match: re.Match[bytes]) -> tuple[tuple[int, np.uint64, int], ...]:
    """Return words of at most eight digits each, the fraction last."""
    found = []
    for name, unit in (("seconds", 1_000_000_000), ("fraction", 10 ** (9 - len(match["fraction"] or b"")))):
        if match[name]:
            stop, digits = match.end(name) + FRONT, len(match[name])
            if digits > 8:
                found.append((stop - 16, LAST[digits - 8], unit * 100_000_000))
            found.append((stop - 8, LAST[min(digits, 8)], unit))
    return tuple(found)
