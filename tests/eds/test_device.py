"""Devices made of EDS files: objects, PDOs, storage; each feature of CiA 306-1, and what the device then does."""

import math
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import pytest

import canopen_device
from canopen_device.core import codes
from canopen_device.core.emcy import GENERIC
from canopen_device.core.storage import with_crc
from canopen_device.eds.dcf import dcf_text
from canopen_device.eds.description import VAR
from canopen_device.errors import InputError
from canopen_device.testing import Conversation, MemoryStore
from canopen_device.types import Value
from eds.samples import INFO, Talk, described, pdo, record, sound, text, var

SYNC = var("1005", 7, "rw", "0x80")
DCF = "[DeviceComissioning]\nNodeID=0x0B\nNodeName=axis\nBaudrate=500\nLSS_SerialNumber=77\n"


def test_bits_are_packed_and_unpacked(tmp_path: Path) -> None:
    outputs = [0x20000001, 0x20010001, 0x20020010, 0x20030008]
    found = sound(
        tmp_path,
        text(
            SYNC, var("2000", 1, "rw", "1"), var("2001", 1, "rw", "0"), var("2002", 6, "rw", "0x8001"),
            var("2003", 1, "rw", "1"),
            pdo(0x1800, "$NODEID+0x180", 1, *outputs), pdo(0x1400, "$NODEID+0x200", 255, *outputs),
        ),
    )  # fmt: skip
    talk = Talk(found)
    talk.nmt(1)
    word = 1 | 0 << 1 | 0x8001 << 2 | 1 << 18
    assert talk.step([(0x80, b"")]) == [(0x185, word.to_bytes(4, "little"))]
    talk.sent.clear()
    talk.step([(0x205, (2 | 0x1234 << 2 | 0 << 18).to_bytes(4, "little"))])
    assert [talk.upload(0x2000 + k) for k in range(4)] == [b"\0", b"\1", b"\x34\x12", b"\0"]


def test_wide_integers_reals_and_strings_in_pdos(tmp_path: Path) -> None:
    found = sound(
        tmp_path,
        text(
            SYNC, var("2000", 0x10, "rw", "-2"), var("2001", 8, "rw", "1.5"), var("2002", 0x1B, "rw", "258"),
            var("2003", 9, "rw", "ab"), pdo(0x1800, "$NODEID+0x180", 1, 0x20000018, 0x20010020),
            pdo(0x1801, "$NODEID+0x280", 1, 0x20020040), pdo(0x1802, "$NODEID+0x380", 1, 0x20030020),
        ),
    )  # fmt: skip
    talk = Talk(found)
    talk.nmt(1)
    assert talk.step([(0x80, b"")]) == [
        (0x185, b"\xfe\xff\xff" + struct.pack("<f", 1.5)), (0x285, struct.pack("<Q", 258)), (0x385, b"ab\0\0"),
    ]  # fmt: skip


def test_sync_production_with_a_counter(tmp_path: Path) -> None:
    objects = (
        SYNC, var("1006", 7, "rw", "1000"), var("1019", 5, "rw", "3"), var("2000", 5, "rw", "7"),
        pdo(0x1800, "$NODEID+0x180", 2, 0x20000008),
        record("1029", var("1029sub0", 5, "const", "1"), var("1029sub1", 5, "rw", "1")),  # bus-off: no change of state
    )  # fmt: skip
    talk: Conversation = Talk(described(tmp_path, text(*objects)))
    talk.say("""\
        > 000#0105
        + 5000
        > 605#2305100080000040    bit 30 of 1005h: produce
        < 585#6005100000000000
        + 999
        + 1
        < 080#01
        + 1000
        < 080#02
        < 185#07
        > 605#2305100081000040    another identifier while producing: refused
        < 585#8005100030000906
        > 605#2F19100000000000    the counter while 1006h is set: refused
        < 585#8019100022000008
        + 1000
        < 080#03
        + 1000
        < 080#01
        < 185#07
        > 000#0205
        + 3000
        > 000#0105
        + 1000
        < 080#01                  starts again at 1
    """)
    talk.step([(codes.ERROR_FLAG | 0x40, bytes(8))])  # bus-off: neither SYNC 2 nor the TPDO on it is sent later
    talk.say("""\
        + 1000
        > 605#2306100000000000
        < 585#6006100000000000
        + 9000
    """)


