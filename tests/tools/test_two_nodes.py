"""Two nodes with one node-id: every command that speaks or listens to them says it, with the remedy; and it helps."""

import itertools
import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from canopen_device.core.node import Device
from host.bus_with_nodes import beam_calibration, connected, finger, new_channel, running
from tipforce.errors import DuplicateNodeError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.events import Supervisor
from tipforce.host.hand.file import HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.host.logs.reader import open_log
from tipforce.watching.bus_monitor import BusMonitor
from tipforce.watching.feeds import Finger, Watcher
from tipforce.watching.findings import Observed, findings
from tools.rig import Printed, until

SAID = "two nodes respond as node 5"
SPEAKING = (
    "scan", "scan --nodes 5 --wait 0.2 --json", "read 5", "tare 5", "tare 5 --show", "sdo read 5 0x1000 0",
    "sdo read 5 calibration.generation", "sdo write 5 0x1017 0 u16 200", "sdo dump 5", "config show 5",
    "config save 5 FOLDER/saved.toml", *(f"config {do} 5 FOLDER/settings.toml" for do in ("apply", "diff", "verify")),
    "calibrate apply FOLDER/cal.toml --node 5", "calibrate verify FOLDER/cal.toml --node 5",
    "calibrate guide --node 5 --auto --yes -q -o FOLDER/guided.toml", "firmware show 5", "nmt reset-node 5 --wait",
)  # fmt: skip
SERVICES = {
    "SDO": ({0x580, 0x600}, SAID),
    "heartbeats": ({0x700}, "two nodes send heartbeats as node 5"),
    "EMCY": ({0x080}, "node 5 reports that another node sends its identifier 0x705 (EMCY 8150h)"),
}


def node(serial: int, folder: Path | None = None) -> Device:
    store = None if folder is None else folder / f"{serial}.json"
    return finger(5, store=store, noise_microstrain=1.0, seed=serial, serial=serial)


@pytest.fixture(scope="module", params=[1006, 1005], ids=["other serial", "same serial"])
def bus(request: pytest.FixtureRequest) -> Iterator[tuple[str, int]]:
    channel = new_channel()
    with connected(node(1005), node(request.param), channel=channel):
        yield channel, request.param


@pytest.mark.parametrize("line", SPEAKING)
def test_a_command_that_speaks_to_the_node_says_it(
    line: str, bus: tuple[str, int], tmp_path: Path, printed: Printed
) -> None:
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    (tmp_path / "settings.toml").write_text('[objects]\n"heartbeat.producer_ms" = 500\n')
    channel, serial = bus
    ended = printed(1, f"{line.replace('FOLDER', str(tmp_path))} -i virtual -c {channel}")
    err = ended.err
    assert (err.count(SAID), "Traceback" in err) == (1, False), err
    if serial == 1006:
        assert "(serial numbers 1005, 1006): give one of them another node-id: `tipforce lss assign ID" in err
    else:
        assert "(serial number 1005): power only one, and give it another node-id" in err
    if "--json" in line:
        assert ended.records[0]["duplicate"].startswith(SAID)


def test_the_remedy_that_is_named_helps(tmp_path: Path, printed: Printed, channel: str) -> None:
    bus = f"-i virtual -c {channel}"
    with connected(node(1005, tmp_path), node(1006, tmp_path), channel=channel):
        for command in re.findall(r"`tipforce ([^`]+)`", printed(1, f"scan --wait 0.2 {bus}").err):
            printed(0, f"{command.replace('ID', '6')} {bus}")
        nodes = printed(0, f"scan --wait 0.2 --json {bus}").records
        serials = [(record["node_id"], record["serial"], record["duplicate"]) for record in nodes]
        assert serials == [(5, 1005, ""), (6, 1006, "")]


def log_of(service: str, folder: Path) -> Path:
    """A candump log in which one service alone shows that there are two nodes, beside SYNCs and a third node."""
    frames = [(0, 0x706, b"\x00")]
    for k in range(12):
        t_us = 500_000 * k
        frames += [(t_us, 0x080, b""), (t_us, 0x706, b"\x05")]
        if service == "SDO":
            frames.append((t_us, 0x605, bytes((0x40, 0, 0x10, 0, 0, 0, 0, 0))))
            frames += [(t_us + n, 0x585, bytes((0x43, 0, 0x10, 0, 0x94, 1, 2, 0))) for n in (1, 2)]
        elif service == "heartbeats":
            frames += [(t_us + n, 0x705, b"\x05") for n in (1, 100_000)]
        elif k == 6:
            frames.append((t_us, 0x085, bytes((0x50, 0x81, 0x11, 0x05, 0x07, 0, 0, 0))))
    path = folder / f"{service}.log"
    lines = [f"({t_us / 1e6:.6f}) vcan0 {can_id:03X}#{data.hex().upper()}" for t_us, can_id, data in frames]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("service", SERVICES)
