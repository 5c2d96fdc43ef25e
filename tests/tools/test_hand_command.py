"""hand check, up and run against nodes on the in-process bus."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from host.bus_with_nodes import beam_calibration, new_channel
from host.hand.test_hand import Fingers
from tipforce.host.configuration.calibration import write_calibration
from tipforce_tools.cli.main import main
from tools.rig import Printed

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
def hand(tmp_path: Path) -> Iterator[tuple[Fingers, Path]]:
    """Two running fingers and their file."""
    fingers = Fingers(new_channel(), tmp_path)
    for serial in (1, 2):
        fingers.switch_on(serial, serial)
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    path = tmp_path / "hand.toml"
    path.write_text(HAND.format(channel=fingers.channel))
    yield fingers, path
    fingers.close()


def test_check_needs_no_bus(hand: tuple[Fingers, Path], printed: Printed) -> None:
    out, err = printed(0, ["hand", "check", str(hand[1])])
    assert "thumb" in out
    assert "cal.toml 0x" in out
    assert "bus load" in err
    hand[1].write_text(hand[1].read_text().replace("sync_hz = 50", "sync_hz = 5000"))
    out, err = printed(0, ["hand", "check", str(hand[1]), "--json"])
    assert [json.loads(line)["node_id"] for line in out.splitlines()] == [1, 2]
    assert "warning" in err
    assert "what fits under 80 %" in err


def test_up_reports_each_finger(hand: tuple[Fingers, Path], printed: Printed) -> None:
    fingers, path = hand
    out, err = printed(0, ["hand", "up", str(path)])
    assert out == "thumb (1): up\nindex (2): up\n"
    assert "2 of 2 fingers up" in err
    fingers.switch_off(2)
    records = [json.loads(line) for line in printed(1, ["hand", "up", str(path), "--json"]).out.splitlines()]
    assert [record["failed"] for record in records] == [None, "find"]
    assert "does not respond to LSS" in records[1]["error"]


def test_run_prints_rows_and_counts(hand: tuple[Fingers, Path], printed: Printed) -> None:
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
    hand: tuple[Fingers, Path], capsys: pytest.CaptureFixture[str], printed: Printed
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
