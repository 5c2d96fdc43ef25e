"""ROS 2 without a bus: messages, IDL, packages, names; the bridge publishes of a log what `tipforce decode` says."""

import importlib.util
import json
import math
import re
import shlex
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import rosless

from tipforce.errors import InputError
from tipforce.host.hand.file import read_hand
from tipforce.host.logs.reader import open_log
from tipforce.samples.columns import Block
from tipforce.samples.reasons import Status
from tipforce.shipped_files import shipped_folder
from tipforce.watching.feeds import Finger, FrameFeed
from tipforce.watching.frame_sources import LogSource
from tipforce_robots.ros2 import bridge as diagnosing
from tipforce_robots.ros2 import cdr, dds
from tipforce_robots.ros2.bridge import PERIOD_NS, Bridge, Tip
from tipforce_tools.cli.main import command_parser
from tools.decode.logs import START_US, decode, log_lines, number, rows_of, write_log
from tools.rig import Printed

EMCY = "(1700000000.100010) vcan0 085#3050100000000000"
NODES = (1, 5)
PACKAGE = shipped_folder("ros2") / "tipforce_msgs"
T_NS = 1_700_000_000_123_456_789
NAN = float("nan")
PACKAGES = sorted(path.parent for path in PACKAGE.parent.glob("*/package.xml"))


class Topics:
    """In place of a RosDomain: keeps the messages by topic."""

    def __init__(self) -> None:
        self.kinds: dict[str, tuple[str, str]] = {}
        self.messages: dict[str, list[tuple[int, Any]]] = {}

    def publisher(self, topic: str, kind: str, profile: str) -> Any:
        """Return a publisher that keeps what it gets."""
        kept = self.messages.setdefault(topic, [])
        self.kinds[topic] = kind, profile

        class Kept:
            def publish(self, message: bytes, t_ns: int) -> None:
                kept.append((t_ns, rosless.decode(kind, message)))

        return Kept()


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rosless.register_path(str(shipped_folder("ros2") / "tipforce_msgs"))
    lines = log_lines(600, NODES, loss=0.0)
    place = next(k for k, line in enumerate(lines) if line > EMCY)
    return write_log(tmp_path_factory.mktemp("bridge") / "run.log", [*lines[:place], EMCY, *lines[place:]])


def published(log: Path, *fingers: Finger) -> tuple[Topics, list[dict[str, Any]]]:
    topics: Any = Topics()
    events: list[dict[str, Any]] = []
    with open_log(log) as reader:
        feed = FrameFeed(LogSource(reader, math.inf, PERIOD_NS), Finger, 3, fingers)
        bridge = Bridge(feed, topics, "/tipforce", False)
        while not feed.ended:
            events += bridge.step()
        bridge.report(feed.now_ns())
    return topics, events


def test_the_wrenches_of_a_log_are_those_of_decode(log: Path) -> None:
    topics, _ = published(log)
    assert decode(log, "-o", log.with_suffix(".csv"), "--signals", "P,phi,theta") == 0
    rows = rows_of(log.with_suffix(".csv"))
    for node in NODES:
        expected = {}
        for row in rows:
            values = [number(row[name]) for name in ("P_N", "phi_deg", "theta_deg")]
            if row["node"] == str(node) and None not in values:
                P, phi, theta = values[0] or 0.0, *(math.radians(value or 0.0) for value in values[1:])
                sync_us = round(float(row["t_s"]) * 1e6) // 1000 * 1000  # the log has a SYNC every millisecond
                expected[sync_us * 1000] = P * math.cos(phi), P * math.sin(phi), 0.015 * P * math.sin(phi - theta)
        found = {}
        for t_ns, message in topics.messages[f"/tipforce/finger_{node}/wrench"]:
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == t_ns
            found[t_ns] = message.wrench.force.x, message.wrench.force.y, message.wrench.torque.z
        assert found.keys() == expected.keys()
        assert 450 < len(found) < 600
        np.testing.assert_allclose([found[t] for t in expected], list(expected.values()), atol=1e-9)
        contacts = [message for _, message in topics.messages[f"/tipforce/finger_{node}/contact"]]
        assert [contact.number for contact in contacts] == list(range(600))
        assert len(contacts[0].microstrain) == 3


