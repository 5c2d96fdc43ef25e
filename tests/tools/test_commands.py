"""scan, sdo, nmt, read, lss, tare, config, calibrate, hand and export, run in this process against nodes on the
in-process bus."""

import io
import re
import struct
import sys
import threading
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from canopen_device import types
from canopen_device.core.node import Device
from canopen_device.running.store import FileStore
from device.tiny import service_dictionary
from host.bus_with_nodes import apply_load, beam_calibration, connected, finger, running
from tipforce.dictionary import objects as od
from tipforce.dictionary.names import entries
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.configuration.device_objects import FingertipObjects
from tipforce.host.network.bus import Bus
from tipforce.sources.simulated import SimulatedSource
from tools.rig import Printed, exit_code

ROOT = Path(__file__).parents[2]
HINT = "node {0} (0x0{0}): not calibrated: tipforce calibrate guide --node {0}, or apply CAL.toml\n"


@pytest.fixture
def bench(tmp_path: Path, channel: str) -> Iterator[Bus]:
    """The bus of nodes 5 (with a store) and 6 (without)."""
    with connected(finger(5, store=tmp_path / "node.json"), finger(6), channel=channel) as (connection, _):
        yield connection


@pytest.fixture
def unconfigured(tmp_path: Path, channel: str) -> Iterator[Bus]:
    """Three nodes without a node-id, serials 7, 0x80000001 and 9, and node 20; they can store."""
    devices = [finger(255, store=tmp_path / f"{serial}.json", serial=serial) for serial in (7, 0x80000001, 9)]
    with connected(finger(20), channel=channel) as (connection, _), running(devices, channel):
        yield connection


@pytest.fixture
def on_bus(request: pytest.FixtureRequest, channel: str, printed: Printed) -> Printed:
    """``printed`` on the bus of ``bench`` or ``unconfigured``."""
    request.getfixturevalue("unconfigured" if "unconfigured" in request.fixturenames else "bench")
    return lambda code, words: printed(code, f"{words} -i virtual -c {channel}")


@pytest.fixture
def quick_heartbeats(bench: Bus) -> None:
    for node_id in (5, 6):
        bench.sdo(node_id).write(od.HEARTBEAT_PRODUCER_MS, 20)


@pytest.mark.usefixtures("quick_heartbeats")
def test_scan(on_bus: Printed) -> None:
    out, err = on_bus(0, "scan --wait 0.3")
    assert err == "nodes 5-6: not started: tipforce nmt start 5-6 --wait\n" + HINT.format(5) + HINT.format(6)
    shown = "5 (0x05) pre-operational simulated fingertip, 3 gauges serial 1005 not calibrated EDS match"
    assert [line.split() for line in out.splitlines()] == [
        shown.split(), shown.replace("5 (0x05)", "6 (0x06)").replace("1005", "1006").split(),
    ]  # fmt: skip
    (record,) = on_bus(0, "scan --wait 0.3 --nodes 6,10-12 --json").records
    assert record == {
        "node_id": 6, "state": "pre-operational", "device": "simulated fingertip, 3 gauges", "serial": 1006,
        "calibration": "not calibrated", "faults": "", "eds": "match", "duplicate": "", "product": 0x54500103,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("0x1018 2 u32", "1414529283"), ("0x1018 0x02", "1414529283"), ("4120 2", "1414529283"),
        ("identity.product", "1414529283"), ("0x1018:02", "1414529283"), ("1018h:02", "1414529283"),
        ("0x1018 4 u32", "1005"), ("calibration.generation", "0"), ("calibration.matrix:3", "0.0"),
        ("0x2100:03 ", "0.0"), ("0x1017 0 d", "E8 03"), ("heartbeat.producer_ms", "1000"), ("P", "nan"), ("SG2", "0.0"),
    ],
)  # fmt: skip
def test_sdo_read(on_bus: Printed, words: str, shown: str) -> None:
    assert on_bus(0, f"sdo read 0x05 {words}") == (shown + "\n", "")


