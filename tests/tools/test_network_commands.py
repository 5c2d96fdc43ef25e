"""nmt, read, lss, tare, config and hand, run in this process against nodes on the in-process bus."""

import json
import re
import struct
import threading
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from canopen_device.core.node import Device
from canopen_device.running.store import FileStore
from device.tiny import service_dictionary
from host.bus_with_nodes import apply_load, beam_calibration, connected, finger, new_channel, running
from tipforce.dictionary import objects as od
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.configuration.device_objects import FingertipObjects
from tipforce.host.network.bus import Bus
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools.cli.main import main
from tools.rig import Printed, Tipforce


@pytest.fixture
def bench() -> Iterator[tuple[Bus, str]]:
    """Nodes 5 and 6, and the name of their bus."""
    channel = new_channel()
    with connected(finger(5), finger(6), channel=channel) as (connection, _):
        yield connection, channel


@pytest.fixture
def quick_heartbeats(bench: tuple[Bus, str]) -> None:
    for node_id in (5, 6):
        bench[0].sdo(node_id).write(od.HEARTBEAT_PRODUCER_MS, 20)


@pytest.fixture
def bus_words(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """The bus of ``bench`` or ``unconfigured``."""
    name = "unconfigured" if "unconfigured" in request.fixturenames else "bench"
    return ("-i", "virtual", "-c", request.getfixturevalue(name)[1])


@pytest.fixture
def unconfigured(tmp_path: Path) -> Iterator[tuple[Bus, str]]:
    """Three nodes without a node-id, serials 7, 0x80000001 and 9, and node 20; they can store."""
    devices = []
    rows = strain_matrix(FABRICATED, "I").tolist()
    for serial in (7, 0x80000001, 9):
        store = FileStore(tmp_path / f"{serial}.json")
        devices.append(fingertip_node(255, SimulatedSource(rows), serial=serial, save=store.save, load=store.load))
    channel = new_channel()
    with connected(finger(20), channel=channel) as (connection, _), running(devices, channel):
        yield connection, channel


@pytest.mark.usefixtures("quick_heartbeats")
def test_nmt_waits_for_each_heartbeat(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    assert tipforce("nmt start 5,6 --wait") == (0, "   5 (0x05)  operational\n   6 (0x06)  operational\n", "")
    assert tipforce("nmt stop 0x06 --wait --json", code=0).records == [{"node_id": 6, "state": "stopped"}]
    assert tipforce("nmt preop 6 --wait")[1] == "   6 (0x06)  pre-operational\n"
    for command in ("reset-node", "reset-comm"):
        assert tipforce(f"nmt {command} 6 --wait") == (0, "   6 (0x06)  boot-up\n", "")
    assert bench[0].sdo(6).read(od.HEARTBEAT_PRODUCER_MS) == 1000


@pytest.mark.usefixtures("quick_heartbeats")
def test_nmt_to_all_is_one_frame(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    bench[0].buffer.clear()
    assert tipforce("nmt start all") == (0, "", "")
    bench[0].wait_for({0x705, 0x706})


@pytest.mark.usefixtures("quick_heartbeats")
def test_a_node_that_does_not_say_so_is_named(tipforce: Tipforce) -> None:
    code, out, err = tipforce("nmt start 5,9 --wait 0.2")
    assert (code, out) == (5, "   5 (0x05)  operational\n")  # the one that did is named, too
    assert "from node 9 (silent)" in err
    assert tipforce("nmt stop 5,9 --wait 0.2 --json", code=5).records == [{"node_id": 5, "state": "stopped"}]


def test_nmt_start_is_repeated_until_the_node_has_booted(capsys: pytest.CaptureFixture[str]) -> None:
    """The order in which a person pastes two lines does not matter."""
    channel = new_channel()
    device = finger(7)
    codes: list[int] = []
    words = ["nmt", "start", "7", "--wait", "-i", "virtual", "-c", channel]
    with Bus.open(channel, "virtual") as listener:
        thread = threading.Thread(target=lambda: codes.append(main(words)))
        thread.start()
        listener.wait_for({0x000}, timeout_s=20.0)  # it has sent the command once, to nobody
        with running([device], channel):
            thread.join()
    assert codes == [0]
    assert capsys.readouterr().out == "   7 (0x07)  operational\n"


def test_read_prints_the_contact_of_each_finger(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    connection = bench[0]
    connection.finger(5).apply_calibration(beam_calibration(), store=False)
    apply_load(connection, 5, 4.4, 90.0, 45.0)
    code, out, err = tipforce("read 5")
    assert (code, err) == (0, "")
    assert re.fullmatch(
        r"   5 \(0x05\)  4\.4\d\d N, phi (89|90)\.\d\d deg, theta 4[45]\.\d\d deg  u\(P\) 0\.\d{3} N\n", out
    )
    ended = tipforce("read 6 -n 2 --json", code=0)
    assert ended.err == "node 6 (0x06): not calibrated: tipforce calibrate guide --node 6, or apply CAL.toml\n", "once"
    first, second = ended.records
    assert (first["node_id"], first["P_newtons"], first["reason"]) == (6, None, "not calibrated")
    assert first["counter"] != second["counter"]


def test_lss_scan_finds_one_without_a_node_id(tipforce: Tipforce, unconfigured: tuple[Bus, str]) -> None:
    _, out, err = tipforce("lss scan --lss-timeout 0.05 --json", code=0)
    assert json.loads(out) == {
        "vendor": 0, "product": 0x54500103, "revision": 0x00020000, "serial": 7, "node_id": None, "stored": False,
    }  # fmt: skip
    assert "finds one at a time" in err
    assert unconfigured[0].sdo(20).read(od.IDENTITY_SERIAL) == 1020


def test_lss_assign_numbers_all(tipforce: Tipforce, unconfigured: tuple[Bus, str], tmp_path: Path) -> None:
    connection = unconfigured[0]
    out = tipforce("lss assign 1-3 --store --lss-timeout 0.05", code=0).out
    assert [line.split("serial ")[1] for line in out.splitlines()] == [
        "7: node-id 1 (0x01), stored", "9: node-id 2 (0x02), stored", "2147483649: node-id 3 (0x03), stored",
    ]  # fmt: skip
    assert [connection.sdo(n).read(od.IDENTITY_SERIAL) for n in (1, 2, 3)] == [7, 9, 0x80000001]
    stored = FileStore(tmp_path / "9.json").load("lss")
    assert stored is not None
    assert stored.endswith(bytes((2, 0)))


def test_lss_renumbers_a_configured_node(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    _, out, err = tipforce("lss", "assign", "9", *("--serial", "1005", "--product", "0x54500103"), code=0)
    assert out.endswith("serial 1005: node-id 9 (0x09)\n")
    assert "node-id 5 (0x05) remains active" in err
    assert tipforce("nmt reset-comm 5")[0] == 0
    bench[0].wait_for({0x709})
    assert bench[0].sdo(9).read(od.IDENTITY_SERIAL) == 1005


def test_tare_shows_and_clears(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    connection = bench[0]
    connection.finger(5).apply_calibration(beam_calibration(), store=False)
    apply_load(connection, 5, 2.0, 0.0, 0.0)
    (record,) = tipforce("tare 5 --json", code=0).records
    assert record["F3_N"] == pytest.approx(2.0, abs=5e-3)
    assert record["node_id"] == 5
    assert tipforce("tare 5 --show")[1].startswith("   5 (0x05)  F1 ")
    assert "no tare" in tipforce("tare 5 --clear")[1]


# --- config ----------------------------------------------------------------------------------------------------

FILE = """
[objects]
"heartbeat.producer_ms" = 250
"sample_period_us" = [1000]
"tpdo3.cob_id" = "$NODEID+0x40000380"
"tpdo2.mapping" = ["process_value_int32:7", "status", "counter"]
"contact_unknown" = 1
"""


def test_a_new_node_shows_nothing(tipforce: Tipforce) -> None:
    code, out, err = tipforce("config show 5")
    assert (code, out) == (0, "")
    assert "0 shown" in err
    records = tipforce("config show 5 --all --json -q").records
    assert len(records) == len(FingertipObjects(5).settings)
    assert all(record["value"] == pytest.approx(record["default"]) for record in records)


def test_saved_from_one_applied_to_another(tipforce: Tipforce, bench: tuple[Bus, str], tmp_path: Path) -> None:
    path, saved = tmp_path / "wanted.toml", tmp_path / "saved.toml"
    path.write_text(FILE.replace('"contact_unknown" = 1\n', ""))
    assert tipforce(f"config apply 5 {path} -q") == (0, "", "")
    out = tipforce("config show 5", code=0).out
    assert "0x1802:01  tpdo3.cob_id" in out
    assert "(default 1000)" in out
    assert "0x40000385 (0x385, no RTR)   (default 0xC0000385 (0x385, off, no RTR))" in out
    assert "0x91300720 (0x9130:07, 32 bits)" in out
    assert tipforce(f"config save 5 {saved} -q")[0] == 0
    objects = tomllib.loads(saved.read_text())["objects"]
    assert objects["tpdo3.cob_id"] == "$NODEID+0x40000380"
    assert objects["tpdo2.mapping"] == ["process_value_int32:7", "status", "counter"]
    assert tipforce(f"config diff 5 {saved} -q") == (0, "", "")
    assert tipforce(f"config apply 6 {saved} -q") == (0, "", "")
    assert bench[0].sdo(6).read(od.TPDO3_COB_ID) == 0x40000386
    assert tipforce(f"config diff 6 {saved} -q") == (0, "", "")


def test_diff_goes_both_ways(tipforce: Tipforce, bench: tuple[Bus, str], tmp_path: Path) -> None:
    path = tmp_path / "wanted.toml"
    path.write_text('[objects]\n"heartbeat.producer_ms" = 300\n')
    bench[0].sdo(5).write(od.SYNC_WINDOW_US, 700)
    code, out, _ = tipforce(f"config diff 5 {path} -q")
    assert (code, out) == (
        1,
        "sync.window_us (0x1007:00): the node has 700, is not in the file\n"
        f"heartbeat.producer_ms (0x1017:00): the node has 1000, {path} has 300\n",
    )


@pytest.mark.parametrize("name", ["finger.dcf", "-"])
def test_saved_as_dcf_and_to_stdout(tipforce: Tipforce, tmp_path: Path, name: str) -> None:
    target = name if name == "-" else str(tmp_path / name)
    assert tipforce("sdo write 5 heartbeat.producer_ms 250 -q")[0] == 0
    out = tipforce(f"config save 5 {target} -q", code=0).out
    if name == "-":
        assert out == '[objects]\n"heartbeat.producer_ms" = 250\n'
    else:
        assert tipforce(f"config verify 5 {target} -q") == (0, "", "")
        assert tipforce(f"config verify 6 {target} -q")[0] == 1


@pytest.mark.parametrize("name", ["finger.dcf", "finger.toml"])
def test_the_gauges_are_of_the_node(tipforce: Tipforce, bench: tuple[Bus, str], tmp_path: Path, name: str) -> None:
    """Channel 14 exists with eight gauges alone, and the default span of channel 5 is that of a gauge."""
    source, target = SimulatedSource([[1e-4 * (k % 3 == i) for i in range(3)] for k in range(8)]), tmp_path / name
    with running([fingertip_node(9, source, n=8)], bench[1]):
        bench[0].wait_for({0x709})
        assert tipforce("config show 9 -q") == (0, "", "")
        bench[0].sdo(9).download(0x6149, 14, struct.pack("<f", 170.0))
        assert tipforce(f"config save 9 {target} -q")[0] == 0
        assert tipforce(f"config diff 9 {target} -q") == (0, "", "")
        assert tipforce(f"config verify 9 {target} -q") == (0, "", "")
        assert tipforce(f"config apply 9 {target} -q") == (0, "", "")
        assert "--gauges 3: node 9 (0x09) has 8" in tipforce("config show 9 --gauges 3", code=2).err
        assert "170.0" in target.read_text()


def test_another_device_is_compared_with_nothing(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    """Its objects have defaults of their own, and another meaning from 2000h on."""
    device = Device(service_dictionary(9))
    with running([device], bench[1]):
        bench[0].wait_for({0x709})
        _, out, err = tipforce("config show 9", code=0)
        assert "0x1800:01  tpdo1.cob_id" in out
        assert "default" not in out
        assert not [line for line in out.splitlines() if line > "0x2000"]
        assert "node 9 (0x09) is not a fingertip" in err
        records = tipforce("config show 9 --json").records
        assert {"index": "0x1017", "sub": 0, "name": "heartbeat.producer_ms", "value": 0} in records


HAND = """
[bus]
interface = "virtual"
channel = "{channel}"
[hand]
sync_hz = 50
heartbeat_ms = 50
[[finger]]
name = "thumb"
node_id = 1
serial = 1
calibration = "cal.toml"
[[finger]]
name = "index"
node_id = 2
serial = 2
calibration = "cal.toml"
"""


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[tuple[ExitStack, Path]]:
    """The power of finger 2, and the hand's file."""
    channel, path = new_channel(), tmp_path / "hand.toml"
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
    out, err = printed(0, f"hand check {hand[1]} --json")
    assert [json.loads(line)["node_id"] for line in out.splitlines()] == [1, 2]
    assert "warning" in err
    assert "what fits under 80 %" in err


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
    output = printed(0, f"hand run {hand[1]} --seconds 0.5 --json")
    lines, err = output.records, output.err
    rows = [line for line in lines if "row" in line]
    assert len(rows) >= 5
    assert rows[-1]["pairing"] == "numbered"
    known = [row["1"]["P"] for row in rows if row["1"].get("P") is not None]  # an answer that is late: no P
    assert known[-1] == pytest.approx(2.0, abs=5e-3)
    assert (rows[-1]["2"]["name"], rows[-1]["2"]["calibrated"]) == ("index", True)
    assert {"calibrated", "started"} <= {line["event"] for line in lines if "event" in line}
    assert "SYNC period" in err
    assert "thumb (1): missing" in err
    assert "thumb: P " in printed(0, f"hand run {hand[1]} --seconds 0.3 -q").out


def test_an_uncalibrated_finger_is_named_and_its_rows_say_why(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    path = hand[1]
    path.write_text(path.read_text().replace('calibration = "cal.toml"', "", 1))
    out, err = printed(0, f"hand up {path}")
    assert "thumb (1): up, not calibrated: P, phi and theta are unknown" in out
    assert "node 1 (0x01): not calibrated: tipforce calibrate guide --node 1, or apply CAL.toml\n" in err
    rows = [record for record in printed(0, f"hand run {path} --seconds 0.3 --json").records if "row" in record]
    assert rows[-1]["1"]["P"] is None
    assert rows[-1]["1"]["reason"].startswith("not calibrated")
    assert "thumb: not calibrated" in printed(0, f"hand run {path} --seconds 0.3").out