def test_topics_types_and_profiles(log: Path) -> None:
    topics, events = published(log, Finger(1, "thumb"))
    assert topics.kinds == {
        "/diagnostics": (cdr.DIAGNOSTICS, "events"),
        **{
            f"/tipforce/{name}/{what}": profile
            for name in ("thumb", "finger_5")
            for what, profile in (
                ("wrench", (cdr.WRENCH, "sensor data")),
                ("contact", (cdr.CONTACT, "sensor data")),
                ("info", (cdr.FINGERTIP, "static")),
            )
        },
    }
    [event] = events
    assert (event["name"], event["level"], event["hardware_id"]) == ("tipforce: finger_5", 2, "node 5")
    reports = [message for _, message in topics.messages["/diagnostics"] if len(message.status) == 3]
    assert [one.name for one in reports[-1].status] == ["tipforce: bus", "tipforce: thumb", "tipforce: finger_5"]
    assert START_US < topics.messages["/diagnostics"][0][0] // 1000 < START_US + 3_000_000


def test_the_command_publishes_a_log(log: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    topics = Topics()
    monkeypatch.setattr("tipforce_robots.ros2.dds.RosDomain", lambda _domain: topics)
    out, err = printed(0, f"ros2 {log} --speed inf --nodes 5 --namespace left --json")
    count = len(topics.messages["/left/finger_5/wrench"])
    assert json.loads(out) == {"rows": 600, "wrenches": {"finger_5": count}}
    assert f"600 rows, {count} wrenches of 1 finger published" in err
    assert "left: finger_5: emcy: " in err


def test_two_fingers_of_one_name_are_refused(log: Path) -> None:
    with pytest.raises(InputError, match="fingers 1 and 5: both are ring_1 in ROS 2; rename one"):
        published(log, Finger(1, "ring 1"), Finger(5, "ring-1"))


@pytest.fixture(scope="module", autouse=True)
def _known_to_rosless() -> None:
    assert set(rosless.register_path(str(PACKAGE))) == {"tipforce_msgs/msg/Contact", "tipforce_msgs/msg/Fingertip"}


def samples(*contacts: tuple[float, float, float], status: int = 3, gauges: int = 3) -> Block:
    k = len(contacts)
    times = T_NS + 2_000_000 * np.arange(k)
    strain = np.arange(float(k * gauges)).reshape(k, gauges)
    u = np.full((k, 3), 0.01)
    return Block(times, np.array(contacts), u, strain, np.full(k, status, dtype=np.uint16))


def messages(rows: Block, kind: str, frame_id: str = "thumb_tip") -> list[tuple[int, bytes]]:
    tip = Tip("tipforce: thumb", 5, frame_id, 0.015)
    return [(t_ns, message) for found, t_ns, message in tip.messages(rows, np.arange(len(rows))) if found == kind]


def test_a_wrench_is_the_force_and_its_moment_about_the_centre_of_the_tip() -> None:
    [(t_ns, message)] = messages(samples((4.4, 120.0, 75.0)), cdr.WRENCH)
    found: Any = rosless.decode(cdr.WRENCH, message)
    assert (found.header.frame_id, found.header.stamp.sec, found.header.stamp.nanosec) == (
        "thumb_tip", 1_700_000_000, 123_456_789,
    )  # fmt: skip
    assert t_ns == T_NS
    F, at = np.array([4.4 * np.cos(np.radians(120.0)), 4.4 * np.sin(np.radians(120.0)), 0.0]), np.radians(75.0)
    moment = np.cross(0.015 * np.array([np.cos(at), np.sin(at), 0.0]), F)
    wrench = found.wrench
    np.testing.assert_allclose([wrench.force.x, wrench.force.y, wrench.force.z], F, atol=1e-15)
    np.testing.assert_allclose([wrench.torque.x, wrench.torque.y, wrench.torque.z], moment, atol=1e-15)


def test_what_is_unknown_gives_no_wrench_and_nan_in_the_contact() -> None:
    rows = samples((0.01, NAN, NAN), (4.4, 90.0, 45.0), (NAN, NAN, NAN), (1.0, 90.0, NAN))
    assert [t_ns for t_ns, _ in messages(rows, cdr.WRENCH)] == [T_NS + 2_000_000]
    found: list[Any] = [rosless.decode(cdr.CONTACT, message) for _, message in messages(rows, cdr.CONTACT)]
    assert [one.number for one in found] == [0, 1, 2, 3]
    values = np.array([[one.force, one.direction, one.angle] for one in found])
    np.testing.assert_allclose(values, rows.contact * [1.0, np.pi / 180, np.pi / 180], rtol=1e-15)
    assert [list(one.microstrain) for one in found] == rows.gauges.tolist()
    assert {one.status for one in found} == {3}


def test_the_bits_of_a_contact_are_those_of_status() -> None:
    found = dict(re.findall(r"^\w+ (\w+)=(\d+)", cdr.text_of(cdr.CONTACT), re.M))
    assert found == {bit.name: str(bit.value) for bit in Status}


@pytest.mark.parametrize("gauges", [0, 3, 8])
@pytest.mark.parametrize("frame_id", ["a_tip", "middle_tip"])
def test_cyclone_serialises_the_same_bytes(gauges: int, frame_id: str) -> None:
    [(_, message)] = messages(samples((4.4, 90.0, 45.0), gauges=gauges), cdr.CONTACT, frame_id)
    found: Any = dds.idl_type(cdr.CONTACT).deserialize(message)
    assert (found.header.frame_id, found.node_id, found.force, len(found.microstrain)) == (frame_id, 5, 4.4, gauges)
    again: bytes = found.serialize(use_version_2=False)
    assert again == message + bytes(-len(message) % 4)


def test_the_idl_declares_the_same_messages() -> None:
    """The IDL compiler of the cyclonedds package (11.0.1) crashes on every file, so the text is compared."""
    text = re.sub(r"//.*", "", (PACKAGE / "tipforce_msgs.idl").read_text())
    types = {"uint8": "octet", "int32": "long", "uint32": "unsigned long", "int64": "long long", "float64": "double"}
    declared = {
        f"{package}/msg/{name}": re.findall(r"([\w:<> ]+?) (\w+);", body)
        for package, structs in re.findall(r"module (\w+) \{ module msg \{ module dds_ \{(.*?)\}; \}; \};", text, re.S)
        for name, body in re.findall(r"@final struct (\w+)_ \{(.*?)\};", structs, re.S)
    }
    assert set(declared) == {
        "builtin_interfaces/msg/Time", "std_msgs/msg/Header", cdr.CONTACT, cdr.FINGERTIP,
    }  # fmt: skip
    for kind, found in declared.items():
        expected = []
        for field in cdr.fields_of(kind):
            one = types.get(field.kind, field.kind.replace("/", "::").replace("msg::", "msg::dds_::"))
            one = one + "_" if "::" in one else one
            expected.append((one if field.size else f"sequence<{one}>", field.name))
        assert [(one.strip(), name) for one, name in found] == expected


def test_diagnostics_say_what_the_samples_of_a_period_said() -> None:
    tip = Tip("tipforce: thumb", 5, "thumb_tip", 0.015)

    def add(*contacts: tuple[float, float, float], status: int = 3) -> None:
        list(tip.messages(samples(*contacts, status=status), np.arange(len(contacts))))

    assert tip.status("")["level"] == diagnosing.STALE
    add((4.4, 90.0, 45.0), (4.4, 90.0, 45.0))
    add((NAN, NAN, NAN), status=2 | Status.FAULT)
    add((4.4, 90.0, 45.0))  # the fault was short
    found = tip.status("operational")
    values = {pair["key"]: pair["value"] for pair in found["values"]}
    assert (found["level"], found["message"]) == (diagnosing.ERROR, "front-end fault (1 of 4 samples)")
    assert (values["NMT state"], values["samples"], values["wrenches"]) == ("operational", "4", "3")
    add((4.4, 90.0, 45.0), status=3 | Status.OUTSIDE_PAD)
    assert (tip.status("")["level"], tip.status("")["level"]) == (diagnosing.WARN, diagnosing.STALE)
    add((NAN, NAN, NAN), status=0)
    assert tip.status("")["message"] == "not calibrated (1 of 1 samples)"
    read: Any = rosless.decode(cdr.DIAGNOSTICS, diagnosing.array(T_NS, [found]))
    assert (read.status[0].level, read.status[0].hardware_id, len(read.status[0].values)) == (2, "node 5", 6)
    assert cdr.encode(cdr.EMPTY, {}) == b"\x00\x01\x00\x00\x00"


def test_a_missing_package_is_one_line_with_the_command(monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    found = importlib.util.find_spec
    absent: Any = lambda name, *rest: None if name == "cyclonedds" else found(name, *rest)  # noqa: E731
    monkeypatch.setattr("tipforce_tools.ros2.find_spec", absent)
    assert printed(2, "ros2").err == "tipforce: ros2 needs cyclonedds: `pip install 'tipforce[ros2]'`\n"


def test_the_domain_and_the_range_are_those_of_ros() -> None:
    assert [dds.domain_id(None, {}), dds.domain_id(None, {"ROS_DOMAIN_ID": "42"}), dds.domain_id(3, {})] == [0, 42, 3]
    assert dds.domain_id(3, {"ROS_DOMAIN_ID": "42"}) == 3
    for bad in ("-1", "233", "robot"):
        with pytest.raises(InputError, match=f"ROS_DOMAIN_ID {bad}: allowed are 0 to 232"):
            dds.domain_id(None, {"ROS_DOMAIN_ID": bad})
    assert [dds.loopback_only(one) for one in (
        {}, {"ROS_LOCALHOST_ONLY": "0"}, {"ROS_LOCALHOST_ONLY": "1"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_LOCALHOST_ONLY": "1"},
    )] == [False, False, True, True, False]  # fmt: skip


def test_the_configuration_keeps_that_of_the_user() -> None:
    wanted = "<IgnoreTypeInformation>1.15</IgnoreTypeInformation>"  # that of Fast DDS
    uri, local = {"CYCLONEDDS_URI": "file:///a.xml"}, {"ROS_LOCALHOST_ONLY": "1"}
    assert wanted in dds.configuration({})
    assert "127.0.0.1" not in dds.configuration({})
    first, *rest = dds.configuration(uri | local).split(",")
    assert wanted in first
    assert rest[0] == "file:///a.xml"  # of two values the later one counts
    assert "127.0.0.1" in rest[1]
    assert [dds.configuration(one, cyclone_version=0) for one in ({}, uri)] == ["", "file:///a.xml"]


def test_names_are_absolute() -> None:
    assert [dds.namespace(one) for one in ("/", "", "left", "/robot/left/")] == ["", "", "/left", "/robot/left"]


def test_the_messages_of_the_package_are_built() -> None:
    built = set(re.findall(r'"(msg/\w+\.msg)"', (PACKAGE.parent / "tipforce_msgs" / "CMakeLists.txt").read_text()))
    assert built == {f"msg/{path.name}" for path in (PACKAGE.parent / "tipforce_msgs" / "msg").iterdir()}


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda path: path.name)
def test_a_package_has_one_name_and_installs_what_it_has(folder: Path) -> None:
    assert ElementTree.parse(folder / "package.xml").findtext("name") == folder.name
    text = (folder / "CMakeLists.txt").read_text()
    assert f"project({folder.name})" in text
    for installed in re.findall(r"install\(DIRECTORY (.*?) DESTINATION", text):
        assert all((folder / name).is_dir() for name in installed.split())


def test_the_launch_file_runs_the_command_with_its_flags() -> None:
    launch = ElementTree.parse(PACKAGE.parent / "tipforce_bringup" / "launch" / "hand.launch.xml").getroot()
    defaults = {one.get("name", ""): one.get("default", "") for one in launch.iter("arg")}
    [command] = [one.get("cmd", "") for one in launch.iter("executable")]
    for name, value in defaults.items():
        command = command.replace(f"$(var {name})", value)
    folder = PACKAGE.parent / "tipforce_bringup"
    words = shlex.split(command.replace("$(find-pkg-share tipforce_bringup)", str(folder)))
    assert words[:2] == ["tipforce", "ros2"]
    args = command_parser("ros2").parse_intermixed_args(words[2:])
    assert (args.namespace, args.allow_tare) == ("/tipforce", False)
    assert [finger.name for finger in read_hand(args.source).finger] == ["thumb", "index"]