def test_sdo_read_as_json(on_bus: Printed) -> None:
    (record,) = on_bus(0, "sdo read 5 identity.serial --json").records
    assert record == {"node": 5, "index": "0x1018", "sub": 4, "name": "identity.serial", "value": 1005}
    assert on_bus(0, "sdo read 5 0x1018 4 d --json").records[0]["value"] == "ED 03 00 00"


@pytest.mark.parametrize(
    ("words", "value", "shown"),
    [
        ("simulation.P", "-1.5e-3", "-0.0015"), ("simulation.phi", "-90", "-90.0"), ("0x2101 2 r32", "nan", "nan"),
        ("0x1800 3", "0x64", "100"), ("tpdo1.inhibit_100us", "7", "7"),
    ],
)  # fmt: skip
def test_sdo_write_then_read(on_bus: Printed, words: str, value: str, shown: str) -> None:
    on_bus(0, "sdo write 5 tpdo1.cob_id 0xC0000185")  # an inhibit time changes in an invalid PDO only
    out, err = on_bus(0, f"sdo write 5 {words} {value}")
    assert out == ""
    assert err.startswith("node 5 (0x05) 0x")
    assert on_bus(0, f"sdo read 5 {words}").out == shown + "\n"


def test_sdo_dump_is_all_that_can_be_read(on_bus: Printed, bench: Bus) -> None:
    readable = {place: row for place, row in entries(3, True).items() if row.access != "wo" and row.index != 0x1021}
    ended = on_bus(0, "sdo dump 5 --json")
    records = {(int(r["index"], 16), r["sub"]): r for r in ended.records}
    # This node was given no EDS, and 1022h says how one is packed.
    assert (set(readable) - set(records), set(records) - set(readable)) == ({(0x1022, 0)}, set())
    assert f"{len(records)} entries, 1 of the dictionary it does not have" in ended.err
    for place, record in records.items():
        assert (record["node"], record["name"], record["unit"]) == (5, readable[place].name, readable[place].unit)
    assert records[0x1018, 4]["value"] == 1005
    assert records[0x2140, 0]["value"] == types.format_value("D", bench.sdo(5).upload(0x2140, 0))
    lines = on_bus(0, "sdo dump 5 -q").out.splitlines()
    assert len(lines) == len(records)
    assert any(line.split() == ["0x1017:00", "heartbeat.producer_ms", "1000", "ms"] for line in lines)
    # Asked for four gauges, it leaves out what it does not have.
    ended = on_bus(0, "sdo dump 5 --gauges 4 --json")
    assert 0 < len(ended.records) <= len(records)
    assert "of the dictionary it does not have" in ended.err


@pytest.mark.parametrize(("name", "what"), [("store:1", "stores parameters"), ("restore:4", "restores defaults")])
def test_sdo_asks_before_something_persists(
    printed: Printed, monkeypatch: pytest.MonkeyPatch, name: str, what: str
) -> None:
    """On a bus that counts as real; nobody is there to say yes."""
    monkeypatch.setattr("tipforce_tools.cli.bus_flags.open_connection", lambda _args: pytest.fail("the bus was opened"))
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert what in printed(2, f"sdo write 5 {name} 0x65766173 -i socketcan -c can0").err


@pytest.mark.usefixtures("quick_heartbeats")
def test_nmt_waits_for_each_heartbeat(on_bus: Printed, bench: Bus) -> None:
    assert on_bus(0, "nmt start 5,6 --wait") == ("   5 (0x05)  operational\n   6 (0x06)  operational\n", "")
    assert on_bus(0, "nmt stop 0x06 --wait --json").records == [{"node_id": 6, "state": "stopped"}]
    assert on_bus(0, "nmt preop 6 --wait").out == "   6 (0x06)  pre-operational\n"
    for command in ("reset-node", "reset-comm"):
        assert on_bus(0, f"nmt {command} 6 --wait") == ("   6 (0x06)  boot-up\n", "")
    assert bench.sdo(6).read(od.HEARTBEAT_PRODUCER_MS) == 1000
    bench.buffer.clear()
    assert on_bus(0, "nmt start all") == ("", "")  # one frame
    bench.wait_for({0x705, 0x706}, 10.0)


