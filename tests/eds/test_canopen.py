"""The same files read by others: the canopen library, XDD and XDC (CiA 311); conformance and random frames on them."""

import re
from pathlib import Path

import canopen
import pytest
from bench import fuzz
from canopen.objectdictionary import ODVariable

from canopen_conformance.run import FAIL, PASS
from canopen_device.core.node import Device
from canopen_device.eds import read_eds
from canopen_device.eds.dcf import dcf_text
from canopen_device.eds.load import device_of
from canopen_device.eds.xdd import xdd_text
from canopen_device.errors import InputError
from canopen_device.machine import shipped_eds
from canopen_device.testing import MemoryStore
from canopen_device.types import LETTER_OF_CODE
from conformance.fingertip import matching, run_in_process
from device.test_canopen_client import Client
from eds.samples import INFO, Talk, described, pdo, record, sound, text, var

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


SAME = ("letter", "name", "default", "low", "high", "directions", "has_node_id", "value", "flags")
SAME_OF_ALL = ("lss", "dummies", "is_dcf", "node_name", "bit_rate")
EDITOR = """\
<?xml version="1.0" encoding="utf-8"?>
<ISO15745ProfileContainer xmlns="http://www.canopen.org/xml/1.1" xmlns:q1="http://www.canopen.org/xml/1.1">
<ISO15745Profile><ProfileBody>
<q1:DeviceIdentity><q1:vendorName>Anyone</q1:vendorName><q1:vendorID>0x12</q1:vendorID></q1:DeviceIdentity>
<q1:ApplicationProcess><q1:parameterList>
<parameter uniqueID="A" access="const"><label lang="en">Type</label><UDINT/><defaultValue value="0x192"/></parameter>
<parameter uniqueID="B" access="readWrite"><INT/><defaultValue value="-5"/>
<allowedValues><range><minValue value="-10"/><maxValue value="10"/></range></allowedValues>
<actualValue value="7"/></parameter>
<parameter uniqueID="C" access="readWrite"><UDINT/><defaultValue value="$NODEID+0x80"/></parameter>
</q1:parameterList></q1:ApplicationProcess></ProfileBody></ISO15745Profile>
<ISO15745Profile><ProfileBody><ApplicationLayers><q1:CANopenObjectList>
<CANopenObject index="1000" name="Device type" objectType="7" PDOmapping="no" uniqueIDRef="A"/>
<CANopenObject index="1001" name="Errors" objectType="7" dataType="05" accessType="ro"
 PDOmapping="TPDO" objFlags="0001"/>
<CANopenObject index="1014" name="EMCY" objectType="7" dataType="0007" uniqueIDRef="C"/>
<CANopenObject index="1018" name="Identity" objectType="9" subNumber="2">
<CANopenSubObject subIndex="00" name="n" objectType="7" dataType="0005" accessType="ro" defaultValue="1"/>
<CANopenSubObject subIndex="01" name="Vendor" objectType="7" dataType="0007" accessType="ro"/>
</CANopenObject>
<CANopenObject index="2000" name="Force" objectType="7" PDOmapping="RPDO" uniqueIDRef="B"/>
</q1:CANopenObjectList><dummyUsage><dummy entry="Dummy0005=1"/></dummyUsage></ApplicationLayers>
<TransportLayers><PhysicalLayer><baudRate><supportedBaudRate value="500 Kbps"/></baudRate></PhysicalLayer>
</TransportLayers>
<NetworkManagement><CANopenGeneralFeatures layerSettingServiceSlave="false"/></NetworkManagement>
</ProfileBody></ISO15745Profile></ISO15745ProfileContainer>
"""
CONFIGURED = '<deviceCommissioning nodeID="9" nodeName="axis" actualBaudRate="500000"/></NetworkManagement>'


@pytest.mark.parametrize("name", ["generated", "generated DCF", "cia402", "tipforce-3"])
def test_an_export_is_read_as_the_same_device(name: str, tmp_path: Path) -> None:
    if name.startswith("generated"):
        dcf = GENERATED.replace("=2.5\n", "=2.5\nParameterValue=7\n") + "[DeviceComissioning]\nNodeID=5\nBaudrate=500\n"
        found = described(tmp_path, dcf if name.endswith("DCF") else GENERATED)
    else:
        found = read_eds(shipped_eds("cia402") if name == "cia402" else ROOT / "eds" / f"{name}.eds", 5)
    again = sound(tmp_path, xdd_text(found), name="again.xdd")
    assert [(e.place, *(getattr(e, key) for key in SAME)) for e in again.entries()] == [
        (e.place, *(getattr(e, key) for key in SAME)) for e in found.entries()
    ]
    found.objects[0x1000].name = "Type \x1b"  # no character of XML
    assert sound(tmp_path, xdd_text(found), name="again.xdd").objects[0x1000].name == r"Type \x1b"
    assert [getattr(again, key) for key in SAME_OF_ALL] == [getattr(found, key) for key in SAME_OF_ALL]
    assert again.bit_rates == (found.bit_rates or (1_000_000,))


