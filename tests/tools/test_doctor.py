"""doctor: each thing that can stand in the way is named with its next step."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.bus_with_nodes import connected, finger, new_channel
from tipforce.dictionary import objects as od
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FRAME
from tipforce_tools.cli.main import main
from tipforce_tools.doctor.command import configuration_check, heard
from tipforce_tools.doctor.machine import can_interfaces, interface_checks, software_checks, vcan_checks
from tools.rig import Printed

UP = {"ifname": "can0", "flags": ["NOARP", "UP"], "txqlen": 1000}


def can_link(**info: Any) -> dict[str, Any]:
    """What `ip -details -json link show` says of a real interface."""
    return UP | {"linkinfo": {"info_kind": "can", "info_data": {"bittiming": {"bitrate": 500000}} | info}}


@pytest.fixture(autouse=True)
def _no_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("can.util.CONFIG_FILES", [])
    monkeypatch.setattr("tipforce_tools.doctor.machine.trial", lambda: 0)  # test_vcan_boot.py has the real one
    monkeypatch.setattr("tipforce_tools.doctor.machine.multicast_checks", lambda: ())  # test_udp_multicast.py


def test_a_bus_with_nodes_is_listened_to(capsys: pytest.CaptureFixture[str]) -> None:
    channel = new_channel()
    with connected(finger(5), channel=channel) as (connection, _):
        connection.sdo(5).write(od.HEARTBEAT_PRODUCER_MS, 20)
        assert main(["doctor", "--listen", "0.3", "--json", "-i", "virtual", "-c", channel]) == 0
    checks = {
        (c["topic"], c["finding"].split(",")[0]): c for c in map(json.loads, capsys.readouterr().out.splitlines())
    }
    assert ("nodes", "heartbeats of 5") in checks
    assert any(topic == "traffic" and "frames/s" in finding for topic, finding in checks)
    assert any(topic == "software" for topic, _ in checks)


def test_a_silent_bus_and_one_that_does_not_open(printed: Printed) -> None:
    assert "no frames for" in printed(0, ["doctor", "--listen", "0.01", "-i", "virtual", "-c", new_channel()]).out
    out = printed(1, ["doctor", "--listen", "0.01", "-i", "socketcan", "-c", "nowhere9"]).out
    assert "fail bus: " in out
    assert "->" in out


@pytest.mark.parametrize(
    ("link", "state", "finding", "step"),
    [
        (can_link(), "ok", "up, 500000 bit/s", ""),
        (can_link() | {"flags": ["NOARP"]}, "fail", "down, 500000", "ip link set can0 up type can bitrate 500000"),
        (can_link(state="BUS-OFF"), "fail", "bus-off", "type can restart"),
        (can_link(state="ERROR-PASSIVE", berr_counter={"tx": 128, "rx": 0}), "fail", "sent 128", "terminators"),
        (can_link() | {"txqlen": 10}, "note", "queue of 10", "txqueuelen 1000"),
        (UP | {"linkinfo": {"info_kind": "vcan"}, "txqlen": 10}, "ok", "up, virtual", ""),
        (None, "note", "unknown", "iproute2"),
    ],
)
def test_interfaces(link: dict[str, Any] | None, state: str, finding: str, step: str) -> None:
    last = list(interface_checks("can0", link))[-1]
    assert last.state == state
    assert finding in last.finding
    assert step in last.next_step


def test_can_interfaces_are_told_by_their_type(tmp_path: Path) -> None:
    for name, kind in (("lo", "772"), ("vcan1", "280"), ("can0", "280"), ("odd", "")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind)
    assert can_interfaces(tmp_path) == ["can0", "vcan1"]
    assert can_interfaces(tmp_path / "none") == []


def test_where_the_name_comes_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert "flags (--interface virtual)" in configuration_check({"interface": "virtual"}).finding
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "can7")
    assert configuration_check({}).finding.startswith("socketcan can7, from CAN_INTERFACE=socketcan")
    monkeypatch.setenv("CAN_INTERFACE", "nonsense")
    assert configuration_check({}).state == "fail"
    monkeypatch.delenv("CAN_INTERFACE")
    monkeypatch.delenv("CAN_CHANNEL")
    path = tmp_path / "can.conf"
    path.write_text("[default]\ninterface = virtual\nchannel = hand\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(path)])
    found = configuration_check({})
    assert found.finding == f"virtual hand, from {path}"


def test_vcan_that_works_and_vcan_that_does_not(monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    monkeypatch.setattr("tipforce_tools.vcan.command.choose", lambda _interfaces: "uml")
    assert "`tipforce vcan` works: vcan0 and vcan1, in User-mode Linux, which boots here" in printed(0, ["doctor"]).out

    def lacking() -> int:
        raise EnvironmentLackError("User-mode Linux ended before it had booted\n  Kernel panic")

    for trial, finding, step in (
        (lacking, "User-mode Linux ended before it had booted", "`tipforce vcan -- true`"),
        (lambda: 1, "`tipforce vcan -- true` ended with 1", "sudo modprobe vcan"),
    ):
        (check,) = vcan_checks(trial)
        assert (check.state, check.finding) == ("note", finding)
        assert step in check.next_step


def test_missing_extras_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from tipforce_tools.doctor import machine as software

    monkeypatch.setitem(software.EXTRAS, "science", ("no-such-package",))
    checks = {check.topic: check for check in software_checks()}
    assert "science" in checks["extras"].finding
    assert "science" in checks["extras"].next_step


def test_a_missing_core_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    from tipforce_tools.doctor import machine as software

    monkeypatch.setattr(software, "core", None)
    (check,) = [check for check in software_checks() if check.topic == "core"]
    assert check.state == "note"
    assert "pip install --force-reinstall" in check.next_step


def test_faults_that_are_heard_are_named() -> None:
    frames = np.zeros(2, dtype=FRAME)
    frames["can_id"], frames["length"] = (0x085, 0x087), 8
    for row, (code, detail) in zip(frames, ((0x5020, 15), (0x8110, 0)), strict=True):
        row["data"] = np.frombuffer(struct.pack("<HBHHx", code, 0x21, detail, 0), dtype=np.uint8)
    found = [check.finding for check in heard(frames)]
    assert found == ["node 5: overload", "EMCY from 7"]
    frames["data"][1, :2] = 0x40, 0x82
    (check,) = [check for check in heard(frames) if check.state == "fail"]
    assert "7 reject the SYNC (EMCY 8240h)" in check.finding
    assert "0x1019" in check.next_step