@pytest.mark.usefixtures("quick_heartbeats")
def test_a_node_that_does_not_say_so_is_named(on_bus: Printed) -> None:
    out, err = on_bus(5, "nmt start 5,9 --wait 0.2")
    assert out == "   5 (0x05)  operational\n"  # the one that did is named, too
    assert "from node 9 (silent)" in err
    assert on_bus(5, "nmt stop 5,9 --wait 0.2 --json").records == [{"node_id": 5, "state": "stopped"}]


def test_nmt_start_is_repeated_until_the_node_has_booted(capsys: pytest.CaptureFixture[str], channel: str) -> None:
    """The order in which a person pastes two lines does not matter."""
    device = finger(7)
    codes: list[int] = []
    with Bus.open(channel, "virtual") as listener:
        line = f"nmt start 7 --wait -i virtual -c {channel}"
        thread = threading.Thread(target=lambda: codes.append(exit_code(line)))
        thread.start()
        listener.wait_for({0x000}, timeout_s=20.0)  # it has sent the command once, to nobody
        with running([device], channel):
            thread.join()
    assert codes == [0]
    assert capsys.readouterr().out == "   7 (0x07)  operational\n"


def test_read_prints_the_contact_of_each_finger(on_bus: Printed, bench: Bus) -> None:
    bench.finger(5).apply_calibration(beam_calibration(), store=False)
    apply_load(bench, 5, 4.4, 90.0, 45.0)
    out, err = on_bus(0, "read 5")
    assert err == ""
    assert re.fullmatch(
        r"   5 \(0x05\)  4\.4\d\d N, phi (89|90)\.\d\d deg, theta 4[45]\.\d\d deg  u\(P\) 0\.\d{3} N\n", out
    )
    ended = on_bus(0, "read 6 -n 2 --json")
    assert ended.err == HINT.format(6), "once"
    first, second = ended.records
    assert (first["node_id"], first["P_newtons"], first["reason"]) == (6, None, "not calibrated")
    assert first["counter"] != second["counter"]


def test_lss_scan_finds_one_without_a_node_id(on_bus: Printed, unconfigured: Bus) -> None:
    ended = on_bus(0, "lss scan --lss-timeout 0.05 --json")
    assert ended.records == [{
        "vendor": 0, "product": 0x54500103, "revision": 0x00020000, "serial": 7, "node_id": None, "stored": False,
    }]  # fmt: skip
    assert "finds one at a time" in ended.err
    assert unconfigured.sdo(20).read(od.IDENTITY_SERIAL) == 1020


def test_lss_assign_numbers_all(on_bus: Printed, unconfigured: Bus, tmp_path: Path) -> None:
    out = on_bus(0, "lss assign 1-3 --store --lss-timeout 0.05").out
    assert [line.split("serial ")[1] for line in out.splitlines()] == [
        "7: node-id 1 (0x01), stored", "9: node-id 2 (0x02), stored", "2147483649: node-id 3 (0x03), stored",
    ]  # fmt: skip
    assert [unconfigured.sdo(n).read(od.IDENTITY_SERIAL) for n in (1, 2, 3)] == [7, 9, 0x80000001]
    stored = FileStore(tmp_path / "9.json").load("lss")
    assert stored is not None
    assert stored.endswith(bytes((2, 0)))


