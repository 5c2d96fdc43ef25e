"""The canopen library reads the same files: its values, from the file and over SDO, are the device's."""

from __future__ import annotations

import re
from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from canopen_device.eds import read_eds
from canopen_device.eds.load import device_of
from canopen_device.testing import MemoryStore
from canopen_device.types import LETTER_OF_CODE
from device.test_canopen_client import Client
from eds.samples import INFO, Talk, described, pdo, record, text, var

LIVE = (0x1003, 0x1013, 0x1021)  # the error history, the clock, the file itself
ROOT = Path(__file__).parents[2]
COMPACT = "[2100]\nParameterName=Gain\nObjectType=8\nDataType=6\nAccessType=rw\nDefaultValue=7\nCompactSubObj=4\n"
GENERATED = text(
    var("1005", 7, "rw", "0x80"), var("1008", 9, "const", "Drive"), var("1014", 7, "rw", "$NODEID+0x80"),
    var("1017", 6, "rw", "0"), var("2000", 0x15, "rw", "-5"), var("2001", 0x11, "rw", "2.5"), var("2002", 1, "rw", "1"),
    var("2003", 0x10, "rw", "-3"), var("2004", 3, "rw", "-7"), COMPACT, pdo(0x1800, "$NODEID+0x180", 1, 0x20000040),
    record("2200", var("2200sub0", 5, "ro", "2"), var("2200sub1", 9, "ro", "text"), var("2200sub2", 0xA, "rw", "0102")),
    info=INFO + "NrOfTXPDO=1\n[DummyUsage]\n" + "".join(f"Dummy000{k}=1\n" for k in range(1, 8)),
)  # fmt: skip


def variables(od: canopen.ObjectDictionary) -> list[ODVariable]:
    found: list[ODVariable] = []
    for one in od.values():
        found += [one] if isinstance(one, ODVariable) else [one[k] for k in one.subindices]
    return found


@pytest.mark.parametrize("name", ["generated", "tipforce-3.eds"])
def test_each_object_has_the_value_that_canopen_expects(name: str, tmp_path: Path) -> None:
    path = ROOT / "eds" / name
    if name == "generated":
        path = tmp_path / "generated.eds"
        path.write_text(GENERATED)
    found = read_eds(path, 5)
    assert found.warnings == []
    client = Client(device=device_of(found))
    expected = canopen.import_od(str(path), 5)
    remote = client.network.add_node(5, expected)
    compared = 0
    for variable in variables(expected):
        if variable.access_type == "wo" or variable.default is None or variable.index in LIVE:
            continue
        one = remote.sdo[variable.index]
        read = one.raw if isinstance(expected[variable.index], ODVariable) else one[variable.subindex].raw
        wanted = variable.decode_raw(variable.encode_raw(variable.default))  # as its type can hold it
        assert read == wanted, f"{variable.index:04X}:{variable.subindex}"
        compared += 1
    assert compared > (20 if name == "generated" else 400)
    client.network.disconnect()


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


def test_every_spelling_of_every_type(tmp_path: Path) -> None:
    found = described(tmp_path, CONTENT)
    assert len(found.objects) == len(PLACES) + 3
    talk = Talk(found, MemoryStore())
    for entry in found.entries():
        assert isinstance(talk.upload(entry.index, entry.sub), bytes), entry
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
