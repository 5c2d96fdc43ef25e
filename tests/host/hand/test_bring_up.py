"""Bring-up of whole hands on the in-process bus: unconfigured nodes, wrong ones, and ones that fail half-way."""

import contextlib
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import can
import msgspec
import pytest

from canopen_device.core import codes
from canopen_device.core.node import Device
from host.bus_with_nodes import FaultyBus, beam_calibration, connected, finger, new_channel, running
from tipforce.dictionary import objects as od
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.bring_up import STEPS, FingerReport, bring_up
from tipforce.host.hand.events import Event
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan, read_hand
from tipforce.host.network import find
from tipforce.host.network.bus import Bus


def node(node_id: int, serial: int, folder: Path) -> Device:
    return finger(node_id, store=folder / f"node-{serial}.json", serial=serial)


def plan(*fingers: tuple[int, int], folder: Path, store: bool = False) -> HandFile:
    """A hand of (node-id, serial) with one calibration for all."""
    write_calibration(folder / "cal.toml", beam_calibration())
    return HandFile(
        finger=tuple(FingerPlan(node_id=n, serial=serial, calibration="cal.toml") for n, serial in fingers),
        hand=HandPlan(sync_hz=100, heartbeat_ms=20, store=store),
        folder=str(folder),
    )


@contextlib.contextmanager
def hand_of(*devices: Device) -> Iterator[tuple[Bus, FaultyBus]]:
    """Running nodes, some perhaps without a node-id, and a host on their bus."""
    channel = new_channel()
    with connected(channel=channel) as (connection, bus), running(devices, channel):
        yield connection, bus


def lose(bus: FaultyBus, service: int, count: int) -> None:
    """Lose the first responses to an LSS service."""
    number = itertools.count()

    def fault(message: can.Message) -> can.Message | None:
        lost = message.arbitration_id == codes.LSS_RESPONSE_COB_ID and message.data[0] == service
        return None if lost and next(number) < count else message

    bus.fault = fault


def up(connection: Bus, hand: HandFile) -> tuple[list[FingerReport], list[Event]]:
    events: list[Event] = []
    return bring_up(connection, hand, events.append)[0], events


def test_five_unconfigured_nodes_are_up_within_three_seconds(tmp_path: Path) -> None:
    serials = (1001, 0x80000001, 7, 65536, 12)
    hand = plan(*((k + 1, serial) for k, serial in enumerate(serials)), folder=tmp_path, store=True)
    with hand_of(*(node(255, serial, tmp_path) for serial in serials)) as (connection, _):
        reports, events = up(connection, hand)
        assert [str(report) for report in reports if not report.ok] == []
        assert all(tuple(report.done) == STEPS for report in reports)
        for k, serial in enumerate(serials):
            sdo = connection.sdo(k + 1)
            assert sdo.read(od.IDENTITY_SERIAL) == serial
            assert sdo.read(od.CALIBRATION_ACTIVE_CRC) == beam_calibration().crc32()
            assert sdo.read(od.TPDO1_COB_ID) == 0xC0000181 + k  # gauges are off: the hand reads contact alone
            assert connection.heartbeats.state(k + 1) == 5
        kinds = [event.kind for event in events if event.node_id == 3]
        assert kinds == ["assigned", "found", "configured", "calibrated", "started"]
        # Again: all is found as it should be, and the calibration is left alone.
        reports, events = up(connection, hand)
        assert all(report.ok for report in reports)
        assert all("already active" in event.text for event in events if event.kind == "calibrated")


@pytest.mark.parametrize("service", [codes.LSS_SELECTED, codes.LSS_INQUIRE_NODE_ID, codes.LSS_NODE_ID])
def test_a_lost_response_to_lss_is_no_absent_node(tmp_path: Path, service: int) -> None:
    with hand_of(node(255, 30, tmp_path)) as (connection, bus):
        lose(bus, service, 1)
        reports, _ = up(connection, plan((8, 30), folder=tmp_path))
        assert [str(report) for report in reports if not report.ok] == []


