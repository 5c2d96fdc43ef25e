"""Numbers and values as an EDS writes them: hexadecimal, decimal, octal, $NODEID, text, REAL as decimal or as bits.
Each function returns what it read and a remark, "" where the text is as CiA 306-1 has it. Nothing raises."""

import math
import re
import struct
from typing import Generic, NamedTuple, TypeVar

from canopen_device.types import DataType, Value

T = TypeVar("T")
_NODE_ID = re.compile(r"\$?\s*node_?id", re.IGNORECASE)
_HEX = re.compile(r"0x([0-9a-f]+)", re.IGNORECASE)
_AROUND = "\"'() "  # what some tools write around a number
_READ = "{}"  # in a remark: the number with its sign
_FORMS = (  # of an unsigned integer, the first that fits: pattern, base, remark
    (_HEX, 16, ""),
    (re.compile(r"([1-9][0-9]*|0+[0-7]?)"), 10, ""),  # of one digit: octal or decimal
    (re.compile(r"(0[0-7]+)"), 8, f"read as octal: {_READ}"),
    (re.compile(r"([0-9]+)"), 10, f"a leading 0 is octal in CiA 306; read as decimal {_READ}"),
    (re.compile(r"0x([0-9a-f]+)h", re.IGNORECASE), 16, "0x and h: read as hexadecimal"),
    (re.compile(r"([0-9a-f]+)h?", re.IGNORECASE), 16, "0x is missing; read as hexadecimal"),
)
_WORDS = {"true": 1, "false": 0, "yes": 1, "no": 0}
_COMMENT = re.compile(r";|#|//")
_MOST_DIGITS = 40
_LONGEST_SUM = 255  # characters; a line of CiA 306-1


class Read(NamedTuple, Generic[T]):
    """A value, whether the node-id was added to it, a remark, and whether the value is not that of the text. An integer
    is None for what is no number."""

    value: T
    has_node_id: bool = False
    remark: str = ""
    is_other: bool = False


def uncommented(text: str) -> tuple[str, str]:
    """Return a value without quotes and a comment behind it, and a remark; CiA 306-1 has comments on own lines."""
    match = _COMMENT.search(text)
    plain = (text if match is None else text[: match.start()]).strip()
    bare = plain.strip(_AROUND)
    if match is not None:
        return bare, f"the text after {match[0]} is taken as a comment"
    return bare, "" if bare == plain else "quotes and brackets are no part of a value; read without"


def integer(text: str, node_id: int = 0) -> Read[int | None]:
    """Read an integer, or a sum of integers and $NODEID in any order; ``value`` includes ``node_id``."""
    plain, remark = uncommented(text)
    if not plain:
        return Read(None, False, "no number")
    if len(plain) > _LONGEST_SUM:
        return Read(None, False, f"{len(plain)} characters are no number")
    if not _NODE_ID.search(plain):
        value, problem = _number(plain)
        return Read(value, False, problem or remark)
    total, seen = 0, 0
    for part in map(str.strip, plain.split("+")):
        if _NODE_ID.fullmatch(part):
            seen += 1
            remark = remark or ("" if part.upper() == "$NODEID" else "the form is $NODEID")
            continue
        value, problem = _number(part)
        if value is None:
            return Read(None, False, "allowed are a number, and a sum of numbers and $NODEID")
        total, remark = total + value, remark or problem
    if seen > 1:
        remark = f"$NODEID occurs {seen} times; it is added once"
    return Read(total + node_id, True, remark)


def _number(text: str) -> tuple[int | None, str]:
    negative = text.startswith("-")
    digits = text[1:].strip() if text[:1] in ("-", "+") else text
    if len(digits) > _MOST_DIGITS:
        return None, f"{len(digits)} characters are no number"
    value, remark = _unsigned(digits)
    number = -value if negative and value is not None else value
    return number, remark.replace(_READ, str(number))