def test_parameters_of_an_editor(tmp_path: Path) -> None:
    found = described(tmp_path, EDITOR, name="a.xdd")
    assert found.warnings == [
        "a.xdd:21: [2000] ParameterValue=7: 1 ParameterValues, but no [DeviceComissioning], as a DCF has; "
        "the DefaultValues apply"
    ]
    assert (found.vendor_name, found.lss, found.bit_rates, found.dummies) == (
        "Anyone", False, (500_000,), frozenset({5}),
    )  # fmt: skip
    talk = Talk(found)
    assert [talk.upload(0x1000), talk.upload(0x1014), talk.upload(0x1018, 1), talk.upload(0x2000)] == [
        b"\x92\1\0\0", b"\x85\0\0\0", b"\x12\0\0\0", b"\xfb\xff"
    ]  # fmt: skip
    force = found.find("Force")
    assert (force.access, force.low, force.high, force.directions) == ("rww", -10, 10, 2)


def test_an_xdc_configures_one_node(tmp_path: Path) -> None:
    found = sound(tmp_path, EDITOR.replace("</NetworkManagement>", CONFIGURED), None, "a.xdc")
    assert (found.node_id, found.node_name, found.bit_rate, found.find(0x2000).initial) == (9, "axis", 500_000, 7)
    saved = described(tmp_path, dcf_text(found, {(0x2000, 0): 3}), None, "saved.dcf")
    assert (saved.warnings, saved.node_id, saved.find(0x2000).initial) == ([], 9, 3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</parameter>", "</param>", r"a\.xdd:6: no XML: mismatched tag"),
        ("index=", "number=", "no object in it"),
        ("utf-8", "zz", r"a\.xdd:1: no XML: unknown encoding: zz"),
        ("utf-8", "utf-7", r"a\.xdd:1: no XML: multi-byte encodings are not supported"),
    ],
)
def test_what_is_no_xdd_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        described(tmp_path, EDITOR.replace(old, new), name="a.xdd")


@pytest.mark.parametrize(
    ("written", "warnings"), [("0x0007", 0), ("UNSIGNED32", 1), ("07", 0)], ids=["0x", "a name", "two digits"]
)
def test_spellings_of_a_data_type(written: str, warnings: int, tmp_path: Path) -> None:
    eds = EDITOR.replace('dataType="0007" uniqueIDRef="C"', f'dataType="{written}" uniqueIDRef="C"')
    found = described(tmp_path, eds, name="a.xdd")
    assert found.find(0x1014).letter == "I"
    assert sum("[1014]" in line for line in found.warnings) == warnings
    found = described(tmp_path, EDITOR.replace('uniqueIDRef="C"', 'uniqueIDRef="D"'), name="a.xdd")
    assert "a.xdd:16: [1014] uniqueIDRef=D: no such parameter; read without" in found.warnings


PLAIN = text(
    var("1003", 7, "ro", "0"), var("1005", 7, "ro", "128"), var("1009", 9, "const"),
    var("1014", 7, "ro", "0x80 + $NODEID"), var("1016", 7, "rw", "0"), var("1017", 6, "rw", "0"), var("1200", 7, "ro"),
)  # fmt: skip
HISTORY = record("1003", var("1003sub0", 5, "rw", "0"), var("1003sub1", 7, "ro"), var("1003sub2", 7, "ro"), code="0x8")
CONSUMER = record("1016", var("1016sub0", 5, "ro", "1"), var("1016sub1", 7, "rw", "0", HighLimit="65535"), code="0x8")
HIGHEST, HIGHER = var("1800sub0", 5, "const", "5"), var("1800sub0", 5, "const", "6")
INHIBIT, START = var("1800sub3", 6, "rw", "0"), var("1800sub6", 5, "rw", "0")
LIMITED = text(
    HISTORY, CONSUMER, var("1005", 7, "rw", "0x80", LowLimit="0x80", HighLimit="0x400000FF"), var("1017", 6, "rw", "0"),
    var("1014", 7, "rw", "$NODEID+0x80"), var("2000", 7), var("5FFF", 7), pdo(0x1400, "$NODEID+0x200", 255, 0x20000020),
    pdo(0x1800, "$NODEID+0x180", 255, 0x99990020).replace(INHIBIT, START).replace(HIGHEST, HIGHER),
)  # fmt: skip
PRODUCER = text(
    var("1005", 7, "rw", "0x40000080"), var("1006", 7, "rw", "10000"), var("1019", 5, "rw", "10"), var("2000", 5),
    var("1014", 7, "rw", "$NODEID+0x80"), var("1015", 6, "rw", "100"), pdo(0x1800, "$NODEID+0x180", 3, 0x20000008),
)  # fmt: skip
AREAS = ("emcy", "identity", "pdo_parameters", "sync", "tpdo", "sdo", "error_control.consumer", "lss.node_id_")
CASES = [case for area in AREAS for case in matching(area + ("*" if "." in area else ".*"))]


@pytest.mark.parametrize("content", [text(), PLAIN, LIMITED, PRODUCER], ids=["least", "plain", "limited", "producer"])
def test_no_case_fails(content: str, tmp_path: Path) -> None:
    path = tmp_path / "any.eds"
    path.write_text(content)

    def device() -> Device:
        store = MemoryStore()
        return device_of(read_eds(path, 5), store.save, store.load)

    results = [run_in_process(case, device())[0] for case in CASES]
    assert [(result.case.name, result.reason) for result in results if result.verdict == FAIL] == []
    assert sum(result.verdict == PASS for result in results) > 10


def test_random_frames_never_raise(tmp_path: Path) -> None:
    """A small share of `python -m bench.fuzz --eds`."""
    path = tmp_path / "generated.eds"
    path.write_text(GENERATED)
    for file in (path, ROOT / "eds" / "tipforce-3.eds", shipped_eds("cia402")):
        assert fuzz.fuzz_file(file, 2000, seed=17) > 500
