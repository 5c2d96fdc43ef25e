"""config show, save and diff: the settings of a node as a file; hand check, up and run: on the in-process bus."""

import json
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from canopen_device.core.node import Device
from device.tiny import service_dictionary
from host.bus_with_nodes import apply_load, beam_calibration, connected, finger, new_channel, running
from tipforce.dictionary import objects as od
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.configuration.device_objects import FingertipObjects
from tipforce.host.network.bus import Bus
from tipforce_tools.cli.main import main
from tools.rig import Printed, Tipforce

FILE = """
[objects]
"heartbeat.producer_ms" = 250
"sample_period_us" = [1000]
"tpdo3.cob_id" = "$NODEID+0x40000380"
"tpdo2.mapping" = ["process_value_int32:7", "status", "counter"]
"contact_unknown" = 1
"""


@pytest.fixture
def bench() -> Iterator[tuple[Bus, str]]:
    """Nodes 5 and 6, and the name of their bus."""
    channel = new_channel()
    with connected(finger(5), finger(6), channel=channel) as (connection, _):
        yield connection, channel


@pytest.fixture
def bus_words(bench: tuple[Bus, str]) -> tuple[str, ...]:
    return ("-i", "virtual", "-c", bench[1])


def test_a_new_node_shows_nothing(tipforce: Tipforce) -> None:
    code, out, err = tipforce("config", "show", 5)
    assert (code, out) == (0, "")
    assert "0 shown" in err
    code, out, _ = tipforce("config", "show", 5, "--all", "--json", "-q")
    records = [json.loads(line) for line in out.splitlines()]
    assert len(records) == len(FingertipObjects(5).settings)
    assert all(record["value"] == pytest.approx(record["default"]) for record in records)


def test_saved_from_one_applied_to_another(tipforce: Tipforce, bench: tuple[Bus, str], tmp_path: Path) -> None:
    path, saved = tmp_path / "wanted.toml", tmp_path / "saved.toml"
    path.write_text(FILE.replace('"contact_unknown" = 1\n', ""))
    assert tipforce("config", "apply", 5, path, "-q") == (0, "", "")
    code, out, _ = tipforce("config", "show", 5)
    assert code == 0
    assert "0x1802:01  tpdo3.cob_id" in out
    assert "(default 1000)" in out
    assert "0x40000385 (0x385, no RTR)   (default 0xC0000385 (0x385, off, no RTR))" in out
    assert "0x91300720 (0x9130:07, 32 bits)" in out
    assert tipforce("config", "save", 5, saved, "-q")[0] == 0
    objects = tomllib.loads(saved.read_text())["objects"]
    assert objects["tpdo3.cob_id"] == "$NODEID+0x40000380"
    assert objects["tpdo2.mapping"] == ["process_value_int32:7", "status", "counter"]
    assert tipforce("config", "diff", 5, saved, "-q") == (0, "", "")
    assert tipforce("config", "apply", 6, saved, "-q") == (0, "", "")
    assert bench[0].sdo(6).read(od.TPDO3_COB_ID) == 0x40000386
    assert tipforce("config", "diff", 6, saved, "-q") == (0, "", "")


def test_diff_goes_both_ways(tipforce: Tipforce, bench: tuple[Bus, str], tmp_path: Path) -> None:
    path = tmp_path / "wanted.toml"
    path.write_text('[objects]\n"heartbeat.producer_ms" = 300\n')
    bench[0].sdo(5).write(od.SYNC_WINDOW_US, 700)
    code, out, _ = tipforce("config", "diff", 5, path, "-q")
    assert (code, out) == (
        1,
        "sync.window_us (0x1007:00): the node has 700, is not in the file\n"
        f"heartbeat.producer_ms (0x1017:00): the node has 1000, {path} has 300\n",
    )