@pytest.mark.parametrize("serials", [(30, 20), (0, 0)])
@pytest.mark.parametrize("service", [codes.LSS_INQUIRE_NODE_ID, codes.LSS_NODE_ID])
def test_one_that_fails_in_lss_does_not_take_the_next_ones_node_id(
    tmp_path: Path, serials: tuple[int, int], service: int
) -> None:
    """The first that was found is still selected when it is given up."""
    with hand_of(node(255, 30, tmp_path), node(255, 20, tmp_path)) as (connection, bus):
        lose(bus, service, 2)
        reports, _ = up(connection, plan((8, serials[0]), (9, serials[1]), folder=tmp_path))
        assert [report.failed for report in reports] == ["find", ""]
        assert "within 0.4 s" in reports[0].error
        if serials[0]:
            assert connection.sdo(9).read(od.IDENTITY_SERIAL) == 20


def test_without_serials_ids_are_given_in_the_order_of_the_file(tmp_path: Path) -> None:
    with hand_of(node(255, 30, tmp_path), node(255, 20, tmp_path)) as (connection, _):
        reports, _ = up(connection, plan((8, 0), (9, 0), folder=tmp_path))
        assert all(report.ok for report in reports)
        assert [connection.sdo(n).read(od.IDENTITY_SERIAL) for n in (8, 9)] == [20, 30]


def test_a_node_at_another_id_is_moved(tmp_path: Path) -> None:
    with hand_of(node(40, 1001, tmp_path)) as (connection, _):
        reports, events = up(connection, plan((1, 1001), folder=tmp_path))
        assert [str(report) for report in reports] == ["finger 1: up"]
        assert "before 40" in events[0].text


def test_one_that_fails_half_way_does_not_hold_the_others(tmp_path: Path) -> None:
    """Node 2 falls silent while it is being configured."""
    with hand_of(*(node(n, n, tmp_path) for n in (1, 2, 3))) as (connection, bus):
        connection.sdo(2).retries = 0

        def deaf_at_the_heartbeat(message: can.Message) -> can.Message | None:
            if message.arbitration_id == 0x582 and message.data[1:3] == b"\x17\x10":
                return None
            return message

        bus.fault = deaf_at_the_heartbeat
        reports, events = up(connection, plan((1, 1), (2, 2), (3, 3), folder=tmp_path))
        assert [report.failed for report in reports] == ["", "configure", ""]
        assert "0x1017:00: no response" in reports[1].error
        assert [(e.node_id, e.kind) for e in events if e.kind == "failed"] == [(2, "failed")]
        assert [connection.heartbeats.state(n) for n in (1, 3)] == [5, 5]


