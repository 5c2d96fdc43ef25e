"""`tipforce run` and `tipforce scene explain`: tables, JSON lines, exit codes, what is loaded."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.scene.reader import read_scene
from tipforce.scene.registry import identifiers, parts
from tipforce_lab.report.study import Effort
from tipforce_lab.scene_cost import STEPS, Measured, _differences, import_times, nondecreasing, part_costs, studies
from tipforce_tools.cli.main import main

SCENES = Path(__file__).parents[2] / "scenes"
SHIPPED = sorted(path.stem for path in SCENES.glob("*.toml"))


def records(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_run_prints_a_table_and_judges(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(SCENES / "grasp.toml")]) == 0
    out, err = capsys.readouterr()
    for node_id in range(1, 6):
        assert f"{node_id} (0x0{node_id})" in out
    assert "RMS error" in out
    assert "no contact" in out
    assert "PASS: 50 of 50 expectations hold, 0 do not" in out
    assert len(re.findall(r"^\W*ok .*\W1,2,3,4,5\W", out, re.MULTILINE)) == 10
    assert "2 s with 1000 SYNCs and 6006 frames" in err


def test_a_run_as_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    assert main(["run", str(SCENES / "overload.toml"), "--json", "-q", "-o", str(log)]) == 0
    found = records(capsys)
    one, two = (record for record in found if "samples" in record)
    assert one["estimated_P_N"] is None
    assert one["missing"]["saturated"] > 0
    assert one["slit_closed"] > 0
    assert two["estimated_P_N"] == pytest.approx(30.0, abs=0.01)
    assert found[-1]["summary"]
    assert found[-1]["files"] == [str(log)]
    assert log.stat().st_size > 0


def test_an_expectation_that_fails_is_exit_code_1(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = (SCENES / "static.toml").read_text().replace("P_error_N = 0.01", "P_error_N = 1e-6")
    (tmp_path / "scene.toml").write_text(text)
    assert main(["run", str(tmp_path / "scene.toml")]) == 1
    out = capsys.readouterr().out
    assert re.search(r"FAILED\W+0 s to 1 s: largest error of P at most 1e-06 N\W+1\W+0\.001 N", out)
    assert "FAIL: 4 of 5" in out


def test_a_shorter_run_judges_less(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(SCENES / "static.toml"), "--duration", "0.1", "--seed", "4"]) == 0
    assert capsys.readouterr().out.count("not judged") == 6  # five lines, and the last one


def test_a_bus_that_cannot_carry_it_is_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = (SCENES / "static.toml").read_text().replace("sync_hz", "bit_rate = 50000\nsync_hz")
    (tmp_path / "scene.toml").write_text(text)
    assert main(["run", str(tmp_path / "scene.toml")]) == 0
    assert "too much for a bus of 50000 bit/s: 316 % load" in capsys.readouterr().err
    assert main(["scene", "explain", str(tmp_path / "scene.toml")]) == 0
    assert "(it does not fit)" in capsys.readouterr().out


def test_explain_prints_every_part_and_identifier(capsys: pytest.CaptureFixture[str]) -> None:
    path = SCENES / "dying-gauge.toml"
    assert main(["scene", "explain", str(path)]) == 0
    out = capsys.readouterr().out
    scene = read_scene(path)
    for part in parts(scene):
        assert part.name in out
    for one in identifiers(scene):
        assert f"0x{one.can_id:03X}" in out
    assert "[[faults]]: 3" in out
    assert "no [dynamics]" in out


def test_explain_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    path = SCENES / "tap.toml"
    assert main(["scene", "explain", str(path), "--json"]) == 0
    found = records(capsys)
    told = {record["part"]: record for record in found if "part" in record}
    assert told["dynamics"]["built"]
    assert "tipforce.sensor.dynamics.first_order_hold" in told["dynamics"]["modules"]
    assert not told["noise"]["built"]
    assert [record["cob_id"] for record in found if "cob_id" in record] == ["0x000", "0x080", "0x281", "0x701"]
    assert found[-1]["bus_load"] == pytest.approx(0.158)


def test_costs_are_those_of_the_parts_that_are_built() -> None:
    path = SCENES / "static.toml"
    scene = read_scene(path)
    costs = part_costs(scene, path, samples=40, runs=1)
    built = {part.name: part.built for part in parts(scene)}
    assert list(costs) == [*built, "all"]
    assert all((costs[name]["import_ms"] is not None) == held for name, held in built.items())
    assert all(costs[name]["us_per_sample"] is None for name, held in built.items() if not held)
    assert costs["nodes"]["us_per_sample"] is not None


def test_no_part_costs_less_than_nothing() -> None:
    assert nondecreasing([1.0, 2.0, 2.0, 5.0]) == [1.0, 2.0, 2.0, 5.0]
    assert nondecreasing([3.0, 1.0, 2.0, 7.0, 6.0]) == [2.0, 2.0, 2.0, 6.5, 6.5]
    rng = np.random.default_rng(4)
    for _ in range(50):
        noisy = np.arange(12) + 5.0 * rng.normal(size=12)
        found = nondecreasing(noisy.tolist())
        assert found == sorted(found)
        assert sum(found) == pytest.approx(noisy.sum())
    times = [Measured(us, ms, (), 0.0) for us, ms in ((10.0, 1.0), (11.0, -0.5), (4.0, 0.25), (6.0, -1.0))]
    steps = _differences(times)
    assert min(min(step) for step in steps) >= 0.0
    assert [us for us, _ in steps] == [0.0, 5.5, 0.0, 5.0]
    assert sum(us for us, _ in steps) == pytest.approx(10.5)


def test_import_times_go_to_the_part_that_loads() -> None:
    path = SCENES / "tap.toml"
    found = import_times(read_scene(path), path)
    assert found["dynamics"] > 0.0
    assert found["structure"] > 0.0  # numpy
    assert "plot" not in found
    assert "noise" not in found


def test_the_study_of_the_report_ends_with_the_bare_nodes() -> None:
    steps: list[None] = []
    (study,) = studies(Effort(quick=True), lambda: steps.append(None))
    assert len(steps) == STEPS
    assert [one.method for one in study.series] == ["static", "full"]
    static, full = (one.points for one in study.series)
    assert len(static) < len(full)
    assert full[0].error > static[0].error  # noise, dynamics and temperature
    # Processor time, as a ratio within one run: it is about ten.
    assert full[0].timing.seconds > 2.0 * static[0].timing.seconds


def test_a_shipped_scene_is_found_by_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("static", "static.toml"):
        assert main(["run", name, "--json", "-q"]) == 0
        assert records(capsys)[-1]["ok"]
    assert main(["scene", "explain", "static", "--json"]) == 0
    assert capsys.readouterr().out
    (tmp_path / "static.toml").write_text("[[")
    assert main(["run", "static.toml"]) == 2
    assert "scene static.toml: " in capsys.readouterr().err


@pytest.mark.parametrize("words", [("run",), ("scene", "explain"), ("view",)])
def test_a_name_that_is_no_scene_lists_the_shipped_ones(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "grsp"]) == 2
    assert capsys.readouterr().err == f"tipforce: grsp: no such file; by name ship {', '.join(SHIPPED)}\n"
