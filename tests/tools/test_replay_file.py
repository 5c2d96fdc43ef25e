"""`tipforce node --source replay:FILE`: from a CSV file or a candump log to counts, or what is wrong with it."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from canopen_device.core.node import Device
from tipforce.sources.replay import ReplaySource
from tools.rig import run_node, source_of


def test_a_recording_in_csv(tmp_path: Path, devices: list[Device]) -> None:
    path = tmp_path / "session.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([["t_s", "SG1", "SG2", "SG3", "P_N"], [1, 1.04, -2, 3, 0], [1.5, 4, 5, 9999, 0]])
    assert run_node("-q", "--layout", "I", "--source", f"replay:{path}", "--speed", "2", "--loop") == 0
    source = source_of(devices[0])
    assert isinstance(source, ReplaySource)
    found = [source.read(now_us) for now_us in (0, 249_999, 250_000, 500_000)]
    assert [None if one is None else one.counts for one in found] == [
        (10, -20, 30),
        None,
        (40, 50, 32767),
        (10, -20, 30),
    ]
    assert run_node("-q", "--layout", "I", "--source", f"replay:{path}", "--bits", "24") == 0
    reading = source_of(devices[1]).read(0)
    assert reading is not None
    assert reading.counts == (2662, -5120, 7680)


def test_a_recording_of_candump(tmp_path: Path, devices: list[Device], capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.txt"
    lines = (
        "(1.000000) can0 185#0A00ECFF1E000201",  # 1.0, -2.0, 3.0 microstrain, calibrated
        "(1.001000) can0 185#0A00ECFF1E000A01",  # stale: nothing new
        "(1.002000) can0 185#FF7F0180008002",  # too short for its mapping
        "(1.003000) can0 185#FF7F018005000602",  # saturated at both ends
        "(1.004000) can0 186#0100010001000201",
    )
    path.write_text("\n".join(lines) + "\n")
    assert run_node("-q", "--layout", "I", "--source", f"replay:{path}") == 2
    assert f"contains gauges of the nodes 5, 6; choose one: {path}@5" in capsys.readouterr().err
    assert run_node("-q", "--layout", "I", "--source", f"replay:{path}@5") == 0
    source = source_of(devices[0])
    found = [source.read(now_us) for now_us in (0, 1500, 3500)]
    assert [None if one is None else one.counts for one in found] == [(10, -20, 30), None, (32767, -32768, 5)]


@pytest.mark.parametrize(
    ("text", "flags", "message"),
    [
        ("SG1,SG2,SG3\n1,2,3\n", "", "column t_s is missing"),
        ("t_s,SG1,SG2,SG3\n0,1,2,x\n", "", "line 2"),
        ("t_s,SG1,SG2,SG3,SG4\n0,1,2,3,4\n", "", "4 gauges; the layout has 3"),
        ("t_s,SG1,SG2,SG3\n0,1,2,3\n", "--speed 0", "speed 0.0"),
        ("hello\n", "", "no gauge PDO, and no CSV header with SG1"),
        ("(1.0) can0 185#0A00ECFF1E000201\n", "@9", "no gauge PDO of node 9"),
        ("(1.0) can0 185#0A00ECFF1E000201\n", "@0", "'0' after @: allowed are node-ids"),
        (None, "", "No such file"),
    ],
)
def test_a_recording_that_is_wrong(
    tmp_path: Path,
    devices: list[Device],
    text: str | None,
    flags: str,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "recording"
    if text is not None:
        path.write_text(text)
    suffix, words = (flags, []) if flags.startswith("@") else ("", flags.split())
    assert run_node("-q", "--layout", "I", "--source", f"replay:{path}{suffix}", *words) == 2
    assert message in capsys.readouterr().err
    assert not devices