@pytest.mark.parametrize(
    ("nodes", "wanted", "failed", "text"),
    [
        ("1:1 2:2", "1:2 2:1", "2 at identity", "check for swapped fingers"),
        ("1:1", "1:1 2:2", "2 at find", "a node with serial 2 does not respond to LSS"),
        ("1:1", "1:1 2:0", "2 at find", "a node without a node-id does not respond to LSS"),
        ("1:1 1:2 3:3", "1:1 3:3", "1 at find", "two nodes respond as node 1 (serial numbers 1, 2)"),
        ("3:3 1:1", "3:3 1:1", "1 at calibrate", "locked"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, nodes: str, wanted: str, failed: str, text: str) -> None:
    """Of nodes and fingers with these node-ids and serial numbers."""
    present, fingers = ([(int(word[0]), int(word[2])) for word in words.split()] for words in (nodes, wanted))
    with hand_of(*(node(node_id, serial, tmp_path) for node_id, serial in present)) as (connection, _):
        if text == "locked":
            connection.sdo(1).write(od.CALIBRATION_LOCK, 1)
        reports, _ = up(connection, plan(*fingers, folder=tmp_path))
        wrong = {f"{report.plan.node_id} at {report.failed}": report.error for report in reports if not report.ok}
        assert text in wrong[failed]
        assert "1:2" in wanted or len(wrong) == 1


def test_responses_to_another_master_are_no_second_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with hand_of(node(1, 1, tmp_path)) as (connection, _):

        def sleep(seconds: float) -> None:
            connection.send(0x601, bytes((0x40, 0x18, 0x10, 1, 0, 0, 0, 0)))
            time.sleep(seconds)

        monkeypatch.setattr(find, "time", SimpleNamespace(sleep=sleep))
        assert find.responding_nodes(connection) == {1}


def test_a_stopped_node_is_brought_back(tmp_path: Path) -> None:
    with hand_of(node(1, 1, tmp_path)) as (connection, _):
        connection.nmt("stop", 1)
        time.sleep(0.05)
        reports, _ = up(connection, plan((1, 1), folder=tmp_path))
        assert reports[0].ok


GOOD = """
[bus]
interface = "virtual"
channel = "hand"
[hand]
sync_hz = 500
pdos = ["Contact", "gauges"]
[[finger]]
name = "thumb"
node_id = 1
serial = 5
calibration = "cal.toml"
config = "own.toml"
"""


def test_a_file_is_read_with_what_it_names(tmp_path: Path) -> None:
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    (tmp_path / "own.toml").write_text('[objects]\n"sample_period_us:1" = 250\n')
    (tmp_path / "hand.toml").write_text(GOOD)
    hand = read_hand(tmp_path / "hand.toml")
    assert hand.bus == {"interface": "virtual", "channel": "hand"}
    assert (hand.node_ids, hand.messages, hand.finger[0].label) == ((1,), ("Contact", "Gauges"), "thumb (1)")
    assert hand.configuration(hand.finger[0])[0x6114, 1][1] == 250
    assert msgspec.structs.asdict(hand.hand)["heartbeat_ms"] == 100


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("node_id = 1", "node_id = 128", "thumb: node_id = 128, allowed are 1 to 127"),
        ("node_id = 1", "", "hand.toml: finger[1].node_id is missing"),
        ("sync_hz = 500", "sync_hz = -1", "[hand] sync_hz = -1"),
        ("sync_hz = 500", "sync_Hz = 500", "hand.sync_Hz: no such key; did you mean sync_hz? allowed: sync_hz, pdos"),
        ("sync_hz = 500", "sync_hz = inf", "hand.sync_hz is inf: allowed are finite numbers"),
        ("node_id = 1", 'node_id = "1"', "finger[1].node_id is '1': expected int, got str"),
        ("node_id = 1", "node_id = true", "finger[1].node_id is True: expected int, got bool"),
        ("[[finger]]", "[[fingers]]", "fingers: no such key; did you mean finger? allowed: finger, hand, bus"),
        ("[bus]", 'folder = "x"\n[bus]', "folder: no such key; allowed: finger, hand, bus"),
        ("[bus]", "[bus", "line 2"),
        ('"gauges"', '"health"', "allowed are gauges, contact, force"),
        ("cal.toml", "none.toml", "none.toml: No such file"),
        ("own.toml", "none.toml", "none.toml: No such file"),
        ("serial = 5", "serial = 5\ngauges = 4", "cal.toml has 3 gauges, the finger 4"),
        ("serial = 5", 'serial = 5\nlayout = "IV"', "allowed are I, II, III"),
        ("[[finger]]", "[[finger]]\nnode_id = 1\n[[finger]]", "node_id = 1 is a duplicate"),
        ("[[finger]]", "[finger]", "write [[finger]]"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, old: str, new: str, text: str) -> None:
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    (tmp_path / "own.toml").write_text('[objects]\n"sample_period_us:1" = 250\n')
    path = tmp_path / "hand.toml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(Exception, match=r".") as caught:
        read_hand(path)
    assert text in str(caught.value)
    assert str(path) in str(caught.value)
