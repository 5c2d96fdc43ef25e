"""The bus flags, which are python-can's to the letter; `tipforce doctor`: what stands in the way, and the next step.

On a second person's board the first command that somebody would try names what is missing, and the remedy."""

import argparse
import re
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import can.cli
import pytest
from can.interfaces import BACKENDS

from host.bus_with_nodes import beam_calibration, connected, finger, new_channel, running
from tipforce.dictionary import objects as od
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.network.bus import Bus
from tipforce.host.network.interfaces import Link, link_of
from tipforce.watching.findings import Observed, findings
from tipforce_tools.cli import bus_flags
from tipforce_tools.doctor import machine
from tipforce_tools.doctor.machine import configuration_check, interface_check
from tools.rig import Printed, exit_code, message, sending


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
    plugins = entry_points(group="can.interface").names
    assert set(BACKENDS) - plugins <= set(bus_flags.BUILT_IN_INTERFACES) <= set(BACKENDS)


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
print("my_interface" in parser.format_help(), "can" in sys.modules)
assert parser.parse_args(["-i", "my_interface"]).interface == "my_interface"
"""


def test_an_interface_of_a_plugin_is_allowed_and_listed(tmp_path: Path) -> None:
    info = tmp_path / "plugin-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[can.interface]\nmy_interface = my_module:MyBus\n")
    code = f"import sys\nsys.path.append({str(tmp_path)!r})\n{LISTED}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "True False\n"), done.stderr


UP = {"ifname": "can0", "flags": ["NOARP", "UP"], "txqlen": 1000}


def can_link(changes: Mapping[str, object] = UP, **info: Any) -> Link:
    """A real interface, as `ip -details -json link show` has it."""
    data = {"bittiming": {"bitrate": 500000}} | info
    return link_of({**UP, "linkinfo": {"info_kind": "can", "info_data": data}, **changes})


PASSIVE = can_link(state="ERROR-PASSIVE", berr_counter={"tx": 128, "rx": 0})
FASTER = "set can0 up type can bitrate 1000000"


@pytest.fixture(autouse=True)
def _no_other_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    """test_vcan_boot.py and test_udp_multicast.py have the real ones."""
    monkeypatch.setattr("tipforce_tools.kernel.uml.run_with_vcan", lambda *_, **_options: 0)
    monkeypatch.setattr("tipforce_tools.doctor.machine.multicast_checks", lambda: ())


def test_a_bus_with_nodes_is_listened_to(printed: Printed, channel: str) -> None:
    with connected(finger(5), channel=channel) as (connection, _):
        connection.sdo(5).write(od.HEARTBEAT_PRODUCER_MS, 20)
        connection.finger(5).apply_calibration(beam_calibration(), store=False)
        records = printed(0, f"doctor --listen 0.3 --json -i virtual -c {channel}").records
    checks = {check["topic"]: check for check in records}
    shown = "pre-operational, simulated fingertip, 3 gauges, serial 1005"
    assert (checks["node 5 (0x05)"]["state"], checks["node 5 (0x05)"]["finding"]) == ("ok", shown)
    assert "frames/s" in checks["traffic"]["finding"]
    assert checks["software"]["state"] == "ok"


def test_a_bus_that_does_not_open(printed: Printed) -> None:
    out = printed(1, "doctor --listen 0.01 -i socketcan -c nowhere9").out
    assert "fail bus: " in out
    assert "->" in out


@pytest.mark.parametrize(
    ("link", "state", "finding", "step"),
    [
        (can_link(), "ok", "up, 500000 bit/s", ""),
        (can_link({"flags": ["NOARP"]}), "fail", "down, 500000", "ip link set can0 up type can bitrate 500000"),
        (can_link(state="BUS-OFF"), "fail", "bus-off", "type can restart"),
        (PASSIVE, "fail", "sent 128", FASTER),
        (can_link({"txqlen": 10}), "note", "queue of 10", "txqueuelen 1000"),
        (can_link({"linkinfo": {"info_kind": "vcan"}, "txqlen": 10}), "ok", "up, virtual", ""),
    ],
)
def test_interfaces(link: Link, state: str, finding: str, step: str) -> None:
    last = interface_check(link)
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
    assert "`tipforce vcan` works: vcan0 and vcan1, in User-mode Linux, which boots here" in printed(0, "doctor").out

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


# --- a second person's board ------------------------------------------------------------------------------------

SITUATIONS = {
    "silent": "nothing received for .*: power the nodes; .*bit rate",
    "not started": r"node 5 \(0x05\): not started: tipforce nmt start 5 --wait",
    "no SYNC": "no SYNC on this bus: .*--sync 100",
    "not calibrated": r"node 5 \(0x05\): not calibrated: tipforce calibrate guide --node 5, or apply CAL.toml",
    "two nodes": "two nodes .* node 5|another node sends its identifier.*: .*`tipforce (lss assign|scan)",
}
COMMANDS = (
    "scan --wait 0.3", "monitor --once 1", "dump --decode -T 1000 -n 60", "log -o FOLDER/run.log --seconds 1",
    "view --port 0", "doctor --listen 0.3",
)  # fmt: skip


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits of a tenth of a second, and a page that is served for a second."""
    for name in ("findings.SILENT_S", "findings._NO_SYNC_S"):
        monkeypatch.setattr(f"tipforce.watching.{name}", 0.1)
    monkeypatch.setattr("tipforce_tools.cli.listening._HINT_S", 0.1)
    monkeypatch.setattr("tipforce_tools.doctor.machine.iio_checks", lambda: ())
    sleep = time.sleep

    def serve(_seconds: float) -> None:
        sleep(1.0)
        raise KeyboardInterrupt

    clock = SimpleNamespace(sleep=serve, monotonic=time.monotonic)
    monkeypatch.setattr("tipforce_tools.page.server.time", clock)


