"""What is generated from the dictionary: fresh, and read by canopen (EDS, DCF) and cantools (DBC) as the table says."""

import math
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from canopen_device import types
from canopen_device.eds import read_eds
from canopen_device.eds.sections import parse
from tipforce.dictionary import generate, table
from tipforce.dictionary.dbc import dbc_text
from tipforce.dictionary.eds import access_text, dcf_text, eds_text
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.generate import reference_markdown
from tipforce.dictionary.names import entries, objects
from tipforce.dictionary.signals import rpdo_messages, tpdo_messages
from tipforce.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
ALL = [(n, simulated) for n in range(3, 9) for simulated in (False, True)]
NODE_ID = 5
VALUES: dict[tuple[int, int], types.Value] = {
    (0x1017, 0): 500, (0x1800, 1): 0x40000185, (0x2100, 4): -0.25, (0x2102, 1): 77, (0x2110, 6): 1, (0x7133, 1): -3,
    (0x2141, 0): b"\x01\xfe", (0x6134, 1): math.inf,
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(generate.generated_files()))
def test_committed_files_are_fresh(name: str) -> None:
    expected = generate.generated_files()[name].encode("ascii")
    assert (ROOT / name).read_bytes() == expected, f"{name} is stale: run `make generate`"


def test_writes_what_differs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate.main([str(tmp_path)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(generate.generated_files())
    assert generate.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == ""
    assert generate.main(["a", "b"]) == 2
    assert "usage" in capsys.readouterr().err


@pytest.mark.parametrize("n", [3, 8])
def test_reference_names_everything(n: int) -> None:
    text = reference_markdown(n)
    for found in objects(n, True, programs=True):
        assert f"{found.index:04X}h" in text
        for row in found.entries:
            shown = f"`{row.stem}:" if row.is_counted else f"`{row.stem}`"
            assert not row.stem or row.flags & table.VIEW or shown in text, row.name
    for message in tpdo_messages(n):
        assert f"## TPDO{message.number} {message.name.lower()}\n" in text
        assert all(f"`{signal.name}`" in text for signal in message.signals)
    assert all(line.endswith("|") for line in [line for line in text.splitlines() if line.startswith("|")])
    assert "\n\n\n" not in text


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


def test_device_information(tmp_path: Path) -> None:
    information = _import(eds_text(5, True), tmp_path).device_information
    identity = (information.vendor_number, information.product_number, information.revision_number)
    assert identity == (0, 0x54500105, table.REVISION)
    assert (information.nr_of_RXPDO, information.nr_of_TXPDO, information.LSS_supported) == (1, 5, True)
    assert (information.simple_boot_up_slave, information.simple_boot_up_master) == (True, False)
    assert information.allowed_baudrates == {k * 1000 for k in (10, 20, 50, 125, 250, 500, 800, 1000)}


def test_commands_are_not_downloaded_what_is_write_only_not_scanned_and_real32_has_limits() -> None:
    eds = parse(eds_text(3, True).encode())
    for index, sub, key, value in (
        (0x2104, 0, "ObjFlags", "0x3"), (0x1010, 1, "ObjFlags", "0x1"), (0x2100, 1, "ObjFlags", None),
        (0x2105, 1, "LowLimit", "1.0"), (0x2105, 1, "HighLimit", "1e+30"),
    ):  # fmt: skip
        section = eds.entry(index, sub)
        assert section is not None
        assert section.get(key) == value


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
    od = _import(dcf_text(8, 127, values, True), tmp_path, None, "dcf")
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


@cache
def _load() -> Any:
    import cantools  # slow, and only this file needs it

    return cantools.database.load_string(dbc_text(), "dbc", strict=True)


def test_messages_and_nodes() -> None:
    db = _load()
    frames = {m.name: m.frame_id for m in db.messages}
    assert len(frames) == len(set(frames.values())) == 15 * 7 + 2
    assert [n.name for n in db.nodes] == ["HOST"] + [f"TIP{k:02d}" for k in range(1, 16)]
    names = ("TIP05_Gauges", "TIP05_Contact", "TIP05_Force", "TIP05_Health", "TIP05_Command", "TIP05_EMCY")
    assert [frames[name] for name in names] == [0x185, 0x285, 0x385, 0x485, 0x205, 0x085]
    assert (frames["TIP15_Heartbeat"], frames["NMT"], frames["SYNC"]) == (0x70F, 0, 0x80)
    assert db.get_message_by_name("SYNC").length == 0
    assert db.get_message_by_name("TIP05_Contact").senders == ["TIP05"]
    assert db.get_message_by_name("TIP05_Command").senders == ["HOST"]


def test_layout_is_that_of_the_signals_module() -> None:
    db = _load()
    for pdo in tpdo_messages(3) + rpdo_messages():
        message = db.get_message_by_name(f"TIP09_{pdo.name}")
        assert (message.frame_id, message.length) == (pdo.cob_id_base + 9, pdo.length_bytes)
        assert len(message.signals) == len(pdo.signals)
        for signal in pdo.signals:
            found = message.get_signal_by_name(signal.name)
            assert (found.start, found.length, found.is_signed) == (signal.start_bit, signal.bits, signal.signed)
            assert (found.scale, found.minimum, found.maximum) == (signal.scale, signal.minimum, signal.maximum)
            assert (found.unit or "") == signal.unit
            assert found.comment == signal.description
            if signal.unknown is not None:
                assert {int(k): str(v) for k, v in found.choices.items()} == {signal.unknown: "unknown"}
                assert "unknown" in found.comment


@pytest.mark.parametrize(
    ("name", "data", "values", "flags"),
    [
        ("TIP05_Contact", "F401E80300800305", {"P": 0.5, "phi": 10.0, "theta": "unknown", "counter": 5},
         {"contact", "calibrated"}),
        ("TIP01_Health", "0080FFFF02050711",
         {"temperature": "unknown", "u_P": "unknown", "configuration_counter": 7, "error_register": 0x11},
         {"SG2_fault", "fault_no_data", "fault_wire_break"}),
        ("TIP01_Health", "0B090C0000000000", {"temperature": 23.15, "u_P": 0.012}, set()),
        ("TIP03_Heartbeat", "05", {"state": "operational"}, set()),
        ("TIP03_Heartbeat", "7F", {"state": "pre-operational"}, set()),
        ("TIP03_Heartbeat", "85", {"state": "operational"}, {"toggle"}),
        ("TIP03_EMCY", "1050810102030405", {"error_code": "gauge saturated", "error_register": 0x81}, set()),
        ("TIP03_EMCY", "0000000102030405", {f"manufacturer_{k}": k for k in range(1, 6)}, set()),
        ("NMT", "0100", {"command": "start", "node": "all"}, set()),
        ("TIP03_Command", "0300", {"command": "zero gauges"}, set()),
    ],
)  # fmt: skip
def test_frames_by_hand(name: str, data: str, values: dict[str, Any], flags: set[str]) -> None:
    message = _load().get_message_by_name(name)
    decoded = message.decode(bytes.fromhex(data))
    for key, value in values.items():
        assert decoded[key] == (value if isinstance(value, str) else pytest.approx(value)), key
    assert {signal.name for signal in message.signals if signal.length == 1 and decoded[signal.name]} == flags


@pytest.mark.parametrize("n", range(3, 9))
def test_other_hands(n: int) -> None:
    import cantools

    db: Any = cantools.database.load_string(dbc_text([1, 127], n), "dbc", strict=True)
    assert {m.name for m in db.messages if m.name.startswith("TIP127_")} == {
        f"TIP127_{name}" for name in ("Gauges", "Contact", "Force", "Health", "Command", "EMCY", "Heartbeat")
    }


@pytest.mark.parametrize("ids", [[0], [128], [1, 1]])
def test_node_ids_outside(ids: list[int]) -> None:
    with pytest.raises(InputError, match=f"node-id {ids[0]}: allowed are 1 to 127, each once"):
        dbc_text(ids)
