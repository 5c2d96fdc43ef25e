"""`tipforce calibrate budget`: its table, its JSON, its plot, and what it says to wrong words."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.sensor.contact.redundancy import weighted_inverse
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix
from tipforce_tools.cli.main import main
from tools.rig import Printed

CAUSES = [
    "gauge noise", "quantisation", "gain", "offset", "temperature, common", "temperature, mismatch",
    "hysteresis", "creep", "calibration noise", "load angle", "gravity", "gauge position", "off-axis load", "total",
]  # fmt: skip
A = strain_matrix(FABRICATED, "II")
CASE_II = Calibration(weighted_inverse(A, np.eye(3)), np.zeros(3), 4e-12 * np.eye(3), layout_code=2, pull=True)


def records(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, dict[str, Any]]:
    assert main(["calibrate", "budget", *words, "--json"]) == 0
    return {record["cause"]: record for record in map(json.loads, capsys.readouterr().out.splitlines())}


def test_the_papers_case_over_the_pad(capsys: pytest.CaptureFixture[str]) -> None:
    found = records(capsys)
    assert list(found) == CAUSES
    total = found["total"]
    assert total["share_P_percent"] == pytest.approx(100.0)
    assert total["share_theta_percent"] == pytest.approx(100.0)
    assert 0.02 < total["u_P_N"] < total["u_P_N_max"] < 0.1
    assert sum(found[cause]["share_P_percent"] for cause in CAUSES[:-1]) == pytest.approx(100.0, abs=0.1)
    assert found["gauge position"]["u_P_N"] == 0.0
    degree = records(capsys, "--gravity", "1")["gravity"]
    assert degree["u_P_N_max"] / 4.4 == pytest.approx(0.0087, abs=0.0002)
    assert degree["u_phi_deg_max"] == pytest.approx(1.0, abs=0.01)
    assert degree["u_theta_deg_max"] == pytest.approx(0.79, abs=0.02)


def test_each_flag_moves_its_row_alone(capsys: pytest.CaptureFixture[str]) -> None:
    load = ("--uncalibrated", "--load", "2", "--phi", "-80", "--theta", "100")
    before = records(capsys, *load)
    for flag, cause in (
        ("noise", "gauge noise"),
        ("resolution", "quantisation"),
        ("gain", "gain"),
        ("offset", "offset"),
        ("hysteresis", "hysteresis"),
        ("creep", "creep"),
        ("gauge-shift", "gauge position"),
        ("off-axis", "off-axis load"),
    ):
        after = records(capsys, *load, f"--{flag}", "0")
        assert [name for name in CAUSES[:-1] if after[name]["u_P_N"] != before[name]["u_P_N"]] == [cause]
        assert after[cause]["u_P_N"] == after[cause]["u_theta_deg"] == 0.0
    warm = records(capsys, *load, "--temperature", "2")
    assert warm["temperature, common"]["u_P_N"] == pytest.approx(2.0 * before["temperature, common"]["u_P_N"])
    assert records(capsys, "--load-angle", "0")["load angle"]["u_P_N"] == 0.0


def test_a_calibration_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = str(tmp_path / "cal.toml")
    write_calibration(path, CASE_II)
    found = records(capsys, path, "--load", "2", "--phi", "80", "--theta", "100")
    P_variance = np.array([1.0, 0.0, 0.0]) @ CASE_II.covariance_F @ np.array([1.0, 0.0, 0.0])
    assert found["gauge noise"]["u_P_N"] == pytest.approx(np.sqrt(P_variance), rel=0.05)  # phi is nearly 90 degrees
    assert list(found) == CAUSES
    by_name = records(capsys, "--layout", "II", "--noise", "2", "--load", "2", "--phi", "80", "--theta", "100")
    assert by_name["gauge noise"]["u_P_N"] == pytest.approx(found["gauge noise"]["u_P_N"], rel=1e-6)
    # REAL32 in the file, the load sense in theta alone.
    pushed = records(capsys, path, "--sense", "push", "--load", "2", "--phi", "80", "--theta", "100")
    assert pushed["gauge noise"]["u_P_N"] == found["gauge noise"]["u_P_N"]
    assert pushed["gauge noise"]["u_theta_deg"] != found["gauge noise"]["u_theta_deg"]


def test_five_gauges_of_which_only_the_calibration_is_known(
    capsys: pytest.CaptureFixture[str], printed: Printed, tmp_path: Path
) -> None:
    five = strain_matrix(FABRICATED, ("K_H", "S_H", "U", "L", "T"))
    calibration = Calibration(weighted_inverse(five, np.eye(5)), np.zeros(5), 1e-12 * np.eye(5))
    path = str(tmp_path / "cal.toml")
    write_calibration(path, calibration)
    captured = printed(0, ["calibrate", "budget", path, "--noise", "1"])
    assert "no row for off-axis load: the positions of the gauges are unknown" in captured.err
    assert "off-axis" not in captured.out
    layout = tmp_path / "five.toml"
    layout.write_text('points = ["K_H", "S_H", "U", "L", "T"]\n')
    assert "off-axis load" in records(capsys, path, "--layout", str(layout))
    assert "it has 3 gauges, the calibration 5" in printed(2, ["calibrate", "budget", path, "--layout", "I"]).err
    flat = replace(calibration, C=np.full((3, 5), 1e4))
    write_calibration(path, flat)
    assert "matrix: rank below 3" in printed(2, ["calibrate", "budget", path]).err


def test_text_tells_where_first_order_does_not_hold(printed: Printed) -> None:
    captured = printed(0, ["calibrate", "budget", "--load", "1", "--phi", "0", "--theta", "91"])
    lines = captured.out.splitlines()
    assert lines[0].split() == ["cause", "u(P)", "N", "share", "u(phi)", "deg", "share", "u(theta)", "deg", "share"]
    assert lines[-1].startswith("total")
    assert len(lines) == 1 + len(CAUSES)
    assert "first order does not hold for theta at 1 of 1 loads" in captured.err
    captured = printed(0, ["calibrate", "budget", "-q"])
    assert captured.err == ""
    assert captured.out.splitlines()[0].split().count("max") == 3


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="figures need the extra `plot`")
@pytest.mark.parametrize(("name", "head"), [("b.png", b"\x89PNG"), ("b.svg", b"<?xml")])
def test_plot(printed: Printed, tmp_path: Path, name: str, head: bytes) -> None:
    path = tmp_path / name
    assert main(["calibrate", "budget", "-o", str(path)]) == 0
    assert path.read_bytes().startswith(head)
    assert (
        "does not exist; create it first" in printed(2, ["calibrate", "budget", "-o", str(tmp_path / "no" / name)]).err
    )
