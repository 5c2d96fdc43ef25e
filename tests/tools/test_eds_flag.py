"""`--eds`: any device by the names of its file; `tipforce export` for other tools: Lely, XDD, ros2_canopen."""

import re
import shutil
import struct
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from canopen_device.eds import read_eds
from canopen_device.machine import SimulatedDevice, shipped_eds
from eds.samples import pdo, record, text, var
from host.bus_with_nodes import new_channel
from tipforce import simulated_device
from tipforce_robots.ros2.bridge import ros_name
from tipforce_tools.cli.main import main
from tools.rig import Printed

LOG = """\
(1.000000) can0 000#0105
(1.010000) can0 185#500200
(1.020000) can0 205#0F0001
(1.030000) can0 285#E8030000FEFFFFFF
"""


@pytest.fixture
def eds(tmp_path: Path) -> str:
    return shutil.copy(str(shipped_eds("cia402")), str(tmp_path / "drive.eds"))


@contextmanager
def simulated(eds: Path | str) -> Iterator[tuple[SimulatedDevice, str]]:
    """Node 5 of a file, and the flags of its bus."""
    channel = new_channel()
    with simulated_device(eds, 5, {"interface": "virtual", "channel": channel}) as device:
        yield device, f"-i virtual -c {channel}"


def test_sdo_by_the_names_of_the_file(eds: str, printed: Printed) -> None:
    with simulated("cia402") as (drive, bus):
        drive["Home offset"] = -7
        for words, shown in (
            (["Home offset"], "-7"), (["0x607C", "0"], "-7"), (["1008h"], "tipforce CiA 402 drive"),
            (["Software position limit/Maximum position limit"], "1000000"),
        ):  # fmt: skip
            assert printed(0, ["sdo", "read", "5", *words, "--eds", eds, *bus.split()]).out.strip() == shown
        assert "(0x1018:01): 4 bytes" in printed(2, f"sdo read 5 0x1018 1 u8 {bus}").err
        printed(0, ["sdo", "write", "5", "Profile velocity", "2000", "--eds", eds, *bus.split()])
        assert drive["Profile velocity"] == 2000
        rows = printed(0, f"sdo dump 5 --json --eds {eds} {bus}").records
        by_name = {row["name"]: row["value"] for row in rows}
        assert by_name["Profile velocity"] == 2000
        assert by_name["Identity/Product code"] == 0x402
        assert len(rows) > 80
        assert "'Position actual value' (0x6064:00)" in printed(2, f"sdo read 5 Position --eds {eds} {bus}").err


def test_a_log_by_the_names_of_the_file(eds: str, tmp_path: Path, printed: Printed) -> None:
    sdo = "(1.040000) can0 605#40FF600000000000\n(1.041000) can0 585#43FF6000D0070000\n"
    log = tmp_path / "run.log"
    log.write_text(LOG + sdo)
    rows = printed(0, f"decode {log} --eds 5={eds} --json").records
    assert [row["node"] for row in rows] == [5, 5, 5]
    assert rows[0]["Statusword"] == 0x250
    assert (rows[1]["Controlword"], rows[1]["Modes_of_operation"]) == (15, 1)
    assert (rows[2]["Position_actual_value"], rows[2]["Velocity_actual_value"]) == (1000, -2)
    for words, said in (
        (f"--eds 5={eds} --eds 5={eds}", "node 5 has a file already"), ("--eds 5=none.eds", "No such file"),
        (f"--eds 5={eds} --gauges 4", "leave out --dbc"),
    ):  # fmt: skip
        assert said in printed(2, f"decode {log} {words}").err
    lines = printed(0, f"dump {log} --decode --eds 5={eds}").out.splitlines()
    for line, shown in zip(lines[1:4], (
        "TPDO1  Statusword=592 Modes_of_operation_display=0", "RPDO1  Controlword=15 Modes_of_operation=1",
        "TPDO2  Position_actual_value=1000 Velocity_actual_value=-2"), strict=True):  # fmt: skip
        assert shown in line
    assert re.search("Target velocity.*2000", lines[5])


def test_objects_of_one_name_have_columns_of_their_own(tmp_path: Path, printed: Printed) -> None:
    axes = [var(index, 6, ParameterName="Statusword") for index in ("6041", "6841")]
    pdos = [pdo(0x1800 + k, f"$NODEID+0x{k + 1}80", 255, 0x60410010 + k * 0x08000000) for k in (0, 1)]
    (tmp_path / "axes.eds").write_text(text(*axes, *pdos))
    (tmp_path / "run.log").write_text("(1.000000) can0 185#0100\n(1.100000) can0 285#0200\n")
    rows = printed(0, f"decode {tmp_path}/run.log --eds 5={tmp_path}/axes.eds --json").records
    assert [(row["Statusword"], row["Statusword_6841_00"]) for row in rows] == [(1, None), (None, 2)]


