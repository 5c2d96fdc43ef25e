"""`tipforce design optimise`: what it prints, judges and writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.sensor.structure.gauges import gauge_matrix
from tipforce.sensor.structure.limits import worst_stress
from tipforce.sources.layout_file import read_layout
from tipforce_lab.design.merit import LoadSet, merit
from tipforce_tools.cli.main import main
from tools.rig import Printed

QUICK = ("--starts", "2")


def records(capsys: pytest.CaptureFixture[str], *words: str) -> list[dict[str, Any]]:
    assert main(["design", "optimise", "--json", *QUICK, *words]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return [json.loads(line) for line in captured.out.splitlines()]


def test_the_papers_cases_stand_beside_the_designs(capsys: pytest.CaptureFixture[str]) -> None:
    *entries, summary = records(capsys, "--starts", "6")
    by_name = {entry["name"]: entry for entry in entries}
    assert list(by_name)[:5] == ["I", "II", "III", "I glued", "best"]
    assert [round(by_name[case]["condition_number"], 3) for case in ("I", "II", "III")] == [2.510, 2.610, 2.711]
    assert by_name["I"]["gauges"] == ["K_H", "S_H", "U"]
    assert by_name["best"]["u_theta_deg"] < 0.9 * by_name["I glued"]["u_theta_deg"]
    assert summary["u_theta_against_case_I_glued"] == pytest.approx(
        by_name["best"]["u_theta_deg"] / by_name["I glued"]["u_theta_deg"]
    )
    assert (summary["summary"], summary["agrees"], summary["agreement_limit"]) == (True, True, 0.03)
    assert summary["condition_only_u_theta_against_case_I"] > 5.0
    assert summary["condition_only_noise_against_case_I"] > 5.0
    assert by_name["best"]["disagreement"] < 0.03
    assert by_name["best"]["frame_u_theta_deg"] == pytest.approx(by_name["best"]["u_theta_deg"], rel=0.03)


def test_the_layout_that_it_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "four.toml"
    words = ["--gauges", "4", "--load", "3", "--noise", "1", "-q", "-o", str(path)]
    best = next(record for record in records(capsys, *words) if record["name"] == "best")
    text = path.read_text()
    assert text.startswith("# tipforce design optimise --objective theta --gauges 4 --seed 0\n")
    geometry, gauges = read_layout(str(path))
    assert geometry.a_m == best["a_m"]
    got = merit(gauge_matrix(geometry, gauges), 1.0, LoadSet(3.0))
    assert got.u_theta_deg == pytest.approx(best["u_theta_deg"], rel=1e-12)
    assert got.condition_number == pytest.approx(best["condition_number"], rel=1e-12)
    assert worst_stress(geometry, 3.0) == pytest.approx(best["worst_stress_pascals"])
    assert np.linalg.matrix_rank(gauge_matrix(geometry, gauges)) == 3


def test_for_people(printed: Printed, tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    captured = printed(0, ["design", "optimise", *QUICK, "-o", str(path)])
    assert "Structures, mm" in captured.out
    assert "K_H, S_H, U" in captured.out
    assert "condition number alone: 1." in captured.out
    assert "beam theory and the independent frame agree within 3 %: PASS (best 0." in captured.out
    assert captured.err == f"wrote {path}\n"
    assert all(len(line) <= 120 for line in captured.out.splitlines())


def test_a_design_that_the_frame_does_not_confirm_fails(printed: Printed) -> None:
    out = printed(1, ["design", "optimise", *QUICK, "--objective", "condition"]).out
    assert "agree within 3 %: FAIL (condition" in out
    assert "condition: u(theta) +" in out


def test_the_flags_reach_the_limits(capsys: pytest.CaptureFixture[str]) -> None:
    words = "--envelope 24,28 --width 8 --min-h 0.3 --gauge-length 1.5 --load 6 --max-stress 300 --slit 0.2"
    best = next(record for record in records(capsys, *words.split()) if record["name"] == "best")
    assert best["r_m"] <= 12e-3 + 1e-9
    assert best["d_m"] + best["r_m"] + best["h1_m"] / 2 <= 28e-3 + 1e-8
    assert min(best["h1_m"], best["h2_m"]) >= 0.3e-3 - 1e-9
    assert best["width_m"] == pytest.approx(8e-3)
    assert best["worst_stress_pascals"] <= 300e6 * (1 + 1e-6)
    assert best["slit_load_newtons"] >= 6 * (1 - 1e-6)


def test_gauges_too_long_for_the_paper_leave_out_its_glued_case(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--gauge-length", "15.5", "--envelope", "80,80", "--slit", "1"]
    *entries, summary = records(capsys, *words)
    assert "I glued" not in [entry["name"] for entry in entries]
    assert summary["u_theta_against_case_I_glued"] is None