def test_parameters_are_stored_in_their_groups(tmp_path: Path) -> None:
    stores = record("1010", var("1010sub0", 5, "ro", "4"), *(var(f"1010sub{k}", 7, "rw", "1") for k in (1, 2, 3, 4)))
    content = text(stores, var("2000", 5, "rw", "1"), var("6000", 5, "rw", "1"), var("1017", 6, "rw", "0"))
    found = described(tmp_path, content)
    assert Talk(found).download(0x1010, 1, b"save") == codes.HARDWARE  # nowhere to store
    talk = Talk(found, MemoryStore())
    assert talk.upload(0x1010, 0) == b"\4"  # ro in the file, as in most files
    assert talk.upload(0x1010, 4) == b"\1\0\0\0"
    for index in (0x2000, 0x6000):
        assert talk.download(index, 0, b"\x09") == 0
    assert talk.download(0x1010, 4, b"save") == 0
    talk.step([(0, b"\x81\x05")])
    talk.sent.clear()
    assert talk.upload(0x2000) == b"\x09"
    assert talk.upload(0x6000) == b"\1"


def test_the_error_history_is_as_long_as_1003h(tmp_path: Path) -> None:
    history = "[1003]\nParameterName=Errors\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=20\n"
    talk = Talk(described(tmp_path, text(history)))
    for code in range(0xFF00, 0xFF20):
        talk.device.emcy.raise_error(code, GENERIC)
    assert talk.upload(0x1003, 0) == b"\x14"
    assert talk.upload(0x1003, 20) == struct.pack("<I", 0xFF0C)
    assert talk.download(0x1003, 0, b"\0") == 0
    assert talk.upload(0x1003, 20) == codes.NO_DATA
    assert talk.upload(0x1003, 21) == codes.NO_SUB


def test_a_tpdo_that_allows_remote_requests_can_be_reconfigured(tmp_path: Path) -> None:
    talk = Talk(described(tmp_path, text(var("2000", 5), pdo(0x1800, "$NODEID+0x180", 255, 0x20000008))))
    assert talk.download(0x1800, 1, struct.pack("<I", 0x80000185)) == 0
    assert talk.download(0x1800, 1, struct.pack("<I", 0x185)) == 0


EVERY_TYPE = (
    (0x01, "1", "01"), (0x02, "-2", "fe"), (0x03, "0xFFFE", "feff"), (0x04, "-3", "fdffffff"), (0x05, "0xA5", "a5"),
    (0x06, "513", "0102"), (0x07, "0x01020304", "04030201"), (0x08, "1.5", "0000c03f"),
    (0x08, "0x3FC00000", "0000c03f"),
    (0x09, "Drive 7", b"Drive 7".hex()), (0x0A, "0A 0B", "0a0b"), (0x0B, "ab", "61006200"),
    (0x0C, "010203040506", "010203040506"), (0x0D, "0x10", "100000000000"), (0x0F, "0102", "0102"),
    (0x10, "-1", "ffffff"), (0x11, "2.5", struct.pack("<d", 2.5).hex()), (0x12, "-1", "ff" * 5),
    (0x13, "1", "01" + "00" * 5),
    (0x14, "-1", "ff" * 7), (0x15, "-1", "ff" * 8), (0x16, "0x123456", "563412"), (0x18, "1", "0100000000"),
    (0x19, "1", "01" + "00" * 5), (0x1A, "1", "01" + "00" * 6), (0x1B, "0x8000000000000001", "01" + "00" * 6 + "80"),
)  # fmt: skip


def test_every_data_type_is_read_and_written(tmp_path: Path) -> None:
    found = sound(tmp_path, text(*(var(f"{0x2000 + k:04X}", t, "rw", v) for k, (t, v, _) in enumerate(EVERY_TYPE))))
    talk = Talk(found)
    for k, (_, _, wire) in enumerate(EVERY_TYPE):
        index, data = 0x2000 + k, bytes.fromhex(wire)
        assert talk.upload(index) == data, f"{index:04X}"
        assert talk.download(index, 0, bytes(len(data))) == 0
        assert talk.upload(index) == bytes(len(data))
        fixed = found.objects[index].entries[0].type.size is not None
        assert (talk.download(index, 0, data + b"\0") == codes.TOO_LONG) is fixed
        large = bytes(range(256)) * 40
        assert fixed or (talk.download(index, 0, large), talk.upload(index)) == (0, large)