def test_plot_draws_every_signal_of_the_file(eds: str, tmp_path: Path, printed: Printed) -> None:
    (tmp_path / "run.log").write_text(LOG)
    (plot,) = printed(0, f"plot {tmp_path}/run.log --eds 5={eds} -o {tmp_path}/run.svg --json").records
    (drive,) = plot["nodes"]
    assert {"Statusword", "Controlword", "Position_actual_value", "Velocity_actual_value"} <= set(drive["signals"])


def exchange(at_s: float, *frames: str) -> str:
    """Requests of a client and responses of node 5, in turn."""
    return "".join(
        f"({at_s + k / 1e4:.6f}) can0 {('605', '585')[k % 2]}#{frame.ljust(16, '0')}\n"
        for k, frame in enumerate(frames)
    )


def sdo(at_s: float, index: int, sub: int, value: int, size: int) -> str:
    """An expedited download to node 5, and its response."""
    place, data = struct.pack("<HB", index, sub).hex(), value.to_bytes(size, "little").hex()
    return exchange(at_s, f"{0x23 | 4 - size << 2:02x}{place}{data}", f"60{place}")


def segmented(at_s: float, index: int, sub: int, value: int, size: int) -> str:
    """The same, segmented."""
    place, data = struct.pack("<HB", index, sub).hex(), value.to_bytes(size, "little").hex()
    return exchange(at_s, f"21{place}{size:02x}", f"60{place}", f"{7 - size << 1 | 1:02x}{data}", "20")


def remap(written: Callable[[float, int, int, int, int], str]) -> str:
    """TPDO2 becomes the velocity alone, on 295h."""
    return (
        written(1.1, 0x1801, 1, 0x80000285, 4) + written(1.2, 0x1A01, 0, 0, 1) + written(1.3, 0x1A01, 1, 0x606C0020, 4)
        + written(1.4, 0x1A01, 0, 1, 1) + written(1.5, 0x1801, 1, 0x295, 4)
    )  # fmt: skip


REMAP = remap(sdo)
STORE = sdo(1.8, 0x1010, 1, int.from_bytes(b"save", "little"), 4)
BOOT = "(1.900000) can0 705#00\n"
LATER = "(2.000000) can0 285#E8030000FEFFFFFF\n(2.100000) can0 295#FDFFFFFF\n"


BOTH = {"Position_actual_value": 1000, "Velocity_actual_value": -2}


@pytest.mark.parametrize(
    ("changed", "after"),
    [
        (REMAP, {"Velocity_actual_value": -3}), (REMAP + STORE + BOOT, {"Velocity_actual_value": -3}),
        (REMAP + BOOT, BOTH), (remap(segmented), {"Velocity_actual_value": -3}),
    ],
    ids=["written", "stored", "lost by a reset", "segmented"],
)  # fmt: skip
def test_layouts_follow_the_sdo_traffic_of_the_log(
    changed: str, after: dict[str, int], eds: str, tmp_path: Path, printed: Printed
) -> None:
    (tmp_path / "run.log").write_text(LOG + changed + LATER)
    words = f"{tmp_path}/run.log --eds 5={eds}"
    rows = printed(0, f"decode {words} --format jsonl -q").records
    known = [{k: v for k, v in row.items() if v is not None and k.endswith("actual_value")} for row in rows]
    assert [row for row in known if row] == [BOTH, after]
    shown = [line for line in printed(0, f"dump {words} --decode").out.splitlines() if "actual_value=" in line]
    assert [line.partition("TPDO2  ")[2] for line in shown] == [
        " ".join(f"{name}={value}" for name, value in values.items()) for values in (BOTH, after)
    ]


def test_monitor_by_the_names_of_the_file(eds: str, tmp_path: Path, printed: Printed) -> None:
    (tmp_path / "run.log").write_text(LOG + REMAP + "(1.600000) can0 295#FDFFFFFF\n(1.610000) can0 185#370200\n")
    words = f"monitor {tmp_path}/run.log --eds 5={eds}"
    (view,) = printed(0, f"{words} --json --once 9").records[0]["buses"]
    values = {name: one["value"] for name, one in view["nodes"][0]["readings"].items()}
    assert (values["Statusword"], values["Velocity_actual_value"]) == (0x237, -3)
    assert "Statusword=567" in printed(0, words).out