@pytest.fixture(scope="module", params=SITUATIONS)
def situation(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    """The name of a situation, and the channel of its virtual bus."""
    name, channel = request.param, new_channel()
    with ExitStack() as opened:
        if name != "silent":
            nodes = [finger(5), *([finger(5, serial=1006, seed=2)] if name == "two nodes" else [])]
            connection = opened.enter_context(Bus.open(channel, "virtual"))
            opened.enter_context(running(nodes, channel))
            connection.wait_for({0x705}, 10.0)
            connection.sdo(5).write(od.HEARTBEAT_PRODUCER_MS, 60)
            if name not in {"not calibrated", "two nodes"}:
                connection.finger(5).apply_calibration(beam_calibration(), store=False)
            if name in ("no SYNC", "not calibrated"):
                connection.nmt("start", 5)
            if name in ("not calibrated", "two nodes"):  # SYNCs; requests of the serial number
                frame = message(0x080) if name == "not calibrated" else message(0x605, b"\x40\x18\x10\x04\0\0\0\0")
                opened.enter_context(sending(channel, lambda _number: [frame], 0.02))
        yield name, channel


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("command", COMMANDS)
def test_the_first_command_names_cause_and_remedy(
    command: str, situation: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, channel = situation
    code = exit_code(f"{command.replace('FOLDER', str(tmp_path))} -i virtual -c {channel}")
    assert not command.startswith("doctor") or code == (name in ("two nodes", "not calibrated"))
    text = "".join(reversed(capsys.readouterr())).replace(" -> ", ": ")
    assert len(re.findall(f"^.*(?:{SITUATIONS[name]}).*$", text, re.MULTILINE)) == 1, text


@pytest.mark.usefixtures("impatient")
def test_what_a_filter_leaves_out_is_not_missing(printed: Printed) -> None:
    assert printed(0, f"dump {new_channel()},185:7FF --decode -T 500 -i virtual") == ("", "")


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("command", ["hand check", "doctor --listen 0.3"])
def test_a_finger_that_does_not_respond_and_swapped_serial_numbers(
    command: str, tmp_path: Path, printed: Printed
) -> None:
    """The remedy that is named helps."""
    path, channel = tmp_path / "hand.toml", new_channel()
    bus = f"-i virtual -c {channel}"
    words = f"{command} {path} {bus}"
    tables = '[[finger]]\nnode_id = 5\nserial = 1006\nname = "thumb"\n[[finger]]\nnode_id = 6\nname = "index"\n'
    path.write_text(tables.replace("serial = 1006\n", ""))
    with running([finger(5)], channel):
        text = "".join(printed(command.startswith("doctor"), words))
        assert "no identity on the bus: index (6)" in text
        assert "`tipforce lss scan`" in text
        path.write_text(f"{tables}serial = 1005\n")
        with running([finger(6)], channel):
            text = "".join(printed(1, words))
            assert "swapped serial numbers: thumb (5) has 1005, index (6) has 1006" in text
            for remedy in re.findall(r"`tipforce ([ln][^`]+)`", text):
                printed(0, f"{remedy} {bus}")
            time.sleep(0.2)
            assert "swapped" not in str(printed({0, 1}, words))


@pytest.mark.parametrize(
    ("seen", "finding", "step"),
    [
        (Observed(errors=7), "another bit rate than that of the nodes, or no node acknowledges: 7 error", "-b 1000000"),
        (
            Observed(errors=7, link=can_link()),
            "(500000 bit/s here), or no node acknowledges: 7 error frames, and",
            FASTER,
        ),
        (Observed(heard_s=3.0, link=PASSIVE), "error-passive, errors sent 128, received 0, and no other frame", FASTER),
        (Observed(heard_s=3.0, link=can_link(state="BUS-OFF")), "can0 is bus-off", "type can restart"),
        (Observed(errors=7, frames=9), "7 error frames beside 9 frames", "dump -e can0,#FFFFFFFF"),
        (Observed(emergencies={7: (0x8240, 0x11)}), "node 7 (0x07): the SYNC does not fit 1019h", "sdo write 7 0x1019"),
        (Observed(emergencies={7: (0x8110, 0x11)}), "EMCY 0x8110 CAN overrun", "sdo dump 7"),
        (Observed(emergencies={7: (0x8150, 0x11)}), "EMCY 0x8150 COB-ID collision", "sdo dump 7"),  # SDO shows one node
        (Observed(faults={5: "overload"}), "node 5 (0x05): overload", "sdo read 5 faults"),
        (Observed(states={1: 127, 2: 4, 3: 127, 9: 127}), "nodes 1-3,9: not started", "nmt start 1-3,9 --wait"),
    ],
)
def test_a_finding_has_its_remedy(seen: Observed, finding: str, step: str) -> None:
    (only,) = findings(seen)
    assert finding in only.finding
    assert step in only.next_step


def test_nothing_is_said_of_a_bus_that_works_nor_of_another_device() -> None:
    """TPDO2 of another device: no status of a fingertip is in it."""
    contact = struct.pack("<hhhBB", 10, 20, 30, 3, 1)
    frames = [(0, 0x080, b""), (1, 0x705, b"\x05"), (2, 0x285, contact), (3, 0x286, bytes(8)), (4, 0x085, bytes(8))]
    seen = Observed(heard_s=9.0)
    seen.take(frame_array(frames))
    assert findings(seen) == []
    assert (seen.frames, seen.syncs, seen.states, seen.calibrated) == (5, 1, {5: 5}, {5: True})


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"can0": True, "can1": False}, "bus: -i socketcan -c can0, the only CAN interface that is up"),
        ({"can0": True, "can1": True}, "no bus given: can0, can1 are up: add -i socketcan -c can0"),
        ({"can3": False}, "no bus given: can3 down; `sudo ip link set can3 up type can bitrate 1000000`"),
    ],
)
@pytest.mark.parametrize("command", ["scan", "read 5", "monitor", "log -o x", "view", "node --node-id 5", "hand up H"])
def test_the_interface_is_the_only_one_that_is_up(
    command: str, known: dict[str, bool], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    printed: Printed,
) -> None:  # fmt: skip
    def refuse(*_: object, **options: object) -> None:
        raise EnvironmentLackError(f"it would open {options or _}")

    monkeypatch.setattr("tipforce.host.network.interfaces.interfaces", lambda: known)
    for name in ("host.network.interfaces.open_bus", "host.live.receive.open_socket", "host.hand.link.open_bus"):
        monkeypatch.setattr(f"tipforce.{name}", refuse)
    monkeypatch.setattr("canopen_device.running.ports.SocketCanPort.__init__", refuse)
    monkeypatch.setattr("tipforce.host.hand.link.open_receiver", refuse)
    monkeypatch.chdir(tmp_path)
    Path("H").write_text("[[finger]]\nnode_id = 5\n")
    err = printed(2, command.split()).err
    assert said in err
    assert ("it would open" in err and "can0" in err) == said.startswith("bus")
    if command == "scan":  # a channel alone is an interface of the kernel
        assert re.search("would open .*can7", printed(2, "scan -c can7").err)