@pytest.mark.parametrize(
    "line",
    [
        "decode LOG -o OUT.csv", "decode LOG -o OUT.csv --json", "dump LOG --decode", "monitor LOG --once 5.8",
        "monitor LOG --once 5.8 --json",
    ],
)  # fmt: skip
def test_a_command_that_reads_a_log_says_it(line: str, service: str, tmp_path: Path, printed: Printed) -> None:
    words = line.replace("LOG", str(log_of(service, tmp_path))).replace("OUT", str(tmp_path / "out")).split()
    ended = printed(0, words)
    assert SERVICES[service][1] in ended.out + ended.err
    if line.startswith("decode"):
        assert "duplicate" in (tmp_path / "out.events.csv").read_text()
    if line == "monitor LOG --once 5.8 --json":
        last = ended.records[-1]["buses"][0]["nodes"]
        assert [bool(one["duplicate"]) for one in last] == [True, False]


@pytest.mark.parametrize("service", SERVICES)
def test_doctor_the_page_and_a_hand_say_it_of_frames(service: str, tmp_path: Path) -> None:
    with open_log(str(log_of(service, tmp_path))) as log:
        frames = np.concatenate(list(log))
    cause = SERVICES[service][1]
    seen = Observed()
    seen.take(frames)
    assert [finding.finding for finding in findings(seen) if finding.state == "fail"] == [cause]
    said = [] if service == "SDO" else [cause]  # their own SDO channels say that: those see all requests
    for events in (Watcher(Finger, fingers=[Finger(5)]).add(frames, 0.0)[1], Supervisor([5]).add(frames, 0.0)):
        assert [event.text.partition(":")[0] for event in events if event.kind == "duplicate"] == said


def test_monitor_sees_the_samples_of_two_nodes() -> None:
    channel, monitor = new_channel(), BusMonitor()
    with connected(node(1005), node(1006), channel=channel) as (connection, _):
        connection.nmt("start", 5)
        connection.buffer.clear()
        for _ in range(40):
            connection.sync()
            time.sleep(0.005)
        frames = connection.buffer.take_all()
        monitor.feed(frames[(frames["can_id"] >= 0x180) & (frames["can_id"] < 0x580)])  # the PDOs
    assert monitor.view(0).nodes[0].duplicate.startswith("two nodes send the samples of node 5")


@pytest.mark.parametrize("passive", [False, True])
def test_a_second_node_that_comes_while_samples_are_read_ends_them(passive: bool, channel: str) -> None:
    with connected(node(1005), channel=channel) as (connection, _):
        connection.nmt("start", 5)
        assert next(connection.finger(5).samples()).node_id == 5
        if passive:
            connection.finger(5).close()
        own = connection.finger(5, passive=passive)
        with running([node(1006)], channel):
            connection.wait_for({0x705}, 10.0)
            connection.nmt("start", 5)

            def read() -> None:
                for _ in range(200):
                    connection.sync()
                    own.read(timeout_s=1.0)

            with pytest.raises(DuplicateNodeError, match="node 5"):
                read()


def test_a_hand_shows_no_value_of_two_nodes_and_goes_on_when_one_has_gone(channel: str) -> None:
    seen: list[tuple[str, str]] = []
    plan = HandPlan(sync_hz=50.0, heartbeat_ms=100)
    with connected(node(1005), channel=channel) as (connection, _), Hand.open([5], bus=connection, plan=plan) as hand:
        hand.on_event(lambda event: seen.append((event.kind, event.text)))
        for row in itertools.islice(hand.rows(timeout_s=5.0), 5):
            assert row
        with running([node(1006)], channel):
            until(lambda: any(kind == "duplicate" for kind, _ in seen))
            until(lambda: any(kind == "failed" and SAID in text for kind, text in seen))
            assert not hand.settled()
        until(hand.settled)