def test_the_eds_that_a_node_stores(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "lamp.eds"
    path.write_text(text(var("1021", 0xF, "ro"), var("2000", 6, "rw", "500", ParameterName="Brightness")))
    with simulated(path) as (lamp, bus):
        rows = printed(0, f"sdo dump 5 --json {bus}").records
        assert ("Brightness", 500) in [(row["name"], row["value"]) for row in rows]
        assert printed(0, f"config show 5 --json {bus}").out == ""
        lamp["Brightness"] = 7
        for eds in ("", f"--eds {path}"):
            (row,) = printed(0, f"config show 5 {eds} --json {bus}").records
            assert (row["index"], row["name"], row["value"], row["default"]) == ("0x2000", "Brightness", 7, 500)
        printed(0, f"sdo write 5 Brightness 9 --json {bus}")
        for words in ("brightness", "0x2000 0"):
            assert printed(0, f"sdo read 5 {words} --json {bus}").records[0]["value"] == 9
        assert "close to it: 'Brightness'" in printed(2, f"sdo read 5 brihtness {bus}").err


def test_write_only_objects_are_set_and_not_compared(tmp_path: Path, printed: Printed) -> None:
    path, toml, xdc = tmp_path / "lamp.eds", tmp_path / "lamp.toml", tmp_path / "lamp.xdc"
    reset, gain = var("2000", 6, "wo", ParameterName="Reset"), var("2001", 6, ParameterName="Gain")
    path.write_text(text(reset, gain, var("2002", 9, "rw", "\u00b5m", ParameterName="Unit")), encoding="utf-8")
    toml.write_text("[objects]\nReset = 3\nGain = 4\n")
    configured = '<CANopenObject index="2001" name="G" objectType="7" dataType="0006" accessType="rw" actualValue="9"/>'
    xdc.write_text(f"<a>{configured}</a>")
    with simulated(path) as (lamp, bus):
        err = printed(0, f"config apply 5 {toml} --eds {path} {bus}").err
        assert "2 objects, 0 different, 1 write-only, not compared" in err
        assert (lamp["Reset"], lamp["Gain"]) == (3, 4)
        printed(0, f"config apply 5 {xdc} --eds {path} {bus}")
        assert lamp["Gain"] == 9
        printed(0, f"config save 5 {toml} --yes --eds {path} {bus}")
        assert tomllib.loads(toml.read_text()) == {"objects": {"Gain": 9}}  # a text outside ASCII is left out


def test_config_of_another_device(tmp_path: Path, printed: Printed) -> None:
    path, toml, dcf = tmp_path / "lamp.eds", tmp_path / "lamp.toml", tmp_path / "lamp.dcf"
    curve = "[2100]\nParameterName=Curve\nObjectType=8\nDataType=6\nAccessType=rw\nDefaultValue=1\nCompactSubObj=3\n"
    path.write_text(
        text(
            var("1017", 6, "rw", "0", ParameterName="Heartbeat"), curve,
            var("2000", 6, "rw", "500", ParameterName="Brightness", LowLimit="0", HighLimit="1000"),
            var("2001", 6, "rww", "0", ParameterName="Command"),
            pdo(0x1800, "$NODEID+0x180", 255, 0x20000010, 0x10170010),
        )
    )  # fmt: skip
    toml.write_text(
        '[objects]\nBrightness = 7\n"Heartbeat" = 100\n"Curve" = [4, 5, 6]\n"0x1A00" = ["Heartbeat", "Brightness"]\n'
        '"0x1800:01" = "$NODEID+0x280"\n'
    )
    with simulated(path) as (lamp, bus):

        def config(code: int, words: str) -> str:
            return "".join(printed(code, f"config {words} --eds {path} {bus} -q"))

        said = printed(2, f"config apply 5 {toml} {bus}").err
        assert "is not a fingertip and stores no EDS; add --eds FILE" in said
        assert config(0, f"apply 5 {toml}") == ""
        assert (lamp["Brightness"], lamp[0x2100, 3], lamp[0x1800, 1], lamp[0x1A00, 0]) == (7, 6, 0x285, 2)
        for action in ("save", "verify", "diff"):
            assert config(0, f"{action} 5 {dcf}") == ""
        lamp["Brightness"], lamp["Command"] = 8, 9
        assert config(1, f"verify 5 {dcf}") == "Brightness (0x2000:00): expected 7, the node has 8\n"
        assert config(0, f"apply 5 {dcf}") == ""
        assert tomllib.loads(config(0, "save 5 -"))["objects"] == {
            "Heartbeat": 100, "Brightness": 7, "R1800/P1800sub1": "$NODEID+0x280",
            "0x1A00": ["Heartbeat", "Brightness"], **{f"Curve/Curve{k}": 3 + k for k in (1, 2, 3)},
        }  # fmt: skip
        toml.write_text("[objects]\nBrightness = 1001\n")
        assert config(2, f"apply 5 {toml}").endswith("Brightness (0x2000:00) is 1001: allowed are 0 to 1000\n")
    found = read_eds(dcf)
    assert (found.node_id, found.find("Brightness").value, found.find((0x2100, 2)).value) == (5, 7, 5)
    assert read_eds(dcf, 6).find((0x1800, 1)).value == 0x286


def test_settings_survive_a_file(tmp_path: Path, printed: Printed) -> None:
    """What only changes while it is off, single bits in a PDO, lists of a compact object, and texts."""
    path, toml, dcf = tmp_path / "lamp.eds", tmp_path / "lamp.toml", tmp_path / "lamp.dcf"
    beats = [var(f"1016sub{k}", 7, default=f"0x{k:02X}0064") for k in (1, 2)]
    path.write_text(text(
        var("1005", 7, default="0x80"), var("1006", 7), var("1014", 7, default="$NODEID+0x80"), var("1019", 5),
        record("1016", var("1016sub0", 5, "ro", "2"), *beats), record("1010", var("1010sub0", 5, "ro", "1"),
        var("1010sub1", 7, "rw", "1")), var("2000", 1), var("2001", 1), var("2002", 9, default="on"),
        var("2003", 6, ObjFlags="1"), pdo(0x1800, "$NODEID+0x180", 255, 0x20000001, 0x20010001),
        "[2100]\nParameterName=Curve\nObjectType=0x8\nDataType=0x0006\nAccessType=rw\nCompactSubObj=2\n"
        "[2100Value]\nNrOfEntries=2\n1=11\n2=22\n"))  # fmt: skip
    own = path.read_text() + "[DeviceComissioning]\nNodeID=5\n"
    for section in ("[1010sub1]", "[2003]"):  # read from a device by another tool: no settings
        own = own.replace(f"{section}\n", f"{section}\nParameterValue=1\n")
    dcf.write_text(own.replace("NrOfEntries=2\n1=11", "NrOfEntries=2\n1=12 ; left: not in use"))
    other = tmp_path / "other.dcf"
    other.write_text(own.replace("NodeID=5", "NodeID=6").replace("[2001]\n", "[2001]\nParameterValue=2\n"))
    toml.write_text("[objects]\nP1005 = 0x40000081\nP1006 = 1000000\nP1014 = 0x390\nP1019 = 10\nP2002 = ' '\n"
                    '"0x1016:01" = 0x20064\n"0x1016:02" = 0x10064\n0x1A00 = [0x20010001, 0x20000001]\n')  # fmt: skip
    with simulated(path) as (lamp, bus):
        for file in (toml, toml, dcf):
            printed(0, f"config apply 5 {file} --eds {path} {bus}")
        assert [lamp[key] for key in (0x1006, 0x1014, 0x1019, (0x1016, 1), (0x1A00, 1), (0x2100, 1), 0x2003)] == [
            1_000_000, 0x390, 10, 0x20064, 0x20010001, 12, 0,
        ]  # fmt: skip
        said = printed(2, f"config apply 5 {other} --eds {path} {bus}").err
        assert "loaded as node 5" in said
        assert said.endswith("[2001] ParameterValue=2: not in BOOLEAN, 0 to 1\n")
        lamp[0x2100, 1] = 0
        assert "cannot hold 0x2002:00 = ' '" in printed(0, f"config save 5 {dcf} --eds {dcf} {bus}").err
        assert [read_eds(dcf).find((0x2100, k)).value for k in (1, 2)] == [0, 22]
        printed(0, f"config save 5 {toml} --eds {path} {bus}")
        printed(0, f"config verify 5 {toml} --eds {path} {bus}")


HAND = """\
hand = { sync_hz = 200 }
finger = [{ node_id = 1, name = "thumb" }, { node_id = 2, name = "2nd finger" }]
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
    "CANopenObject": (["CANopenSubObject"], {"index", "subNumber", "objFlags", *OBJECT}),
    "CANopenSubObject": ([], {"subIndex", "objFlags", *OBJECT}),
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
    dcf = exported(tmp_path / "a.dcf", "dcf", "--node-id", "5", "--programs")
    assert read_eds(exported(tmp_path / "a.xdc", "xdd", "--eds", str(dcf))).node_id == 5
    for description in (read_eds(path, 5), read_eds(eds, 5), read_eds(dcf, 5)):
        assert {0x1F50, 0x1F57} <= set(description.objects)
        assert description.warnings == []


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