def test_lss_renumbers_a_configured_node(on_bus: Printed, bench: Bus) -> None:
    out, err = on_bus(0, "lss assign 9 --serial 1005 --product 0x54500103")
    assert out.endswith("serial 1005: node-id 9 (0x09)\n")
    assert "node-id 5 (0x05) remains active" in err
    on_bus(0, "nmt reset-comm 5")
    bench.wait_for({0x709}, 10.0)
    assert bench.sdo(9).read(od.IDENTITY_SERIAL) == 1005


def test_tare_shows_and_clears(on_bus: Printed, bench: Bus) -> None:
    bench.finger(5).apply_calibration(beam_calibration(), store=False)
    apply_load(bench, 5, 2.0, 0.0, 0.0)
    (record,) = on_bus(0, "tare 5 --json").records
    assert record["F3_N"] == pytest.approx(2.0, abs=5e-3)
    assert record["node_id"] == 5
    assert on_bus(0, "tare 5 --show").out.startswith("   5 (0x05)  F1 ")
    assert "no tare" in on_bus(0, "tare 5 --clear").out


def test_calibrate_apply_then_verify(on_bus: Printed, tmp_path: Path) -> None:
    cal = tmp_path / "cal.toml"
    write_calibration(cal, beam_calibration())
    out, err = on_bus(0, f"calibrate apply {cal} --node 5")
    assert out.endswith(f", CRC-32 0x{beam_calibration().crc32():08X}\n")
    assert [line.split(": ")[0] for line in err.splitlines()] == ["node 5 (0x05)"] * 4
    equal = {"node": 5, "equal": True, "differences": []}
    assert on_bus(0, f"calibrate verify {cal} --node 5 --json").records == [equal]
    assert on_bus(1, f"calibrate verify {cal} --node 6").out == "the node has no active calibration\n"
    err = on_bus(11, f"calibrate apply {cal} --node 6").err
    assert re.search("write of 0x1010:04.*has no store.*until its next reset.*--store FILE", err)
    on_bus(0, f"calibrate apply {cal} --node 6 --no-store --json -q")
    write_calibration(cal, beam_calibration(serial=8))
    assert on_bus(1, f"calibrate verify {cal} --node 5").out == "0x2102:01: expected 8, the node has 7\n"


# --- config ----------------------------------------------------------------------------------------------------

FILE = """
[objects]
"heartbeat.producer_ms" = 250
"sample_period_us" = [1000]
"tpdo3.cob_id" = "$NODEID+0x40000380"
"tpdo2.mapping" = ["process_value_int32:7", "status", "counter"]
"interrupt_delta:1" = 2.5
"""


def test_a_new_node_shows_nothing(on_bus: Printed) -> None:
    out, err = on_bus(0, "config show 5")
    assert out == ""
    assert "0 shown" in err
    records = on_bus(0, "config show 5 --all --json -q").records
    assert len(records) == len(FingertipObjects(5).settings)
    assert all(record["value"] == pytest.approx(record["default"]) for record in records)


def test_saved_from_one_applied_to_another(on_bus: Printed, bench: Bus, tmp_path: Path) -> None:
    path, saved = tmp_path / "wanted.toml", tmp_path / "saved.toml"
    path.write_text(FILE)
    out, err = on_bus(1, f"config verify 5 {path}")
    assert "interrupt_delta:1 (0x6133:01): expected 2.5, the node has 0.0\n" in out
    assert err == "node 5 (0x05): 8 objects, 8 different\n"
    assert on_bus(0, f"config apply 5 {path} --store -q") == ("", "")
    assert on_bus(0, f"config verify 5 {path} --json -q") == ("", "")
    out = on_bus(0, "config show 5").out
    assert "0x1802:01  tpdo3.cob_id" in out
    assert "(default 1000)" in out
    assert "0x40000385 (0x385, no RTR)   (default 0xC0000385 (0x385, off, no RTR))" in out
    assert "0x91300720 (0x9130:07, 32 bits)" in out
    on_bus(0, f"config save 5 {saved} -q")
    objects = tomllib.loads(saved.read_text())["objects"]
    assert objects["tpdo3.cob_id"] == "$NODEID+0x40000380"
    assert objects["tpdo2.mapping"] == ["process_value_int32:7", "status", "counter"]
    different = {"object": "heartbeat.producer_ms (0x1017:00)", "expected": "250", "found": "1000"}
    assert different in on_bus(1, f"config verify 6 {saved} --json -q").records
    assert on_bus(0, f"config diff 5 {saved} -q") == ("", "")
    assert on_bus(0, f"config apply 6 {saved} -q") == ("", "")
    assert bench.sdo(6).read(od.TPDO3_COB_ID) == 0x40000386
    assert on_bus(0, f"config diff 6 {saved} -q") == ("", "")


