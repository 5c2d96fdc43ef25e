"""The canopen library reads the same file, and each object from the device: what it expects is what it gets."""

from __future__ import annotations

from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from device.test_canopen_client import Client
from eds.samples import INFO, pdo, record, text, var
from tipforce.eds import read_eds
from tipforce.eds.load import device_of

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
