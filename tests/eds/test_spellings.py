"""Each data type with each spelling of a value: it loads, answers SDO, and has canopen's value or a warning."""

from __future__ import annotations

import re
from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from eds.samples import Talk, described, text, var
from tipforce.dictionary.types import LETTER_OF_CODE

SPELLINGS = (
    "", "0", "1", "-1", "-128", "0x7F", "0XFF", "255", "256", "0xFFFFFFFF", "-2147483649", "18446744073709551616",
    "$NODEID+0x60", "$NODEID + 0x60", "0x60+$nodeid", "$NodeId", "($NODEID+0x80)", "$NODEID*2", "1.5", "1e3", "nan",
    "-inf", "0x3FC00000", "text here", "01 02 03", "010203", "0102 0", "5 ; five", "5 # five", "0x", "0x1G", "--1",
    "+5", "1_000", "\u0663", "\u00b2", "\u00e9",
)  # fmt: skip
KINDS = (*sorted(LETTER_OF_CODE), 0x0E, 0x17, 0xFF)
PLACES = {0x2000 + 64 * k + n: (kind, spelling) for k, kind in enumerate(KINDS) for n, spelling in enumerate(SPELLINGS)}
CONTENT = text(*(var(f"{index:04X}", kind, "rw", spelling) for index, (kind, spelling) in PLACES.items()))


def about(warnings: list[str]) -> set[int]:
    """The indices of the objects that warnings name."""
    return {int(match[1], 16) for match in (re.match(r"any\.eds:\d+: \[(\w{4})\]", line) for line in warnings) if match}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-be-sig"])
def test_every_spelling_of_every_type(encoding: str, tmp_path: Path) -> None:
    big = encoding == "utf-16-be-sig"
    content = b"\xfe\xff" + CONTENT.encode("utf-16-be") if big else CONTENT.encode(encoding)
    found = described(tmp_path, content)
    assert len(found.objects) == len(PLACES) + 3
    talk = Talk(found, {})
    for entry in found.entries():
        assert isinstance(talk.read(entry.index, entry.sub), bytes), entry
    assert all(re.match(r"any\.eds(:\d+)?: ", line) for line in found.warnings)
    assert {index for index, (kind, _) in PLACES.items() if kind not in LETTER_OF_CODE} <= about(found.warnings)


def test_values_are_those_of_canopen_or_are_reported(tmp_path: Path) -> None:
    found = described(tmp_path, CONTENT)
    warned = about(found.warnings)
    plain = {index: place for index, place in PLACES.items() if index not in warned and place[1]}
    path = tmp_path / "plain.eds"
    path.write_text(text(*(var(f"{index:04X}", kind, "rw", spelling) for index, (kind, spelling) in plain.items())))
    expected = canopen.import_od(str(path), 5)
    compared = 0
    for index, (kind, spelling) in plain.items():
        variable, ours = expected[index], found.find(index).default
        assert isinstance(variable, ODVariable)
        if not (isinstance(variable.default, int | float) and isinstance(ours, int | float)):
            continue
        same = ours == pytest.approx(variable.default, rel=1e-7, nan_ok=True)
        # canopen takes the bits of a REAL for a whole number, and leaves an INTEGER in hexadecimal without its sign.
        bits = spelling.lower().startswith("0x") and (isinstance(ours, float) or ours < 0)
        assert same or bits, (kind, spelling)
        compared += 1
    assert compared > 150