def test_diff_goes_both_ways(on_bus: Printed, bench: Bus, tmp_path: Path) -> None:
    path = tmp_path / "wanted.toml"
    path.write_text('[objects]\n"heartbeat.producer_ms" = 300\n')
    bench.sdo(5).write(od.SYNC_WINDOW_US, 700)
    assert on_bus(1, f"config diff 5 {path} -q").out == (
        "sync.window_us (0x1007:00): the node has 700, is not in the file\n"
        f"heartbeat.producer_ms (0x1017:00): the node has 1000, {path} has 300\n"
    )


def test_saved_as_dcf_and_to_stdout(on_bus: Printed, tmp_path: Path) -> None:
    dcf = tmp_path / "finger.dcf"
    on_bus(0, "sdo write 5 heartbeat.producer_ms 250 -q")
    assert on_bus(0, "config save 5 - -q").out == '[objects]\n"heartbeat.producer_ms" = 250\n'
    on_bus(0, f"config save 5 {dcf} -q")
    assert on_bus(0, f"config verify 5 {dcf} -q") == ("", "")
    on_bus(1, f"config verify 6 {dcf} -q")


@pytest.mark.parametrize("name", ["finger.dcf", "finger.toml"])
def test_the_gauges_are_of_the_node(on_bus: Printed, bench: Bus, channel: str, tmp_path: Path, name: str) -> None:
    """Channel 14 exists with eight gauges alone, and the default span of channel 5 is that of a gauge."""
    source, target = SimulatedSource([[1e-4 * (k % 3 == i) for i in range(3)] for k in range(8)]), tmp_path / name
    with running([fingertip_node(9, source, n=8)], channel):
        bench.wait_for({0x709}, 10.0)
        assert on_bus(0, "config show 9 -q") == ("", "")
        bench.sdo(9).download(0x6149, 14, struct.pack("<f", 170.0))
        on_bus(0, f"config save 9 {target} -q")
        for action in ("diff", "verify", "apply"):
            assert on_bus(0, f"config {action} 9 {target} -q") == ("", "")
        assert "--gauges 3: node 9 (0x09) has 8" in on_bus(2, "config show 9 --gauges 3").err
        assert "170.0" in target.read_text()


def test_another_device_is_compared_with_nothing(on_bus: Printed, bench: Bus, channel: str) -> None:
    """Its objects have defaults of their own, and another meaning from 2000h on."""
    device = Device(service_dictionary(9))
    with running([device], channel):
        bench.wait_for({0x709}, 10.0)
        out, err = on_bus(0, "config show 9")
        assert "0x1800:01  tpdo1.cob_id" in out
        assert "default" not in out
        assert not [line for line in out.splitlines() if line > "0x2000"]
        assert "node 9 (0x09) is not a fingertip" in err
        records = on_bus(0, "config show 9 --json").records
        assert {"index": "0x1017", "sub": 0, "name": "heartbeat.producer_ms", "value": 0} in records


