"""The data types of the dictionary: codes, names, sizes, bytes and text (CiA 301, 7.4.7; CiA 309-3, data types). A type
is named by a letter: that of ``struct``, "s" a VISIBLE_STRING, "o" an OCTET_STRING, "u" a UNICODE_STRING, "D" a DOMAIN,
"t" TIME_OF_DAY and "T" TIME_DIFFERENCE (six bytes), "i3" to "i7" and "u3" to "u7" integers of 24 to 56 bits."""

import operator
import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, TypeAlias

from canopen_device.errors import InputError
from canopen_device.visible_text import visible

Value: TypeAlias = int | float | str | bytes

_REAL32_MAXIMUM: Final = 3.4028234663852886e38
_WORDS: Final = {"true": 1, "false": 0}
_FORMS: Final = {  # how a person writes a value, by its Python type
    int: "a number as 10 or 0x0A", float: "a number, nan or inf", bytes: "hex bytes, for example 'DE AD 01'",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class DataType:
    """One data type: CiA 301 code and name, size in bytes (None: any length), Python type, CiA 309-3 word."""

    letter: str
    code: int
    name: str
    size: int | None
    python: type[int] | type[float] | type[str] | type[bytes]
    word: str

    @property
    def limits(self) -> tuple[int, int] | None:
        """Lowest and highest value of an integer type, None for the others."""
        if self.python is not int or self.size is None:
            return None
        if self.letter == "?":
            return (0, 1)
        bits = 8 * self.size
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if self.name.startswith("INTEGER") else (0, (1 << bits) - 1)


TYPES: Final = {
    t.letter: t
    for t in (
        DataType("?", 0x01, "BOOLEAN", 1, int, "b"), DataType("b", 0x02, "INTEGER8", 1, int, "i8"),
        DataType("h", 0x03, "INTEGER16", 2, int, "i16"), DataType("i", 0x04, "INTEGER32", 4, int, "i32"),
        DataType("B", 0x05, "UNSIGNED8", 1, int, "u8"), DataType("H", 0x06, "UNSIGNED16", 2, int, "u16"),
        DataType("I", 0x07, "UNSIGNED32", 4, int, "u32"), DataType("f", 0x08, "REAL32", 4, float, "r32"),
        DataType("s", 0x09, "VISIBLE_STRING", None, str, "vs"), DataType("o", 0x0A, "OCTET_STRING", None, bytes, "os"),
        DataType("u", 0x0B, "UNICODE_STRING", None, str, "us"), DataType("t", 0x0C, "TIME_OF_DAY", 6, bytes, "t"),
        DataType("T", 0x0D, "TIME_DIFFERENCE", 6, bytes, "td"), DataType("D", 0x0F, "DOMAIN", None, bytes, "d"),
        DataType("i3", 0x10, "INTEGER24", 3, int, "i24"), DataType("d", 0x11, "REAL64", 8, float, "r64"),
        DataType("i5", 0x12, "INTEGER40", 5, int, "i40"), DataType("i6", 0x13, "INTEGER48", 6, int, "i48"),
        DataType("i7", 0x14, "INTEGER56", 7, int, "i56"), DataType("q", 0x15, "INTEGER64", 8, int, "i64"),
        DataType("u3", 0x16, "UNSIGNED24", 3, int, "u24"), DataType("u5", 0x18, "UNSIGNED40", 5, int, "u40"),
        DataType("u6", 0x19, "UNSIGNED48", 6, int, "u48"), DataType("u7", 0x1A, "UNSIGNED56", 7, int, "u56"),
        DataType("Q", 0x1B, "UNSIGNED64", 8, int, "u64"),
    )
}  # fmt: skip
LETTER_OF_WORD: Final = {t.word: t.letter for t in TYPES.values()}
LETTER_OF_CODE: Final = {t.code: t.letter for t in TYPES.values()}


def data_type(letter: str) -> DataType:
    """The type behind a letter of the table. Raises InputError for an unknown letter."""
    if letter not in TYPES:
        raise InputError(f"type letter {letter!r}: allowed are {', '.join(TYPES)}")
    return TYPES[letter]


def letter_of_word(word: str) -> str:
    """The letter for a CiA 309-3 data type word such as ``u16``. Raises InputError for an unknown word."""
    if word.lower() not in LETTER_OF_WORD:
        raise InputError(f"data type {word!r}: allowed are {', '.join(LETTER_OF_WORD)} (CiA 309-3)")
    return LETTER_OF_WORD[word.lower()]


def encode(letter: str, value: Value) -> bytes:
    """The bytes that go on the wire for ``value``. Raises InputError naming the value and what is allowed."""
    kind = data_type(letter)
    if kind.python is int and kind.size is not None:
        return _checked_integer(kind, value).to_bytes(kind.size, "little", signed=kind.name.startswith("INTEGER"))
    if kind.python is float:
        return struct.pack("<" + letter, _checked_real(kind, value))
    if kind.python is str:
        if not isinstance(value, str):
            raise InputError(f"{value!r} is not {kind.name}: allowed is text")
        bad = [c for c in value if (not " " <= c <= "~" if letter == "s" else "\ud800" <= c <= "\udfff")]
        if bad:
            why = "is outside 0x20 to 0x7E" if letter == "s" else "is half of a character"
            raise InputError(f"{value!r} does not fit {kind.name}: {bad[0]!r} {why}")
        return value.encode("utf-16-le" if letter == "u" else "ascii")
    if not isinstance(value, bytes | bytearray | memoryview):
        raise InputError(f"{value!r} is not {kind.name}: allowed are bytes")
    if kind.size is not None and len(value) != kind.size:
        raise InputError(f"{bytes(value).hex()} does not fit {kind.name}: allowed are {kind.size} bytes")
    return bytes(value)


def decode(letter: str, data: bytes) -> Value:
    """The value of bytes from the wire; unknown values (NaN, 0x8000) as they are, control characters in a text and
    other than ASCII in a VISIBLE_STRING as escapes. Raises InputError for a length that does not fit the type."""
    kind = data_type(letter)
    if kind.size is not None:
        if len(data) != kind.size:
            raise InputError(f"{len(data)} bytes ({data.hex()}) for {kind.name}: allowed is {kind.size}")
        if letter == "?":
            return int(data != b"\0")
        if kind.python is int:
            return int.from_bytes(data, "little", signed=kind.name.startswith("INTEGER"))
        if kind.python is float:
            return float(struct.unpack("<" + letter, data)[0])
    if kind.letter == "s":
        return visible(data.rstrip(b"\0").decode("ascii", "backslashreplace"))
    if kind.letter == "u":
        return visible(data.decode("utf-16-le", "backslashreplace").rstrip("\0"))
    return bytes(data)


def parse_value(letter: str, text: str) -> Value:
    """The value that a person wrote: ``10``, ``0x0A``, ``-1.5e-3``, ``nan``, a text, or hex bytes. Raises InputError
    naming the text and what the type allows."""
    kind = data_type(letter)
    stripped = text.strip()
    if kind.python is str:
        encode(letter, text)
        return text
    try:
        if kind.python is int:
            word = _WORDS.get(stripped.lower()) if letter == "?" else None
            number = int(stripped, 10 if stripped.lstrip("+-").isdigit() else 0) if word is None else word
            return _checked_integer(kind, number)
        if kind.python is float:
            return _checked_real(kind, float(stripped))
        return bytes.fromhex(stripped.removeprefix("0x").replace(":", " "))
    except ValueError:
        raise InputError(f"{text!r} is not {kind.name}: write {_FORMS[kind.python]}") from None


def format_value(letter: str, value: Value) -> str:
    """The shortest text that ``parse_value`` reads back to the same bytes. Raises InputError outside of the type."""
    kind = data_type(letter)
    if kind.python is bytes:
        return encode(letter, value).hex(" ").upper()
    if letter != "f":
        encode(letter, value)
        return str(value)
    number = _checked_real(kind, value)
    wire = struct.pack("<f", number)
    for digits in range(1, 10):
        text = f"{number:.{digits}g}"
        with suppress(OverflowError):  # rounded up beyond the largest REAL32
            if struct.pack("<f", float(text)) == wire:
                break
    return repr(float(text))


def _checked_integer(kind: DataType, value: object) -> int:
    assert kind.limits is not None
    low, high = kind.limits
    try:
        number = operator.index(value)  # type: ignore[arg-type]  # the TypeError is the check
    except TypeError:
        raise InputError(f"{value!r} is not {kind.name}: allowed are integers {low} to {high}") from None
    if not low <= number <= high:
        raise InputError(f"{number} does not fit {kind.name}: allowed are {low} to {high}")
    return number


def _checked_real(kind: DataType, value: Value) -> float:
    if isinstance(value, str | bytes):
        raise InputError(f"{value!r} is not {kind.name}: allowed are numbers, nan and inf")
    number = float(value)
    try:
        struct.pack("<" + kind.letter, number)
    except OverflowError:
        limits = f"-{_REAL32_MAXIMUM!r} to {_REAL32_MAXIMUM!r}"
        raise InputError(f"{number!r} does not fit {kind.name}: allowed are {limits}") from None
    return number