@pytest.mark.parametrize(
    "expression", ["$NODEID+0x180", "0x180+$NODEID", " $NODEID + 0x180 ", "384+$NODEID", "0x100+$NODEID+0x80"]
)
def test_node_id_expressions_follow_the_node_id(tmp_path: Path, expression: str) -> None:
    found = sound(tmp_path, text(var("2000", 7, "rw", expression)), 9)
    assert found.find(0x2000).default == 0x189
    talk = Talk(found)
    assert talk.device.od.values[0x200000] == 0x189
    talk.device.lss.pending_node_id = 7
    talk.step([(0, b"\x81\x09")])
    assert talk.device.od.values[0x200000] == 0x187


COMPACT = (
    "[2100]\nParameterName=Gain\nObjectType=8\nDataType=6\nAccessType=rw\nDefaultValue=7\nPDOMapping=1\n"
    "CompactSubObj=4\nHighLimit=99\n[2100Name]\nNrOfEntries=1\n2=Second\n[2100Value]\nNrOfEntries=2\n3=0x33\n4=9\n"
    "[2100Denotation]\nNrOfEntries=1\n1=left\n"
)


def test_compact_arrays_have_names_values_and_denotations(tmp_path: Path) -> None:
    found = sound(tmp_path, text(COMPACT))
    entries = found.objects[0x2100].entries
    assert [entries[k].name for k in (1, 2, 3)] == ["Gain1", "Second", "Gain3"]
    assert [entries[k].initial for k in range(5)] == [4, 7, 7, 0x33, 9]
    assert entries[1].denotation == "left"
    talk = Talk(found)
    assert talk.upload(0x2100, 0) == b"\4"
    assert talk.upload(0x2100, 4) == b"\x09\0"
    assert talk.download(0x2100, 0, b"\1") == codes.READ_ONLY


def test_compact_pdos_are_made_from_their_count(tmp_path: Path) -> None:
    info = INFO + "NrOfRXPDO=2\nNrOfTXPDO=5\nCompactPDO=0x13\nGranularity=8\n"
    found = sound(tmp_path, text(var("1005", 7, "rw", "0x80"), var("2000", 6, "rw", "0x1234"), info=info))
    assert sorted(i for i in found.objects if 0x1400 <= i < 0x1C00) == [
        0x1400, 0x1401, 0x1600, 0x1601, *range(0x1800, 0x1805), *range(0x1A00, 0x1A05),
    ]  # fmt: skip
    assert sorted(found.objects[0x1800].entries) == [0, 1, 2, 5]
    assert found.find((0x1803, 1)).default == 0x40000485
    assert found.find((0x1804, 1)).default == 0x80000000
    talk = Talk(found)
    for sub, kind, value in ((1, "I", 0xC0000185), (2, "B", 1)):
        assert talk.download(0x1800, sub, struct.pack("<" + kind, value)) == 0
    assert talk.download(0x1A00, 1, struct.pack("<I", 0x20000010)) == talk.download(0x1A00, 0, b"\1") == 0
    assert talk.download(0x1800, 1, struct.pack("<I", 0x40000185)) == 0
    talk.nmt(1)
    assert talk.step([(0x80, b"")]) == [(0x185, b"\x34\x12")]


@pytest.mark.parametrize(
    ("content", "values"),
    [
        (text(SYNC, var("2000", 6), info=INFO + "NrOfRXPDO=1\nNrOfTXPDO=2\nCompactPDO=0x13\n"),
         {(0x1800, 1): 0x195, (0x1A00, 0): 1, (0x1A00, 1): 0x20000010, (0x2000, 0): 7}),
        (text(COMPACT), {(0x2100, 1): 5, (0x2100, 4): 6}), (text(COMPACT), {}),
    ],
    ids=["CompactPDO", "CompactSubObj", "no value"],
)  # fmt: skip
def test_a_dcf_has_the_values_and_keeps_the_defaults(
    content: str, values: dict[tuple[int, int], Value], tmp_path: Path
) -> None:
    found = described(tmp_path, content)
    again = sound(tmp_path, dcf_text(found, values), None, "saved.dcf")
    assert {(e.index, e.sub): e.value for e in again.entries() if e.value is not None} == values
    before, after = (
        [replace(e, line=0, value=None, has_default=True) for e in each.entries()] for each in (found, again)
    )
    assert after == before


