"""The bus flags, which are python-can's to the letter; and `tipforce doctor`: what stands in the way, the next step."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import can
import can.cli
import pytest
from can.interfaces import BACKENDS

from host.bus_with_nodes import beam_calibration, connected, finger, new_channel
from tipforce.dictionary import objects as od
from tipforce.errors import EnvironmentLackError
from tipforce.host.network.interfaces import link_of
from tipforce_tools.cli import bus_flags
from tipforce_tools.cli.main import main
from tipforce_tools.doctor import machine
from tipforce_tools.doctor.machine import configuration_check, interface_check
from tools.rig import Printed


def parsers() -> tuple[argparse.ArgumentParser, argparse.ArgumentParser]:
    ours, theirs = (argparse.ArgumentParser(prog="x") for _ in range(2))
    bus_flags.add_bus_flags(ours)
    can.cli.add_bus_arguments(theirs)
    return ours, theirs


def described(action: argparse.Action) -> dict[str, Any]:
    """What a flag takes; the words of its help are ours."""
    names = ("option_strings", "dest", "nargs", "const", "default", "type", "required")
    choices = None if action.choices is None else list(action.choices)
    return {name: getattr(action, name) for name in names} | {"choices": choices}


def test_the_flags_are_python_cans() -> None:
    ours, theirs = (
        [(group.title, [described(action) for action in group._group_actions]) for group in parser._action_groups]
        for parser in parsers()
    )
    assert ours == theirs
    assert ours[-1][0] == "bus arguments"


def test_the_built_in_interfaces_are_python_cans() -> None:
    plugins = {entry.name for entry in importlib.metadata.entry_points(group="can.interface")}
    assert set(bus_flags.BUILT_IN_INTERFACES) >= set(can.VALID_INTERFACES) - plugins
    assert set(bus_flags.BUILT_IN_INTERFACES) <= set(BACKENDS)


TIMING = "--timing f_clock=8000000 tseg1=5 tseg2=2 sjw=2 brp=2 nof_samples=1"


@pytest.mark.parametrize(
    "words",
    [
        "", "-i socketcan -c vcan0 -b 500000", "--interface virtual --channel x --fd --data-bitrate 2000000", TIMING,
        "--bus-kwargs a=1 b=x c=True d=1.5", "-i nothing", "-b fast", "--timing f_clock=8000000", "--timing x",
        "--bus-kwargs =1",
    ],
)  # fmt: skip
def test_they_parse_as_python_cans(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    results = []
    for parser in parsers():
        try:
            found: Any = {name: str(value) for name, value in vars(parser.parse_args(words.split())).items()}
        except SystemExit as end:
            found = end.code, capsys.readouterr().err.partition("error: ")[2]
        results.append(found)
    assert results[0] == results[1]
    capsys.readouterr()


def test_stdout_stays_for_data(capsys: pytest.CaptureFixture[str]) -> None:
    parsers()[0].parse_args(TIMING.split())
    out, err = capsys.readouterr()
    assert not out
    assert "CLK: 8MHz" in err


LISTED = """\
import argparse, sys
from tipforce_tools.cli import bus_flags
parser = argparse.ArgumentParser()
bus_flags.add_bus_flags(parser)
assert "can" not in sys.modules
text = parser.format_help()
print("can" in sys.modules, "my_interface" in text)
assert parser.parse_args(["-i", "my_interface"]).interface == "my_interface"
"""


def test_an_interface_of_a_plugin_is_allowed_and_listed(tmp_path: Path) -> None:
    info = tmp_path / "plugin-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[can.interface]\nmy_interface = my_module:MyBus\n")
    code = f"import sys\nsys.path.append({str(tmp_path)!r})\n{LISTED}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "True True\n"), done.stderr


UP = {"ifname": "can0", "flags": ["NOARP", "UP"], "txqlen": 1000}


def can_link(**info: Any) -> dict[str, Any]:
    """What `ip -details -json link show` says of a real interface."""
    return UP | {"linkinfo": {"info_kind": "can", "info_data": {"bittiming": {"bitrate": 500000}} | info}}


@pytest.fixture(autouse=True)
def _no_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("can.util.CONFIG_FILES", [])
    # test_vcan_boot.py has the real one
    monkeypatch.setattr("tipforce_tools.kernel.uml.run_with_vcan", lambda *_, **_options: 0)
    monkeypatch.setattr("tipforce_tools.doctor.machine.multicast_checks", lambda: ())  # test_udp_multicast.py


def test_a_bus_with_nodes_is_listened_to(capsys: pytest.CaptureFixture[str]) -> None:
    channel = new_channel()
    with connected(finger(5), channel=channel) as (connection, _):
        connection.sdo(5).write(od.HEARTBEAT_PRODUCER_MS, 20)
        connection.finger(5).apply_calibration(beam_calibration(), store=False)
        assert main(["doctor", "--listen", "0.3", "--json", "-i", "virtual", "-c", channel]) == 0
    checks = {check["topic"]: check for check in map(json.loads, capsys.readouterr().out.splitlines())}
    shown = "pre-operational, simulated fingertip, 3 gauges, serial 1005"
    assert (checks["node 5 (0x05)"]["state"], checks["node 5 (0x05)"]["finding"]) == ("ok", shown)
    assert "frames/s" in checks["traffic"]["finding"]
    assert checks["software"]["state"] == "ok"


def test_a_bus_that_does_not_open(printed: Printed) -> None:
    out = printed(1, ["doctor", "--listen", "0.01", "-i", "socketcan", "-c", "nowhere9"]).out
    assert "fail bus: " in out
    assert "->" in out


@pytest.mark.parametrize(
    ("link", "state", "finding", "step"),
    [
        (can_link(), "ok", "up, 500000 bit/s", ""),
        (can_link() | {"flags": ["NOARP"]}, "fail", "down, 500000", "ip link set can0 up type can bitrate 500000"),
        (can_link(state="BUS-OFF"), "fail", "bus-off", "type can restart"),
        (can_link(state="ERROR-PASSIVE", berr_counter={"tx": 128, "rx": 0}), "fail", "sent 128", "bitrate 1000000"),
        (can_link() | {"txqlen": 10}, "note", "queue of 10", "txqueuelen 1000"),
        (UP | {"linkinfo": {"info_kind": "vcan"}, "txqlen": 10}, "ok", "up, virtual", ""),
    ],
)
def test_interfaces(link: dict[str, Any], state: str, finding: str, step: str) -> None:
    last = interface_check(link_of(link))
    assert last.state == state
    assert finding in last.finding
    assert step in last.next_step


def test_where_the_name_comes_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    flags = {"interface": "virtual"}
    assert "flags (--interface virtual)" in configuration_check(flags, flags).finding
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "can7")
    assert configuration_check({}, {}).finding.startswith("socketcan can7, from CAN_INTERFACE=socketcan")
    monkeypatch.setenv("CAN_INTERFACE", "nonsense")
    assert configuration_check({}, {}).state == "fail"
    monkeypatch.delenv("CAN_INTERFACE")
    monkeypatch.delenv("CAN_CHANNEL")
    path = tmp_path / "can.conf"
    path.write_text("[default]\ninterface = virtual\nchannel = hand\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(path)])
    assert configuration_check({}, {}).finding == f"virtual hand, from {path}"


def test_vcan_that_works_and_vcan_that_does_not(monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    monkeypatch.setattr("tipforce_tools.kernel.host.choose", lambda _interfaces: "uml")
    assert "`tipforce vcan` works: vcan0 and vcan1, in User-mode Linux, which boots here" in printed(0, ["doctor"]).out

    def lacking(*_: object, **_options: object) -> int:
        raise EnvironmentLackError("User-mode Linux ended before it had booted\n  Kernel panic")

    for trial, finding, step in (
        (lacking, "User-mode Linux ended before it had booted", "`tipforce vcan -- true`"),
        (lambda *_, **_options: 1, "`tipforce vcan -- true` ended with 1", "sudo modprobe vcan"),
    ):
        monkeypatch.setattr("tipforce_tools.kernel.uml.run_with_vcan", trial)
        (check,) = machine.vcan_checks()
        assert (check.state, check.finding) == ("note", finding)
        assert step in check.next_step


def test_missing_extras_and_a_missing_core_are_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(machine.EXTRAS, "science", "no-such-package")
    monkeypatch.setattr(machine, "core", None)
    checks = {check.topic: check for check in machine.software_checks()}
    assert "science" in checks["extras"].finding
    assert "science" in checks["extras"].next_step
    assert checks["core"].state == "note"
    assert "pip install --force-reinstall" in checks["core"].next_step
