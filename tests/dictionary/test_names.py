"""What people write resolves to what they mean, or to help."""

from __future__ import annotations

import pytest

from tipforce.dictionary import entries as names
from tipforce.dictionary.entries import entries
from tipforce.errors import InputError


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("calibration.generation", (0x2103, 4)),
        (" Calibration.Generation ", (0x2103, 4)),
        ("calibration.matrix:3", (0x2100, 3)),
        ("calibration.matrix.3", (0x2100, 3)),
        ("calibration.matrix:03", (0x2100, 3)),
        ("0x2103:04", (0x2103, 4)),
        ("0x2103:4", (0x2103, 4)),
        ("0x2103:0x04", (0x2103, 4)),
        ("2103h:04h", (0x2103, 4)),
        ("0x2103:00", (0x2103, 0)),
        ("0x2120", (0x2120, 0)),
        ("2120h", (0x2120, 0)),
        ("status", (0x2120, 0)),
        ("u_p", (0x2123, 0)),
        ("0x1A00:0", (0x1A00, 0)),
        ("tpdo1.mapping:2", (0x1A00, 2)),
        ("simulation.fault", (0x2200, 1)),
    ],
)
def test_resolves(text: str, place: tuple[int, int]) -> None:
    entry = names.resolve(text)
    assert (entry.index, entry.sub) == place


def test_sub_indices_are_decimal_after_a_name_and_hexadecimal_after_an_index() -> None:
    assert names.resolve("calibration.matrix:10", 4).sub == 10
    assert names.resolve("0x2100:0A", 4).sub == 10
    assert names.resolve("0x2106:10", 8).sub == 16


@pytest.mark.parametrize("n", [3, 5, 8])
def test_every_entry_resolves_from_both_of_its_names(n: int) -> None:
    for (index, sub), row in entries(n, True).items():
        for text in (row.name, f"0x{index:04X}:{sub:02X}"):
            entry = names.resolve(text, n)
            assert (entry.index, entry.sub, entry.type, entry.name) == (index, sub, row.type, row.name)


@pytest.mark.parametrize(
    ("text", "help_"),
    [
        ("calibraton.matrx:3", "calibration.matrix"),
        ("generation", "calibration.generation"),
        ("temprature", "temperature"),
        ("xyzzy", "write a name such as"),
        ("", "write a name such as"),
        ("8451", "write a name such as"),
        ("calibration.matrix", "SUB is 1-9"),
        ("calibration.matrix:10", "SUB is 1-9"),
        ("autotare:1", "SUB is 4"),
        ("0x2100:10", r"no sub-index 16 \(0x10\); allowed, in hex, with 3 gauges: 00-09"),
        ("0x1800:04", "00-03, 05-06"),
        ("0x2103", "several sub-indices"),
        ("0x2999", "no object 0x2999.*nearest"),
    ],
)
def test_suggestions(text: str, help_: str) -> None:
    with pytest.raises(InputError, match=help_):
        names.resolve(text)


def test_describe() -> None:
    found = names.describe(0x7130, 7)
    assert found is not None
    assert (found.title, found.name, found.type, found.access) == ("P", "process_value_int16:7", "h", "ro")
    assert names.describe(0x2100, 10, 3) is None
    assert names.describe(0x2100, 10, 4) is not None
    assert names.describe(0x5000, 0) is None


def test_all_names() -> None:
    found = names.all_names(3)
    assert len(set(found)) == len(found)
    assert {"calibration.generation", "calibration.matrix:9"} <= set(found)
    assert "calibration.matrix:10" not in found