@pytest.mark.parametrize("allowed", [0, 1])
def test_dummy_usage_decides_what_an_rpdo_may_skip(tmp_path: Path, allowed: int) -> None:
    objects = text(var("2000", 5), pdo(0x1400, "$NODEID+0x200", 255, 0x00050008, 0x20000008))
    found = described(tmp_path, f"[DummyUsage]\nDummy0005={allowed}\n" + objects)
    assert len(found.warnings) == 1 - allowed
    talk = Talk(found)
    talk.nmt(1)
    talk.step([(0x205, b"\x11\x22")])
    assert talk.upload(0x2000) == (b"\x22" if allowed else b"\0")


@pytest.mark.parametrize("size", [20, 65534, 65535, 70000])
def test_a_dcf_names_its_node_and_starts_with_its_values(size: int, tmp_path: Path) -> None:
    (tmp_path / "table.bin").write_bytes(size * b"x")
    objects = (
        var("2000", 6, "rw", "1", ParameterValue="500"), var("2001", 15, "rw", "", UploadFile="table.bin"),
        var("2002", 6, "ro", "1", ParameterValue="2"), var("1017", 6, "rw", "0", ParameterValue="1000"),
        record("1011", var("1011sub0", 5, "ro", "1"), var("1011sub1", 7, "rw", "1")),
    )  # fmt: skip
    found = sound(tmp_path, DCF + text(*objects), None, "axis.dcf")
    assert (found.node_id, found.node_name, found.bit_rate) == (11, "axis", 500_000)
    talk = Talk(found, MemoryStore())
    od = talk.device.od
    assert od.values[0x200000] == 500
    assert od.values[0x200100] == size * b"x"
    assert od.values[0x200200] == 2
    assert talk.device.lss.bit_rate == 500_000
    talk.advance(1_000_000)
    assert talk.sent == [(0x70B, b"\x7f")]
    # A restore goes back to the defaults of the EDS, not to the values of the DCF.
    talk.step([(0x60B, struct.pack("<BHBI", 0x23, 0x1011, 1, codes.SIGNATURE_LOAD))])
    talk.step([(0, b"\x81\x0b")])
    assert od.values[0x200000] == 1
    assert od.values[0x101700] == 0


def test_a_store_of_65535_bytes_from_before_longer_ones_is_read(tmp_path: Path) -> None:
    found = described(tmp_path, text(var("2001", 15), var("2002", 6), record("1010", var("1010sub0", 5, "ro", "1"))))
    contents = {0x2001: 65535 * b"x", 0x2002: b"\7\0"}
    records = (struct.pack("<HBH", index, 0, len(data)) + data for index, data in contents.items())
    store = MemoryStore()
    store.groups["manufacturer"] = with_crc(b"".join(records))
    od = Talk(found, store).device.od
    assert (od.values[0x200100], od.values[0x200200]) == (65535 * b"x", 7)


@pytest.mark.parametrize(
    ("kind", "value", "is_other"),
    [(5, "7 ; 8: not in use", False), (5, "300", True), (2, "0x80", False), (6, "on", True), (6, "012", False),
     (8, "1e99", True), (9, "\u20ac", True), (0xF, "no bytes", False)],
)  # fmt: skip
def test_an_entry_says_whether_its_value_is_that_of_the_text(
    kind: int, value: str, is_other: bool, tmp_path: Path
) -> None:
    found = described(tmp_path, DCF + text(var("2000", kind, ParameterValue=value)), None, "axis.dcf")
    assert found.find(0x2000).is_other is is_other


def test_a_domain_with_the_type_of_a_number_is_read_as_that_and_said(tmp_path: Path) -> None:
    found = described(tmp_path, text(var("2000", 7, default="8").replace("ObjectType=0x7", "ObjectType=0x2")))
    (warning,) = found.warnings
    assert warning.endswith("[2000] ObjectType=0x2: a DOMAIN has DataType 0x000F; read as a VAR of UNSIGNED32")
    assert (found.objects[0x2000].code, found.find(0x2000).default) == (VAR, 8)


