"""Values to bytes, bytes to values, and what people write to values."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device import types
from tipforce.errors import InputError

INTEGERS = [t for t in types.TYPES.values() if t.limits is not None and t.letter != "?"]


def test_codes_are_those_of_cia_301() -> None:
    codes = {t.name: t.code for t in types.TYPES.values()}
    expected = {"INTEGER16": 3, "INTEGER32": 4, "UNSIGNED8": 5, "UNSIGNED16": 6, "UNSIGNED32": 7, "REAL32": 8}
    assert codes | expected | {"VISIBLE_STRING": 9, "DOMAIN": 15} == codes


@pytest.mark.parametrize(
    ("letter", "value", "data"),
    [
        ("B", 254, "fe"),
        ("H", 0x1234, "3412"),
        ("I", 0x65766173, "73617665"),
        ("h", -32768, "0080"),
        ("i", -2, "feffffff"),
        ("f", 1.0, "0000803f"),
        ("f", 3, "00004040"),
        ("s", "save", "73617665"),
        ("D", b"\x01\x02", "0102"),
        ("Q", 1, "0100000000000000"),
        ("u3", 0x123456, "563412"),
        ("i5", -2, "feffffffff"),
        ("t", bytes(range(6)), "000102030405"),
        ("f", 3.4025001647762064e38, "c5f97f7f"),
    ],
)
def test_known_bytes(letter: str, value: types.Value, data: str) -> None:
    assert types.encode(letter, value).hex() == data
    assert types.decode(letter, bytes.fromhex(data)) == value


@pytest.mark.parametrize("kind", INTEGERS, ids=lambda t: t.name)
def test_integers_to_the_ends_and_not_beyond(kind: types.DataType) -> None:
    assert kind.limits is not None
    for value in kind.limits:
        data = types.encode(kind.letter, value)
        assert len(data) == kind.size
        assert types.decode(kind.letter, data) == value
        assert types.parse_value(kind.letter, str(value)) == value
    low, high = kind.limits
    for value in (low - 1, high + 1):
        with pytest.raises(InputError, match=f"{value} does not fit {kind.name}: allowed are {low} to {high}"):
            types.encode(kind.letter, value)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.floats(width=32))
def test_real32_round_trip(value: float) -> None:
    data = types.encode("f", value)
    assert types.encode("f", types.decode("f", data)) == data or math.isnan(value)
    text = types.format_value("f", value)
    again = types.parse_value("f", text)
    assert isinstance(again, float)
    assert struct.pack("<f", again) == data or math.isnan(again) == math.isnan(value) is True


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.sampled_from(sorted(types.TYPES)), st.binary(min_size=8, max_size=8))
def test_any_bytes_of_the_right_length_decode(letter: str, data: bytes) -> None:
    size = types.data_type(letter).size
    assert isinstance(types.decode(letter, data[:size]), types.data_type(letter).python)


@pytest.mark.parametrize(
    ("letter", "value"),
    [("B", 1.5), ("B", "1"), ("f", 1e39), ("f", "x"), ("s", 3), ("s", "gr\u00fc\u00df"), ("D", 3), ("D", "00")],
)
def test_what_does_not_fit_says_what_is_allowed(letter: str, value: types.Value) -> None:
    with pytest.raises(InputError, match=types.data_type(letter).name):
        types.encode(letter, value)


def test_wrong_length() -> None:
    with pytest.raises(InputError, match=r"2 bytes .* for UNSIGNED32: allowed is 4"):
        types.decode("I", b"\0\0")


def test_a_string_from_the_wire_is_never_refused() -> None:
    assert types.decode("s", b"tip\xff\0\0") == "tip\\xff"
    assert types.decode("u", "tip".encode("utf-16-le")) == "tip"


@pytest.mark.parametrize(
    ("letter", "text", "value"),
    [
        ("B", "10", 10),
        ("B", " 0x0A ", 10),
        ("B", "010", 10),
        ("h", "-5", -5),
        ("?", "true", 1),
        ("?", "False", 0),
        ("f", "-1.5e-3", -1.5e-3),
        ("f", "inf", math.inf),
        ("s", "any text", "any text"),
        ("D", "DE AD 01", b"\xde\xad\x01"),
        ("D", "0xdead01", b"\xde\xad\x01"),
        ("D", "", b""),
    ],
)
def test_parse_value(letter: str, text: str, value: types.Value) -> None:
    assert types.parse_value(letter, text) == value


def test_parse_nan() -> None:
    value = types.parse_value("f", "NaN")
    assert isinstance(value, float)
    assert math.isnan(value)


@pytest.mark.parametrize(
    ("letter", "text"), [("B", "256"), ("B", "ten"), ("B", ""), ("f", "1,5"), ("f", "1e39"), ("D", "0g"), ("B", "1.0")]
)
def test_parse_refuses(letter: str, text: str) -> None:
    with pytest.raises(InputError, match=types.data_type(letter).name):
        types.parse_value(letter, text)


def test_words_of_cia_309_3() -> None:
    for word in ("b", "i8", "i16", "i32", "u8", "u16", "u32", "r32", "vs", "os", "d"):
        assert types.data_type(types.letter_of_word(word)).word == word
    assert types.letter_of_word("U16") == "H"
    with pytest.raises(InputError, match="u16"):
        types.letter_of_word("word")
    with pytest.raises(InputError, match="allowed are"):
        types.data_type("Z")


def test_format_value() -> None:
    assert types.format_value("f", 3276.7) == "3276.7"
    assert types.format_value("f", 180.0) == "180.0"
    assert types.format_value("D", b"\xde\xad") == "DE AD"
    assert types.format_value("h", -3) == "-3"