HAND = """
bus = {{ interface = "virtual", channel = "{channel}" }}
hand = {{ sync_hz = 50, heartbeat_ms = 50 }}
finger = [
    {{ name = "thumb", node_id = 1, serial = 1, calibration = "cal.toml" }},
    {{ name = "index", node_id = 2, serial = 2, calibration = "cal.toml" }},
]
"""


@pytest.fixture
def hand(tmp_path: Path, channel: str) -> Iterator[tuple[ExitStack, Path]]:
    """The power of finger 2, and the hand's file."""
    path = tmp_path / "hand.toml"
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    path.write_text(HAND.format(channel=channel))
    with running([finger(1, serial=1)], channel), ExitStack() as power:
        power.enter_context(running([finger(2, serial=2)], channel))
        with connected(channel=channel) as (connection, _):
            apply_load(connection, 1, 2.0, 0.0, 0.0)
        yield power, path


def test_check_needs_no_bus(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    out, err = printed(0, f"hand check {hand[1]}")
    assert "thumb" in out
    assert "cal.toml 0x" in out
    assert "bus load" in err
    hand[1].write_text(hand[1].read_text().replace("sync_hz = 50", "sync_hz = 5000"))
    ended = printed(0, f"hand check {hand[1]} --json")
    assert [record["node_id"] for record in ended.records] == [1, 2]
    assert "warning" in ended.err
    assert "what fits under 80 %" in ended.err


def test_up_reports_each_finger(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    power, path = hand
    out, err = printed(0, f"hand up {path}")
    assert out == "thumb (1): up\nindex (2): up\n"
    assert "2 of 2 fingers up" in err
    power.close()
    records = printed(1, f"hand up {path} --json").records
    assert [record["failed"] for record in records] == [None, "find"]
    assert "does not respond to LSS" in records[1]["error"]


def test_run_prints_rows_and_counts(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    ended = printed(0, f"hand run {hand[1]} --seconds 0.5 --json")
    rows = [record for record in ended.records if "row" in record]
    assert len(rows) >= 5
    assert rows[-1]["pairing"] == "numbered"
    # An answer that is late has no P.
    known, index = ([row[k] for row in rows if row[k].get("P") is not None] for k in "12")
    assert known[-1]["P"] == pytest.approx(2.0, abs=5e-3)
    assert (index[-1]["name"], index[-1]["calibrated"]) == ("index", True)
    assert {"calibrated", "started"} <= {record["event"] for record in ended.records if "event" in record}
    assert "SYNC period" in ended.err
    assert "thumb (1): missing" in ended.err
    assert "thumb: P " in printed(0, f"hand run {hand[1]} --seconds 0.3 -q").out


def test_an_uncalibrated_finger_is_named_and_its_rows_say_why(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    path = hand[1]
    path.write_text(path.read_text().replace(', calibration = "cal.toml"', "", 1))
    out, err = printed(0, f"hand up {path}")
    assert "thumb (1): up, not calibrated: P, phi and theta are unknown" in out
    assert HINT.format(1) in err
    rows = [record for record in printed(0, f"hand run {path} --seconds 0.3 --json").records if "row" in record]
    thumb = [row["1"] for row in rows if "P" in row["1"]][-1]  # an answer that is late has none
    assert thumb["P"] is None
    assert thumb["reason"].startswith("not calibrated")
    assert "thumb: not calibrated" in printed(0, f"hand run {path} --seconds 0.3").out


@pytest.mark.parametrize(("kind", "committed"), [("eds", "eds/tipforce-3.eds"), ("dbc", "dbc/tipforce.dbc")])
def test_export_is_the_committed_file(printed: Printed, tmp_path: Path, kind: str, committed: str) -> None:
    expected, path = (ROOT / committed).read_bytes(), tmp_path / "file"
    assert printed(0, f"export {kind}") == printed(0, f"export {kind} -o -") == (expected.decode(), "")
    assert printed(0, f"export {kind} -o {path}") == ("", f"{path}: {len(expected.splitlines())} lines\n")
    assert path.read_bytes() == expected