@pytest.mark.parametrize("name", ["../secret", "{folder}/secret", "missing.bin"])
def test_a_dcf_reads_no_file_outside_its_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_bytes(b"secret")
    (tmp_path / "in").mkdir()
    name = name.format(folder=tmp_path)
    found = described(tmp_path / "in", text(var("2001", 15, "rw", "", UploadFile=name)))
    assert len(found.warnings) == 1
    assert f"UploadFile={name}" in found.warnings[0]
    assert Talk(found).upload(0x2001) == b""


def test_limits_are_enforced_signed_ones_too(tmp_path: Path) -> None:
    found = sound(
        tmp_path,
        text(var("2000", 3, "rw", "0", LowLimit="0xFFF6", HighLimit="10"), var("2001", 8, "rw", "0", HighLimit="1.5"),
             var("2002", 8, "rw", "3.4028235E+38", HighLimit="3.4028235E+38")),
    )  # fmt: skip
    talk = Talk(found)
    for value, abort in ((-11, codes.TOO_LOW), (-10, 0), (10, 0), (11, codes.TOO_HIGH)):
        assert talk.download(0x2000, 0, struct.pack("<h", value)) == abort
    for real, abort in ((1.6, codes.TOO_HIGH), (math.nan, codes.INVALID_VALUE), (-math.inf, 0)):
        assert talk.download(0x2001, 0, struct.pack("<f", real)) == abort
    assert (talk.upload(0x2002), talk.put("f", 0x2002, 0, math.inf)) == (b"\xff\xff\x7f\x7f", codes.TOO_HIGH)


def test_access_types_and_their_pdo_direction(tmp_path: Path) -> None:
    kinds = ("ro", "wo", "rw", "rwr", "rww", "const")
    found = described(tmp_path, text(*(var(f"200{k}", 5, access) for k, access in enumerate(kinds))))
    assert [found.find(0x2000 + k).directions for k in range(6)] == [1, 2, 3, 1, 2, 1]
    talk = Talk(found)
    assert [talk.download(0x2000 + k, 0, b"\1") for k in range(6)] == [
        codes.READ_ONLY, 0, 0, 0, 0, codes.READ_ONLY
    ]  # fmt: skip
    assert talk.upload(0x2001) == codes.WRITE_ONLY


def test_type_definitions_are_no_objects_and_name_a_type(tmp_path: Path) -> None:
    definition = "[0040]\nParameterName=Mode\nObjectType=5\nDataType=0x0002\n[0041]\nParameterName=S\nObjectType=6\n"
    found = sound(tmp_path, text(definition, var("2000", 0x40, "rw", "-1")))
    assert 0x40 not in found.objects
    assert Talk(found).upload(0x2000) == b"\xff"


@pytest.mark.parametrize("supported", [0, 1])
def test_lss_only_where_the_file_has_it(tmp_path: Path, supported: int) -> None:
    talk = Talk(described(tmp_path, text().replace("LSS_Supported=1", f"LSS_Supported={supported}")))
    talk.step([(0x7E5, bytes((4, 1, 0, 0, 0, 0, 0, 0)))])
    assert len(talk.step([(0x7E5, bytes((0x5E, 0, 0, 0, 0, 0, 0, 0)))])) == supported


def test_identity_comes_from_device_info_where_1018h_has_none(tmp_path: Path) -> None:
    found = sound(tmp_path, text().replace("DefaultValue=0x12\n", "", 1))
    assert Talk(found).upload(0x1018, 1) == b"\x12\0\0\0"
    content = text(var("1021", 15, "ro"))
    assert Talk(described(tmp_path, content)).upload(0x1021) == content.encode()  # the file itself


def test_the_front_door_warns_and_returns_a_device(tmp_path: Path) -> None:
    path = tmp_path / "odd.eds"
    path.write_text(text(var("2000", 5, "rw", "300")))
    with pytest.warns(
        canopen_device.EdsWarning, match=r"odd\.eds:\d+: \[2000\] DefaultValue=300: not in UNSIGNED8"
    ) as caught:
        device = canopen_device.device_from_eds(path, 5)
    assert device.node_id == 5
    assert all(Path(one.filename).name == Path(__file__).name for one in caught)
    for node_id in (0, 128, -1, True, None):
        with pytest.raises(InputError, match="node-id"), warnings.catch_warnings():
            canopen_device.device_from_eds(path, node_id)
    with pytest.raises(InputError, match="No such file"):
        canopen_device.device_from_eds(tmp_path / "none.eds", 5)
