"""Entries, arrays and the generated constants against the table."""

from __future__ import annotations

from typing import Any

import pytest

from canopen_device import types
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Array, Entry, entries
from tipforce.dictionary.generate import constant_name
from tipforce.errors import InputError

CONSTANTS: dict[str, Any] = {k: v for k, v in vars(od).items() if isinstance(v, Entry | Array)}


def test_constants_agree_with_the_table() -> None:
    rows = [row for row in entries(3, True, True).values() if constant_name(row.stem) in CONSTANTS]
    assert {constant_name(row.stem) for row in rows} == set(CONSTANTS)
    for row in rows:
        constant = CONSTANTS[constant_name(row.stem)]
        assert isinstance(constant, Array) == row.is_counted, row.name
        entry = constant[row.sub] if row.is_counted else constant
        expected = (row.index, row.sub, row.type, row.name, row.access, row.unit)
        assert (entry.index, entry.sub, entry.type, entry.name, entry.access, entry.unit) == expected


def test_typed_use() -> None:
    generation: int = od.CALIBRATION_GENERATION.decode(b"\x05\0\0\0")
    first: float = od.CALIBRATION_MATRIX[1].decode(bytes.fromhex("0000803f"))
    name: str = od.DEVICE_NAME.decode(b"tipforce fingertip")
    record: bytes = od.CALIBRATION_ACTIVE_RECORD.decode(b"\1\2")
    assert (generation, first, name, record) == (5, 1.0, "tipforce fingertip", b"\1\2")
    assert Entry[int](0x2103, 4, "I", "calibration.generation", "ro", "") == od.CALIBRATION_GENERATION
    assert Array[float](0x2100, "f", "calibration.matrix", "rw", "N") == od.CALIBRATION_MATRIX
    assert od.TPDO1_COB_ID.encode(0x185) == b"\x85\x01\0\0"


def test_text() -> None:
    assert str(od.CALIBRATION_MATRIX[3]) == "0x2100:03"
    assert str(od.CALIBRATION_NOISE[12]) == "0x2106:0C"
    assert str(od.STATUS) == "0x2120:00"


def test_errors_name_the_entry() -> None:
    with pytest.raises(InputError, match=r"calibration.lock \(0x2105:02\): 256 does not fit UNSIGNED8"):
        od.CALIBRATION_LOCK.encode(256)
    with pytest.raises(InputError, match=r"calibration.generation \(0x2103:04\): 1 bytes"):
        od.CALIBRATION_GENERATION.decode(b"\0")
    with pytest.raises(InputError, match="sub-index 0, allowed 1 to 254"):
        od.CALIBRATION_MATRIX[0]


@pytest.mark.parametrize("n", range(3, 9))
def test_counts_follow_the_number_of_gauges(n: int) -> None:
    assert len([*od.CALIBRATION_MATRIX.entries(n)]) == 3 * n
    assert len([*od.CALIBRATION_OFFSET.entries(n)]) == n
    assert len([*od.CALIBRATION_NOISE.entries(n)]) == n * (n + 1) // 2
    assert len([*od.PROCESS_VALUE.entries(n)]) == n + 6
    assert [entry.sub for entry in od.AUTOTARE.entries(n)] == [n + 1]
    assert [e.sub for e in od.CALIBRATION_OFFSET.entries(n)] == list(range(1, n + 1))


def test_count_errors() -> None:
    with pytest.raises(InputError, match="allowed 3 to 8"):
        len([*od.CALIBRATION_MATRIX.entries(9)])


def test_every_constant_has_the_python_type_of_its_letter() -> None:
    for row in entries(3, True, True).values():
        value = b"" if row.type == "D" else row.default
        assert isinstance(value, types.data_type(row.type).python), row.name
