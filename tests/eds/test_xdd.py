"""XDD and XDC (CiA 311): what `export xdd` writes, and what editors write, is read as the same device."""

from __future__ import annotations

from pathlib import Path

import pytest

from canopen_device.eds import read_eds
from canopen_device.eds.dcf import dcf_text
from canopen_device.eds.xdd import xdd_text
from canopen_device.errors import InputError
from canopen_device.machine import shipped_eds
from eds.samples import Talk, described
from eds.test_canopen import GENERATED

ROOT = Path(__file__).parents[2]
SAME = ("letter", "name", "default", "low", "high", "directions", "has_node_id")
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


@pytest.mark.parametrize("name", ["generated", "cia402", "tipforce-3"])
def test_an_export_is_read_as_the_same_device(name: str, tmp_path: Path) -> None:
    if name == "generated":
        found = described(tmp_path, GENERATED)
    else:
        found = read_eds(shipped_eds("cia402") if name == "cia402" else ROOT / "eds" / f"{name}.eds", 5)
    again = described(tmp_path, xdd_text(found), name="again.xdd")
    assert again.warnings == []
    assert [(e.place, *(getattr(e, key) for key in SAME)) for e in again.entries()] == [
        (e.place, *(getattr(e, key) for key in SAME)) for e in found.entries()
    ]
    assert (again.lss, again.dummies, again.bit_rates) == (found.lss, found.dummies, found.bit_rates or (1_000_000,))


def test_parameters_of_an_editor(tmp_path: Path) -> None:
    found = described(tmp_path, EDITOR, name="a.xdd")
    assert found.warnings == [
        "a.xdd:21: [2000] ParameterValue=7: 1 ParameterValues, but no [DeviceComissioning], as a DCF has; "
        "the DefaultValues apply"
    ]
    assert (found.vendor_name, found.lss, found.bit_rates, found.dummies) == (
        "Anyone",
        False,
        (500_000,),
        frozenset({5}),
    )
    talk = Talk(found)
    assert [talk.upload(0x1000), talk.upload(0x1014), talk.upload(0x1018, 1), talk.upload(0x2000)] == [
        b"\x92\1\0\0", b"\x85\0\0\0", b"\x12\0\0\0", b"\xfb\xff"
    ]  # fmt: skip
    force = found.find("Force")
    assert (force.access, force.low, force.high, force.directions) == ("rww", -10, 10, 2)


def test_an_xdc_configures_one_node(tmp_path: Path) -> None:
    found = described(tmp_path, EDITOR.replace("</NetworkManagement>", CONFIGURED), None, "a.xdc")
    assert found.warnings == []
    assert (found.node_id, found.node_name, found.bit_rate, found.find(0x2000).initial) == (9, "axis", 500_000, 7)
    saved = described(tmp_path, dcf_text(found, {(0x2000, 0): 3}), None, "saved.dcf")
    assert (saved.warnings, saved.node_id, saved.find(0x2000).initial) == ([], 9, 3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</parameter>", "</param>", r"a\.xdd:6: no XML: mismatched tag"),
        (
            "<ISO15745ProfileContainer",
            "<!DOCTYPE a [<!ENTITY b 'c'>]><ISO15745ProfileContainer",
            "a document type of its own",
        ),
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


def test_a_parameter_that_is_missing_is_named(tmp_path: Path) -> None:
    found = described(tmp_path, EDITOR.replace('uniqueIDRef="C"', 'uniqueIDRef="D"'), name="a.xdd")
    assert "a.xdd:16: [1014] uniqueIDRef=D: no such parameter; read without" in found.warnings