def _unsigned(digits: str) -> tuple[int | None, str]:
    for form, base, remark in _FORMS:
        if match := form.fullmatch(digits):
            return int(match[1], base), remark
    if digits.lower() in _WORDS:
        return _WORDS[digits.lower()], "the form is 0 or 1"
    try:
        number = float(digits.replace(",", "."))
    except ValueError:
        return None, "not a number"
    if math.isfinite(number) and number == int(number):
        return int(number), f"read as the integer {_READ}"
    return None, "not an integer"


def typed(kind: DataType, text: str, node_id: int) -> Read[Value]:
    """Read a value of a type. Empty text is 0 or empty."""
    if kind.python is int:
        return _integer(kind, text, node_id)
    if kind.letter == "s":
        shown = text.encode("latin-1", "replace").decode("latin-1")
        remark = "" if shown == text else f"not in {kind.name}; read with ? for other characters"
        return Read(shown, False, remark, shown != text)
    if kind.letter == "u":
        return Read(text)
    return _real(kind, text) if kind.python is float else _bytes(kind, text)


def _as_zero(zero: Value, problem: str) -> Read[Value]:
    return Read(zero, False, f"{problem}; read as 0", True)


def limit(kind: DataType, text: str, node_id: int) -> tuple[int | float | None, str]:
    """Read a limit of a numeric type, and a remark; None for what is no such number."""
    value, _, remark, is_other = typed(kind, text, node_id)
    if is_other or not isinstance(value, int | float):
        return None, remark.partition("; read as ")[0] + "; the limit does not apply"
    return value, remark


def _integer(kind: DataType, text: str, node_id: int) -> Read[Value]:
    if not text:
        return Read(0)
    value, has_node_id, remark, _ = integer(text, node_id)
    if value is None:
        return _as_zero(0, remark)
    low, high = kind.limits or (0, 0)
    if low <= value <= high:
        return Read(value, has_node_id, remark)
    bits = 8 * (kind.size or 0)
    wrapped = (value - low) % (1 << bits) + low
    if kind.letter != "?" and -(1 << bits - 1) <= value < 1 << bits:  # the same bits with the other sign
        as_bits = "x" in text.lower() and low < 0
        other = f"not in {kind.name}; read as {wrapped}"
        return Read(wrapped, has_node_id, remark if as_bits else other, not as_bits)
    nearest = min(max(value, low), high)
    return Read(nearest, has_node_id, f"not in {kind.name}, {low} to {high}; read as {nearest}", True)


def _real(kind: DataType, text: str) -> Read[Value]:
    if not text:
        return Read(0.0)
    plain, remark = uncommented(text)
    if _HEX.fullmatch(plain):
        size = kind.size or 4
        bits = int(plain, 16)
        if bits >> 8 * size:
            return _as_zero(0.0, f"more than the {8 * size} bits of {kind.name}")
        real = float(struct.unpack("<" + kind.letter, bits.to_bytes(size, "little"))[0])
        return Read(real, False, remark)
    if "," in plain:
        remark, plain = "the decimal sign is a point", plain.replace(",", ".")
    try:
        value = float(plain)
        struct.pack("<" + kind.letter, value)
    except (ValueError, OverflowError):
        return _as_zero(0.0, f"not in {kind.name}")
    return Read(value, False, remark)


def _bytes(kind: DataType, text: str) -> Read[Value]:
    """Read hexadecimal bytes; a text that is none stands for its own bytes."""
    bare = "".join(text.split()).removeprefix("0x").removeprefix("0X")
    try:
        data = bytes.fromhex(bare)
    except ValueError:
        data = text.encode("utf-8")
        if kind.size is None:
            return Read(data, False, "not hexadecimal bytes; read as text")
    if kind.size is None or len(data) == kind.size:
        return Read(data)
    if not data:
        return Read(bytes(kind.size))
    number = integer(text).value
    if number is not None and 0 <= number < 1 << 8 * kind.size:
        return Read(number.to_bytes(kind.size, "little"))
    return _as_zero(bytes(kind.size), f"not {kind.size} bytes")
