"""`tipforce export` for other tools: Lely's dialect of an EDS, XDD, the bus configuration of ros2_canopen."""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ET
from pathlib import Path

from canopen_device.eds import read_eds
from tipforce_robots.ros2.bridge import ros_name
from tipforce_tools.cli.main import main

HAND = """\
[hand]
sync_hz = 200
[[finger]]
node_id = 1
name = "thumb"
[[finger]]
node_id = 2
name = "2nd finger"
"""
SPACE = "{http://www.canopen.org/xml/1.1}"


def exported(path: Path, *words: str) -> Path:
    assert main(["export", *words, "-o", str(path), "-q"]) == 0
    return path


def test_lely_has_the_same_values_as_bits(tmp_path: Path) -> None:
    decimal = exported(tmp_path / "a.eds", "eds", "--simulated")
    lely = exported(tmp_path / "b.eds", "eds", "--simulated", "--dialect", "lely")
    one, other = read_eds(decimal, 5), read_eds(lely, 5)
    assert one.warnings == other.warnings == []
    reals = 0
    for entry, same in zip(one.entries(), other.entries(), strict=True):
        if entry.letter == "f":
            assert struct.pack("<f", float(entry.default)) == struct.pack("<f", float(same.default))
            reals += 1
        else:
            assert entry == same
    assert reals > 100
    section = False
    for line in lely.read_text().splitlines():
        section = line == "DataType=0x0008" or (section and not line.startswith("["))
        if section and line.startswith(("DefaultValue=", "LowLimit=", "HighLimit=")):
            assert line.partition("=")[2][:2] in ("0x", "")


OBJECT = {"name", "objectType", "dataType", "accessType", "lowLimit", "highLimit", "defaultValue", "PDOmapping"}
BODY = {"formatName", "formatVersion", "fileName", "fileCreator", "fileCreationDate", "fileVersion"}
CHILDREN: dict[str, tuple[list[str], set[str]]] = {  # CiA 311: element -> children in order, attributes
    "co:ISO15745ProfileContainer": (["co:ISO15745Profile"], set()),
    "co:ISO15745Profile": (["ProfileHeader", "ProfileBody"], set()),
    "ProfileHeader": (
        [
            "ProfileIdentification", "ProfileRevision", "ProfileName", "ProfileSource", "ProfileClassID",
            "ISO15745Reference",
        ],
        set(),
    ),
    "ISO15745Reference": (["ISO15745Part", "ISO15745Edition", "ProfileTechnology"], set()),
    "ProfileBody": (
        ["co:DeviceIdentity", "co:DeviceFunction", "ApplicationLayers", "TransportLayers", "NetworkManagement"],
        {*BODY, "supportedLanguages"},
    ),
    "co:DeviceIdentity": (["co:vendorName", "co:vendorID", "co:productName", "co:productID"], set()),
    "co:DeviceFunction": (["co:capabilities"], set()),
    "co:capabilities": (["co:characteristicsList"], set()),
    "co:characteristicsList": (["co:characteristic"], set()),
    "co:characteristic": (["co:characteristicName", "co:characteristicContent"], set()),
    "co:characteristicName": (["label"], set()),
    "co:characteristicContent": (["label"], set()), "label": ([], {"lang"}),
    "ApplicationLayers": (["co:CANopenObjectList", "dummyUsage"], set()),
    "co:CANopenObjectList": (["CANopenObject"], {"mandatoryObjects", "optionalObjects", "manufacturerObjects"}),
    "CANopenObject": (["CANopenSubObject"], {"index", "subNumber", *OBJECT}),
    "CANopenSubObject": ([], {"subIndex", *OBJECT}),
    "dummyUsage": (["dummy"], set()), "dummy": ([], {"entry"}),
    "TransportLayers": (["PhysicalLayer"], set()), "PhysicalLayer": (["baudRate"], set()),
    "baudRate": (["supportedBaudRate"], {"defaultValue"}), "supportedBaudRate": ([], {"value"}),
    "NetworkManagement": (["CANopenGeneralFeatures"], set()),
    "CANopenGeneralFeatures": (
        [], {"granularity", "nrOfRxPDO", "nrOfTxPDO", "bootUpSlave", "layerSettingServiceSlave"}
    ),
}  # fmt: skip
ALLOWED = {"accessType": {"const", "ro", "wo", "rw"}, "PDOmapping": {"no", "default", "optional", "TPDO", "RPDO"}}


def test_xdd_has_the_structure_of_cia_311(tmp_path: Path) -> None:
    eds = exported(tmp_path / "a.eds", "eds", "--programs", "--simulated")
    path = exported(tmp_path / "a.xdd", "xdd", "--programs", "--simulated")
    root = ET.parse(path).getroot()
    assert sorted(read_eds(path, 5).objects) == sorted(read_eds(eds, 5).objects)
    again = ET.parse(exported(tmp_path / "b.xdd", "xdd", "--eds", str(eds))).getroot()
    assert [one.attrib for one in again.iter("CANopenObject")] == [one.attrib for one in root.iter("CANopenObject")]
    for one in root.iter():
        name = one.tag.replace(SPACE, "co:")
        children, attributes = CHILDREN.get(name, ([], set()))
        found = [child.tag.replace(SPACE, "co:") for child in one]
        assert [children.index(child) for child in found] == sorted(children.index(child) for child in found), name
        assert {key for key in one.attrib if not key.startswith("{")} <= attributes, name
        for key, allowed in ALLOWED.items():
            assert one.attrib.get(key, "no" if key == "PDOmapping" else "ro") in allowed
    assert {"1F50", "1F57"} <= {one.attrib["index"] for one in root.iter("CANopenObject")}


def test_programs_are_in_the_formats_that_list_objects(tmp_path: Path) -> None:
    for words in (("eds",), ("dcf", "--node-id", "5")):
        found = read_eds(exported(tmp_path / f"a.{words[0]}", *words, "--programs"), 5)
        assert 0x1F50 in found.objects
        assert found.warnings == []


def test_ros2_canopen_bus_of_a_hand(tmp_path: Path) -> None:
    (tmp_path / "hand.toml").write_text(HAND)
    folder = exported(tmp_path / "bus", "ros2", "--hand", str(tmp_path / "hand.toml"))
    text = (folder / "bus.yml").read_text()
    assert "sync_period: 5000\n" in text
    assert '\nthumb:\n  node_id: 1\n  dcf: "tipforce-3.eds"\n' in text
    assert "\nfinger_2_2nd_finger:\n  node_id: 2\n" in text
    assert (folder / "tipforce-3.eds").read_text() == exported(
        tmp_path / "l.eds", "eds", "--dialect", "lely"
    ).read_text()
    assert ros_name("", 4) == "finger_4"


def test_ros2_canopen_bus_beside_another_bus_file(tmp_path: Path) -> None:
    """A foreign bus.yml is refused before the EDS files are written."""
    (tmp_path / "hand.toml").write_text(HAND)
    folder = tmp_path / "taken"
    folder.mkdir()
    (folder / "bus.yml").write_text("routes: 12\n")
    assert main(["export", "ros2", "--hand", str(tmp_path / "hand.toml"), "-o", str(folder), "-q"]) == 2
    assert [path.name for path in folder.iterdir()] == ["bus.yml"]
    assert (folder / "bus.yml").read_text() == "routes: 12\n"
