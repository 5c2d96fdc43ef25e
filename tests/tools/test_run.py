"""`tipforce run` and `tipforce run --explain`: tables, JSON lines, exit codes, what is loaded."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tipforce.scene.reader import read_scene
from tipforce.scene.registry import identifiers, parts
from tipforce_lab.scene_cost import part_costs
from tipforce_tools.cli.main import main
from tools.rig import Printed

SCENES = Path(__file__).parents[2] / "scenes"
SHIPPED = sorted(path.stem for path in SCENES.glob("*.toml"))


def records(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_run_prints_a_table_and_judges(printed: Printed) -> None:
    out, err = printed(0, f"run {SCENES / 'grasp.toml'}")
    for node_id in range(1, 6):
        assert f"{node_id} (0x0{node_id})" in out
    assert "RMS error" in out
    assert "no contact" in out
    assert "PASS: 50 of 50 expectations hold, 0 do not" in out
    assert len(re.findall(r"^\W*ok .*\W1,2,3,4,5\W", out, re.MULTILINE)) == 10
    assert "2 s with 1000 SYNCs and 11006 frames" in err


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


def test_an_expectation_that_fails_is_exit_code_1(printed: Printed, tmp_path: Path) -> None:
    text = (SCENES / "static.toml").read_text().replace("P_error_N = 0.01", "P_error_N = 1e-6")
    (tmp_path / "scene.toml").write_text(text)
    out = printed(1, f"run {tmp_path / 'scene.toml'}").out
    assert re.search(r"FAILED\W+0 s to 1 s: largest error of P at most 1e-06 N\W+1\W+0\.001 N", out)
    assert "FAIL: 4 of 5" in out


def test_a_bus_that_cannot_carry_it_is_told(printed: Printed, tmp_path: Path) -> None:
    text = (SCENES / "static.toml").read_text().replace("sync_hz", "bit_rate = 50000\nsync_hz")
    (tmp_path / "scene.toml").write_text(text)
    assert "too much for a bus of 50000 bit/s: 316 % load" in printed(0, f"run {tmp_path / 'scene.toml'}").err
    assert "(it does not fit)" in printed(0, f"run --explain {tmp_path / 'scene.toml'}").out


def test_explain_prints_every_part_and_identifier(printed: Printed) -> None:
    path = SCENES / "dying-gauge.toml"
    out = printed(0, f"run --explain {path}").out
    scene = read_scene(path)
    for part in parts(scene):
        assert part.name in out
    for one in identifiers(scene):
        assert f"0x{one.can_id:03X}" in out
    assert "[[faults]]: 3" in out
    assert "no [dynamics]" in out


def test_explain_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--explain", str(SCENES / "tap.toml"), "--json"]) == 0
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


def test_a_shipped_scene_is_found_by_name(
    capsys: pytest.CaptureFixture[str], printed: Printed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("static", "static.toml"):
        assert main(["run", name, "--json", "-q"]) == 0
        assert records(capsys)[-1]["ok"]
    assert printed(0, "run --explain static --json").out
    (tmp_path / "static.toml").write_text("[[")
    assert "scene static.toml: " in printed(2, "run static.toml").err
