"""The EDS and DCF as canopen reads them, entry by entry against the table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from canopen_device import types
from canopen_device.eds import read_eds
from canopen_device.eds.sections import parse
from tipforce.dictionary import table
from tipforce.dictionary.eds import access_text, dcf_text, eds_text
from tipforce.dictionary.entries import Entry, entries, objects
from tipforce.errors import InputError

ALL = [(n, simulated) for n in range(3, 9) for simulated in (False, True)]
NODE_ID = 5


def _import(text: str, folder: Path, node_id: int | None = NODE_ID, suffix: str = "eds") -> Any:
    import canopen.objectdictionary as reader  # slow, and only this file needs it

    path = folder / f"node.{suffix}"
    path.write_bytes(text.encode("ascii"))
    loaded: Any = reader.import_od
    return loaded(str(path), node_id)


@pytest.mark.parametrize(("n", "simulated"), ALL)
def test_canopen_reads_what_the_table_says(n: int, simulated: bool, tmp_path: Path) -> None:
    od = _import(eds_text(n, simulated), tmp_path)
    assert read_eds(tmp_path / "node.eds", NODE_ID).warnings == []
    assert sorted(od.indices) == [found.index for found in objects(n, simulated)]
    for found in objects(n, simulated):
        entry = od[found.index]
        if found.code == table.VAR:
            _compare(entry, found.entries[0])
            continue
        assert type(entry).__name__ == ("ODArray" if found.code == table.ARRAY else "ODRecord")
        assert sorted(entry.subindices) == [row.sub for row in found.entries]
        for row in found.entries:
            _compare(entry.subindices[row.sub], row)


def _compare(variable: Any, row: Entry[Any]) -> None:
    assert variable.name == row.title
    assert variable.data_type == types.data_type(row.type).code
    assert variable.access_type == access_text(row)
    assert variable.access_type in (row.access, "rww", "rwr")
    assert variable.pdo_mappable == row.mappable
    if row.type == "D":
        assert variable.default == b""
    elif row.flags & table.ADD_NODE_ID:
        assert variable.relative
        assert variable.default == int(row.default) + NODE_ID
    else:
        assert variable.default == row.default
        assert variable.encode_raw(variable.default) == types.encode(row.type, row.default)
    # canopen drops the limits of REAL32
    assert (variable.min, variable.max) == ((None, None) if row.type == "f" else (row.low, row.high))


def test_limits_of_real32_are_written() -> None:
    section = parse(eds_text()).entry(0x2105, 1)
    assert section is not None
    assert (section.get("LowLimit"), section.get("HighLimit")) == ("1.0", "1e+30")


def test_device_information(tmp_path: Path) -> None:
    information = _import(eds_text(5, True), tmp_path).device_information
    assert information.vendor_number == 0
    assert information.product_number == 0x54500105
    assert information.revision_number == table.REVISION
    assert (information.nr_of_RXPDO, information.nr_of_TXPDO) == (1, 5)
    assert information.LSS_supported
    assert information.simple_boot_up_slave
    assert not information.simple_boot_up_master
    assert information.allowed_baudrates == {k * 1000 for k in (10, 20, 50, 125, 250, 500, 800, 1000)}


def test_commands_are_not_downloaded_and_what_is_write_only_not_scanned() -> None:
    eds = parse(eds_text(3, True))

    def flags(index: int, sub: int) -> str | None:
        section = eds.entry(index, sub)
        assert section is not None
        return section.get("ObjFlags")

    assert flags(0x2104, 0) == "0x3"
    assert flags(0x1010, 1) == "0x1"
    assert flags(0x2100, 1) is None


VALUES: dict[tuple[int, int], types.Value] = {
    (0x1017, 0): 500,
    (0x1800, 1): 0x40000185,
    (0x2100, 4): -0.25,
    (0x2102, 1): 77,
    (0x2110, 6): 1,
    (0x7133, 1): -3,
    (0x2141, 0): b"\x01\xfe",
    (0x6134, 1): math.inf,
}


def test_dcf(tmp_path: Path) -> None:
    text = dcf_text(3, 7, VALUES)
    od = _import(text, tmp_path, None, "dcf")
    assert (od.node_id, od.bitrate) == (7, 1_000_000)
    for (index, sub), value in VALUES.items():
        assert od.get_variable(index, sub).value == value
    assert od.get_variable(0x1014).default == 0x87
    assert od.get_variable(0x1018, 2).value is None
    assert text.count("ParameterValue=") == len(VALUES)
    assert "NodeName=TIP07\n" in text
    assert "LastEDS=tipforce-3.eds\n" in text
    assert read_eds(tmp_path / "node.dcf").warnings == []


def test_dcf_of_every_default(tmp_path: Path) -> None:
    values: dict[tuple[int, int], types.Value] = {
        place: row.default for place, row in entries(8, True).items() if row.type != "D" and "w" in row.access
    }
    text = dcf_text(8, 127, values, True)
    od = _import(text, tmp_path, None, "dcf")
    for place, value in values.items():
        wire = types.encode(entries(8, True)[place].type, value)
        variable = od.get_variable(*place)
        assert variable.encode_raw(variable.value) == wire


@pytest.mark.parametrize(
    ("n", "node_id", "values", "said"),
    [
        (3, 0, {}, "node-id 0: allowed are 1 to 127"),
        (3, 128, {}, "node-id 128"),
        (2, 5, {}, "allowed 3 to 8"),
        (3, 5, {(0x2100, 10): 1.0}, "0x2100:0A: no such object with 3 gauges"),
        (3, 5, {(0x2200, 1): 1}, "0x2200:01: no such object"),
        (3, 5, {(0x1017, 0): -1}, "heartbeat.producer_ms.*allowed are 0 to 65535"),
        (3, 5, {(0x2110, 6): 2}, "contact.load_sense.*2, allowed are 0 to 1"),
        (3, 5, {(0x2105, 1): math.nan}, "calibration.condition_limit.*nan, allowed are 1.0"),
    ],
)
def test_dcf_refuses(n: int, node_id: int, values: dict[tuple[int, int], types.Value], said: str) -> None:
    with pytest.raises(InputError, match=said):
        dcf_text(n, node_id, values)