@pytest.mark.parametrize("name", ["finger.dcf", "-"])
def test_saved_as_dcf_and_to_stdout(tipforce: Tipforce, tmp_path: Path, name: str) -> None:
    target = name if name == "-" else str(tmp_path / name)
    assert tipforce("sdo", "write", 5, "heartbeat.producer_ms", 250, "-q")[0] == 0
    code, out, _ = tipforce("config", "save", 5, target, "-q")
    assert code == 0
    if name == "-":
        assert out == '[objects]\n"heartbeat.producer_ms" = 250\n'
    else:
        assert tipforce("config", "verify", 5, target, "-q") == (0, "", "")
        assert tipforce("config", "verify", 6, target, "-q")[0] == 1


def test_another_device_is_compared_with_nothing(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    """Its objects have defaults of their own, and another meaning from 2000h on."""
    device = Device(service_dictionary(9))
    with running([device], bench[1]):
        bench[0].wait_for({0x709})
        code, out, err = tipforce("config", "show", 9)
        assert code == 0
        assert "0x1800:01  tpdo1.cob_id" in out
        assert "default" not in out
        assert not [line for line in out.splitlines() if line > "0x2000"]
        assert "node 9 (0x09) is not a fingertip" in err
        records = [json.loads(line) for line in tipforce("config", "show", 9, "--json")[1].splitlines()]
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
    out, err = printed(0, ["hand", "check", str(hand[1])])
    assert "thumb" in out
    assert "cal.toml 0x" in out
    assert "bus load" in err
    hand[1].write_text(hand[1].read_text().replace("sync_hz = 50", "sync_hz = 5000"))
    out, err = printed(0, ["hand", "check", str(hand[1]), "--json"])
    assert [json.loads(line)["node_id"] for line in out.splitlines()] == [1, 2]
    assert "warning" in err
    assert "what fits under 80 %" in err


def test_up_reports_each_finger(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    power, path = hand
    out, err = printed(0, ["hand", "up", str(path)])
    assert out == "thumb (1): up\nindex (2): up\n"
    assert "2 of 2 fingers up" in err
    power.close()
    records = [json.loads(line) for line in printed(1, ["hand", "up", str(path), "--json"]).out.splitlines()]
    assert [record["failed"] for record in records] == [None, "find"]
    assert "does not respond to LSS" in records[1]["error"]


def test_run_prints_rows_and_counts(hand: tuple[ExitStack, Path], printed: Printed) -> None:
    out, err = printed(0, ["hand", "run", str(hand[1]), "--seconds", "0.5", "--json"])
    lines = [json.loads(line) for line in out.splitlines()]
    rows = [line for line in lines if "row" in line]
    assert len(rows) >= 5
    assert rows[-1]["pairing"] == "numbered"
    assert rows[-1]["1"]["P"] == pytest.approx(2.0, abs=5e-3)
    assert (rows[-1]["2"]["name"], rows[-1]["2"]["calibrated"]) == ("index", True)
    assert {"calibrated", "started"} <= {line["event"] for line in lines if "event" in line}
    assert "SYNC period" in err
    assert "thumb (1): missing" in err
    assert "thumb: P " in printed(0, ["hand", "run", str(hand[1]), "--seconds", "0.3", "-q"]).out


def test_an_uncalibrated_finger_is_named_and_its_rows_say_why(
    hand: tuple[ExitStack, Path], capsys: pytest.CaptureFixture[str], printed: Printed
) -> None:
    path = hand[1]
    path.write_text(path.read_text().replace('calibration = "cal.toml"', "", 1))
    out, err = printed(0, ["hand", "up", str(path)])
    assert "thumb (1): up, not calibrated: P, phi and theta are unknown" in out
    assert "node 1 (0x01): not calibrated: tipforce calibrate guide --node 1, or apply CAL.toml\n" in err
    assert main(["hand", "run", str(path), "--seconds", "0.3", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith('{"row"')]
    assert rows[-1]["1"]["P"] is None
    assert rows[-1]["1"]["reason"].startswith("not calibrated")
    assert "thumb: not calibrated" in printed(0, ["hand", "run", str(path), "--seconds", "0.3"]).out
