"""The table of the object dictionary: its rows, entries and types."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device import types
from tipforce.dictionary import objects as od
from tipforce.dictionary import table, table_objects
from tipforce.dictionary.entries import Array, Entry, gauges_of
from tipforce.dictionary.names import entries, objects
from tipforce.errors import InputError

ALL = [(n, simulated) for n in range(3, 9) for simulated in (False, True)]
INTEGERS = [t for t in types.TYPES.values() if t.limits is not None and t.letter != "?"]


@pytest.mark.parametrize(("n", "simulated"), ALL)
def test_indices_names_sub_indices_and_defaults_are_consistent(n: int, simulated: bool) -> None:
    indices = [row[0] for row in table_objects.objects(n, simulated)]
    assert indices == sorted(set(indices))
    assert (0x2200 in indices, 0x2201 in indices) == (simulated, simulated)
    dotted = [row.name for row in entries(n, simulated).values()]
    assert len(set(dotted)) == len(dotted)
    for found in objects(n, simulated):
        subs = [row.sub for row in found.entries]
        assert subs == sorted(set(subs)), hex(found.index)
        assert (found.code == table.VAR) == (subs == [0]), hex(found.index)
        for row in found.entries:
            default = b"" if row.type == "D" else row.default
            assert isinstance(default, types.data_type(row.type).python), row.name
            types.encode(row.type, default)
            if isinstance(row.default, int | float):
                assert row.low is None or row.low <= row.default, row.name
                assert row.high is None or row.default <= row.high, row.name


def test_every_gauge_is_in_exactly_one_default_tpdo() -> None:
    for n in range(3, 9):
        gauges = [s for pdo in table.tpdos(n) for index, s in pdo[6] if index == 0x7130 and s <= n]
        assert gauges == list(range(1, n + 1))


def test_the_calibration_record_of_three_gauges() -> None:
    staged = [row for row in entries(3).values() if row.flags & table.STAGED]
    arrays = {0x2100: 9, 0x2101: 3, 0x2102: 4, 0x2106: 6, 0x2110: 6, 0x2112: 5, 0x2113: 3, 0x2114: 3}
    expected = [(index, sub) for index, count in arrays.items() for sub in range(1, count + 1)]
    assert [(row.index, row.sub) for row in staged] == [*expected, (0x2115, 0), (0x2116, 0)]
    assert table_objects.staged(3) == tuple((row.index, row.sub, row.type) for row in staged)
    sizes: Counter[int] = Counter()
    for row in staged:
        sizes[row.index] += types.data_type(row.type).size or 0
    assert list(sizes.values()) == [36, 12, 13, 24, 21, 20, 12, 12, 4, 4]
    assert sum(sizes.values()) == 158


def test_views_have_the_default_of_the_value_they_show() -> None:
    for n in (3, 8):
        known = entries(n)
        digits = [channel[3] for channel in table.channels(n)]
        for row in known.values():
            if not row.flags & table.VIEW or row.sub == 0:
                continue
            value = known[0x6000 | row.index & 0xFFF, row.sub]
            scale = 1 if row.unit == "counts" else 10 ** digits[row.sub - 1]
            assert row.default == round(float(value.default) * scale), row.name
    assert entries(3)[0x2105, 2].flags & table.NOT_STORED  # a write lock that is stored would hold for ever


@pytest.mark.parametrize("n", [2, 9, 0, -1])
def test_number_of_gauges_outside(n: int) -> None:
    with pytest.raises(ValueError, match="allowed 3 to 8"):
        table_objects.objects(n)
    with pytest.raises(InputError, match="allowed 3 to 8"):
        objects(n)


@pytest.mark.parametrize("converter", [table.CONVERTER_16, table.CONVERTER_24])
@pytest.mark.parametrize("simulated", [False, True])
def test_a_product_code_states_the_gauges(simulated: bool, converter: table.Converter) -> None:
    assert [gauges_of(table.product_code(n, simulated, converter)) for n in range(3, 9)] == [3, 4, 5, 6, 7, 8]
    assert [gauges_of(table.product_code(n, simulated, converter)) for n in (0, 2, 9, 15)] == [0, 0, 0, 0]
    assert gauges_of(table.product_code(3, simulated, converter) | 1 << 10) == 0


def test_typed_use() -> None:
    generation: int = od.CALIBRATION_GENERATION.decode(b"\x05\0\0\0")
    first: float = od.CALIBRATION_MATRIX[1].decode(bytes.fromhex("0000803f"))
    name: str = od.DEVICE_NAME.decode(b"tipforce fingertip")
    record: bytes = od.CALIBRATION_ACTIVE_RECORD.decode(b"\1\2")
    assert (generation, first, name, record) == (5, 1.0, "tipforce fingertip", b"\1\2")
    assert Entry[int](0x2103, 4, "I", "calibration.generation", "ro", "") == od.CALIBRATION_GENERATION
    assert Array[float](0x2100, "f", "calibration.matrix", "rw", "N") == od.CALIBRATION_MATRIX
    assert od.TPDO1_COB_ID.encode(0x185) == b"\x85\x01\0\0"
    shown = [str(entry) for entry in (od.CALIBRATION_MATRIX[3], od.CALIBRATION_NOISE[12], od.STATUS)]
    assert shown == ["0x2100:03", "0x2106:0C", "0x2120:00"]


def test_errors_name_the_entry() -> None:
    with pytest.raises(InputError, match=r"calibration.lock \(0x2105:02\): 256 does not fit UNSIGNED8"):
        od.CALIBRATION_LOCK.encode(256)
    with pytest.raises(InputError, match=r"calibration.generation \(0x2103:04\): 1 bytes"):
        od.CALIBRATION_GENERATION.decode(b"\0")
    with pytest.raises(InputError, match="sub-index 0, allowed 1 to 254"):
        od.CALIBRATION_MATRIX[0]


@pytest.mark.parametrize("n", range(3, 9))
def test_counts_follow_the_number_of_gauges(n: int) -> None:
    arrays = (od.CALIBRATION_MATRIX, od.CALIBRATION_OFFSET, od.CALIBRATION_NOISE, od.PROCESS_VALUE, od.AUTOTARE)
    subs = {array.name: [entry.sub for entry in entries(n).values() if entry.stem == array.name] for array in arrays}
    assert [len(of_array) for of_array in subs.values()] == [3 * n, n, n * (n + 1) // 2, n + 6, 1]
    assert subs["autotare"] == [n + 1]
    assert subs["calibration.offset"] == list(range(1, n + 1))


@pytest.mark.parametrize(
    ("letter", "value", "data"),
    [
        ("B", 254, "fe"), ("H", 0x1234, "3412"), ("I", 0x65766173, "73617665"), ("h", -32768, "0080"),
        ("i", -2, "feffffff"), ("f", 1.0, "0000803f"), ("f", 3, "00004040"), ("s", "save", "73617665"),
        ("D", b"\x01\x02", "0102"), ("Q", 1, "0100000000000000"), ("u3", 0x123456, "563412"), ("i5", -2, "feffffffff"),
        ("t", bytes(range(6)), "000102030405"), ("f", 3.4025001647762064e38, "c5f97f7f"),
    ],
)  # fmt: skip
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
    again = types.parse_value("f", types.format_value("f", value))
    assert isinstance(again, float)
    assert struct.pack("<f", again) == data or math.isnan(again) == math.isnan(value) is True


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.sampled_from(sorted(types.TYPES)), st.binary(min_size=8, max_size=8))
def test_any_bytes_of_the_right_length_decode(letter: str, data: bytes) -> None:
    assert isinstance(types.decode(letter, data[: types.data_type(letter).size]), types.data_type(letter).python)


VALUES = [("B", 1.5), ("B", "1"), ("f", 1e39), ("f", "x"), ("s", 3), ("s", "gr\u00fc\u00df"), ("D", 3), ("D", "00")]
VALUES += [("u", "\udcff")]
TEXTS = [("B", "256"), ("B", "ten"), ("B", ""), ("f", "1,5"), ("f", "1e39"), ("D", "0g"), ("B", "1.0"), ("u", "\udcff")]


@pytest.mark.parametrize(("of", "refused"), [(types.encode, VALUES), (types.parse_value, TEXTS)])
def test_what_does_not_fit_says_what_is_allowed(of: Callable[..., object], refused: list[tuple[str, Any]]) -> None:
    for letter, value in refused:
        with pytest.raises(InputError, match=types.data_type(letter).name):
            of(letter, value)


def test_a_string_from_the_wire_is_never_refused_a_wrong_length_is() -> None:
    with pytest.raises(InputError, match=r"2 bytes .* for UNSIGNED32: allowed is 4"):
        types.decode("I", b"\0\0")
    assert types.decode("s", b"tip\xff\0\0") == "tip\\xff"
    assert types.decode("u", "tip".encode("utf-16-le")) == "tip"


@pytest.mark.parametrize(
    ("letter", "text", "value"),
    [
        ("B", "10", 10), ("B", " 0x0A ", 10), ("B", "010", 10), ("h", "-5", -5), ("?", "true", 1), ("?", "False", 0),
        ("f", "-1.5e-3", -1.5e-3), ("f", "inf", math.inf), ("s", "any text", "any text"),
        ("D", "DE AD 01", b"\xde\xad\x01"), ("D", "0xdead01", b"\xde\xad\x01"), ("D", "", b""),
    ],
)  # fmt: skip
def test_parse_value(letter: str, text: str, value: types.Value) -> None:
    assert types.parse_value(letter, text) == value
    assert str(types.parse_value("f", "NaN")) == "nan"
    assert (types.format_value("D", b"\xde\xad"), types.format_value("f", 180.0)) == ("DE AD", "180.0")


def test_words_of_cia_309_3() -> None:
    for word in ("b", "i8", "i16", "i32", "u8", "u16", "u32", "r32", "vs", "os", "d"):
        assert types.data_type(types.letter_of_word(word)).word == word
    assert types.letter_of_word("U16") == "H"
    with pytest.raises(InputError, match="u16"):
        types.letter_of_word("word")
    with pytest.raises(InputError, match="allowed are"):
        types.data_type("Z")
