"""What somebody meets who has just installed it: no bus, a wrong file, a narrow terminal; the demo; `tipforce run`."""

import io
import math
import re
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus
from rich.console import Console
from rich.table import Table

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.scene import beam_calibration
from tipforce.scene.reader import read_scene
from tipforce.scene.registry import identifiers, parts
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.layouts import CASES, GROOVES_DEG
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.watching.feeds import Finger
from tipforce_lab.scene_cost import part_costs
from tipforce_tools.cli import tables
from tipforce_tools.cli.main import main
from tipforce_tools.demo import job
from tipforce_tools.page.sources import is_scene, scene_source
from tools.rig import Printed

SCENE = """\
duration_s = 0.2
sync_hz = 100
nodes = [{ ids = [5, 6], pdos = ["gauges", "contact"], layout = "II" }]
loads = [{ kind = "static", P_N = 2.0, phi_deg = -90, theta_deg = 80 }]
expect = [{ from_s = 0.1, to_s = 0.2, P_error_N = 0.1 }]
"""

LOADS = len(CASES) * 2 * len(GROOVES_DEG)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def test_no_row_says_why_and_filters_behind_a_log_hold_for_it(hand_log: Path, printed: Printed) -> None:
    out, err = printed(0, f"decode {hand_log} --nodes 77")
    assert not out
    assert re.fullmatch(r"no sample of a fingertip in \d+ frames; --nodes may exclude it\n", err)
    lines = printed(0, f"dump {hand_log},285:7FF -n 3").out.splitlines()
    assert [line.split()[1] for line in lines] == ["285"] * 3


@pytest.mark.parametrize("command", ["log -o {}.log --seconds 0.3", "dump -n 3", "monitor --once 0.3"])
def test_sync_is_sent_while_a_command_listens(command: str, tmp_path: Path, printed: Printed, monkeypatch: Any) -> None:
    """On a bus where no other device sends it, also after one that cannot be sent; each also receives what it sends."""
    full, send = iter([False, True]), VirtualBus.send

    def sends(*frame: Any) -> None:
        if next(full, False):
            raise can.CanOperationError("the queue is full")
        send(*frame)

    monkeypatch.setattr(VirtualBus, "send", sends)
    words = [*command.format(tmp_path / "v").split(), "-i", "virtual", "-c", f"sync {command}"]
    out = printed(0, [*words, "--sync", "100"]).out
    if command.startswith("log"):
        out = (tmp_path / "v.log").read_text()
        assert out.count(" 080#\n") > 10
    assert "080" in out or float(out.partition("SYNC ")[2].split()[0]) > 50


def test_a_run_that_was_too_short_to_judge_does_not_pass(scene: Path, printed: Printed) -> None:
    last = printed(0, f"run {scene} -q --duration 0.05").out.splitlines()[-1]
    assert last == "NOT JUDGED: 0 of 2 expectations hold, 0 do not, 2 not judged (the run was too short)"
    assert printed(0, f"run {scene} -q").out.splitlines()[-1] == "PASS: 2 of 2 expectations hold, 0 do not"


def test_a_scene_is_viewed_as_the_log_that_it_writes(scene: Path, tmp_path: Path) -> None:
    assert is_scene(scene)
    hand = tmp_path / "hand.toml"
    hand.write_text("[hand]\n[[finger]]\nnode_id = 1\n")
    assert not is_scene(hand)
    assert not is_scene(tmp_path / "no.toml")
    source = scene_source(scene, Finger)
    assert source.title == "scene.toml"
    assert [(finger.node_id, finger.layout) for finger in source.model.fingers] == [(5, "II"), (6, "II")]
    assert source.model.counters.rows == 20
    assert list(tmp_path.glob("*.log")) == []
    silent = tmp_path / "silent.toml"
    silent.write_text(SCENE.replace('"gauges", "contact"', "").replace("expect", "#"))
    with pytest.raises(InputError, match=r"silent\.toml: no PDO of a fingertip"):
        scene_source(silent, Finger)


def test_gauges_of_a_decoded_log_are_measurements(scene: Path, tmp_path: Path, printed: Printed) -> None:
    log, calibration, gauges, both = (tmp_path / name for name in ("run.log", "cal.toml", "gauges.csv", "both.csv"))
    write_calibration(calibration, beam_calibration("II"))
    printed(0, f"run {scene} -q --json -o {log}")
    printed(0, f"decode {log} --nodes 5 --signals SG1,SG2,SG3 -q -o {gauges}")
    rows = printed(0, f"estimate {calibration} {gauges} --json -q").records
    assert len(rows) == 20
    assert all(abs(row["P_N"] - 2.0) < 0.01 and row["status"] == "ok" for row in rows)
    printed(0, f"decode {log} --nodes 5 -q -o {both}")
    assert "SG1_ue beside P_N: this is a decoded log" in printed(2, f"estimate {calibration} {both}").err


def test_a_number_is_never_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (200, 40, 10):
        stream = io.StringIO()
        monkeypatch.setattr(tables, "console", lambda w=width, s=stream: Console(file=s, width=w))
        table = Table(title="t")
        for name in ("first value", "second value", "third value"):
            table.add_column(name, justify="right")
        table.add_column("words")
        table.add_row("-179.961", "1234.567", "+0.003", "some words that may wrap anywhere")
        tables.print_table(table)
        told = stream.getvalue()
        assert all(number in told for number in ("-179.961", "1234.567", "+0.003")), told
        assert ("\u2502" in told) == (width == 200)


@pytest.mark.parametrize(
    "words", ["run scenes/grasp.toml --explain", "design table 1", "design table fig9 --repeats 2"]
)
def test_no_word_of_a_table_is_cut_in_eighty_columns(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too long for its column goes on in the next line: a key is there to be copied."""
    stream = io.StringIO()
    monkeypatch.setattr(tables, "console", lambda *_, **__: Console(file=stream, width=80))
    monkeypatch.chdir(Path(__file__).parents[2])
    assert main(words.split()) == 0
    told = stream.getvalue()
    assert max(map(len, told.splitlines())) <= 80
    assert "\u2026" not in told
    if words.startswith("run"):
        assert "noise.one_over_f_microstrain" in re.sub(r"\s+", "", told)


def test_every_estimate_is_inside_its_bound(printed: Printed) -> None:
    output = printed(0, "demo --json -q")
    assert output.err == ""
    *rows, summary = output.records
    assert len(rows) == summary["loads"] == LOADS == 114
    assert all(row["inside"] and row["host_agrees"] for row in rows)
    assert {(row["case"], row["sense"]) for row in rows} == {(c, s) for c in CASES for s in ("pull", "push")}
    assert summary["ok"] is True
    assert (summary["outside"], summary["host_disagrees"]) == (0, 0)
    for row in rows:  # the flags are what the printed numbers say
        for quantity in ("P_N", "phi_deg", "theta_deg"):
            error, bound, u = (float(str(row[f"{name}_{quantity}"])) for name in ("error", "bound", "u"))
            assert abs(error) <= bound
            assert 0 < u < bound


def test_spoiled_calibrations_are_found_and_shown(printed: Printed) -> None:
    *rows, summary = printed(1, "demo --json -q --spoil").records
    assert summary["ok"] is False
    outside = [row for row in rows if not row["inside"]]
    assert len(outside) == summary["outside"]
    assert {row["case"] for row in outside} == set(CASES), "each node has a falsified matrix"
    lines = printed(1, "demo --color never --spoil -q").out  # without a table
    assert 0 < lines.count("OUT") < LOADS
    assert " ok " not in lines


@pytest.mark.parametrize("table", [(), ("--table",)])
def test_it_ends_in_three_lines_below_its_table(table: tuple[str, ...], printed: Printed) -> None:
    out, err = printed(0, ["demo", "--color", "never", *table])
    *above, first, second, third = out.splitlines()
    assert (bool(above), out.count("Case "), out.count(" ok ")) == ((True, 3, LOADS) if table else (False, 0, 0))
    assert "\x1b" not in out
    assert "OUT" not in out
    assert first.startswith("114 loads of 4.4 N on 3 nodes: RMS error P 0.00")
    assert second == "errors outside their bound: 0; host estimates that differ from the node's: 0"
    assert third.startswith("PASS in ")
    assert err.count("after a reset the stored calibration is active") == 6


def test_any_seed_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five seeds on every third groove; z stays that of the whole demo."""
    few = GROOVES_DEG[::3]
    whole = job.coverage_factor(LOADS * 3)
    monkeypatch.setattr("tipforce_tools.demo.job.GROOVES_DEG", few)
    monkeypatch.setattr(job, "coverage_factor", lambda _: whole)
    estimates = []
    for seed in range(5):
        results = list(job.run_demo(seed, False, lambda _: None, lambda: None))
        assert len(results) == 6 * len(few)
        assert all(result.inside and result.host_agrees for result in results)
        estimates.append(tuple(float(result.estimated[0]) for result in results))
    assert len(set(estimates)) == 5, "the seed changes the noise"


def test_a_missing_value_is_outside_and_angles_are_compared_round_the_circle() -> None:
    nothing = np.full(3, np.nan)
    result = job.Result("I", "pull", np.ones(3), nothing, np.ones(3), np.ones(3), np.full(3, 1e9), np.full(3, 1e9))
    assert (result.inside, result.host_agrees) == (False, False)
    near, far = np.array([1.0, 179.99, 5.0]), np.array([1.0, -179.99, 5.0])
    result = job.Result("I", "pull", far, near, near, np.ones(3), np.full(3, 0.1), np.full(3, 0.1))
    np.testing.assert_allclose(result.error, [0.0, -0.02, 0.0], atol=1e-9)
    assert result.inside


def simulated_errors(calibration: Calibration, applied: FloatArray, draws: int, seed: int) -> FloatArray:
    """Errors of ``draws`` noisy readings in P, phi, theta, (draws, 3), worked out from strains: no use of bounds().

    A reading is what the demo's chain does to it: noise, offset, rounding to counts, estimate, rounding to PDO steps.
    """
    rng = np.random.default_rng(seed)
    P, phi, theta = applied[0], *np.radians(applied[1:])
    offset = np.array(job.OFFSETS_MICROSTRAIN)
    case = CASES[calibration.layout_code - 1]
    exact = 1e6 * strain_matrix(FABRICATED, case) @ force_vector(P, phi, theta) + offset
    noisy = exact + rng.normal(0.0, job.NOISE_MICROSTRAIN, (draws, 3))
    counted = np.round(noisy / job.COUNT_MICROSTRAIN) * job.COUNT_MICROSTRAIN
    F = contact_model.force_from_strain(calibration.C, counted * 1e-6, offset * 1e-6)
    found = contact_model.contacts(F, pull=calibration.pull)
    values = np.column_stack([found.P_newtons, np.degrees(found.phi_rad), np.degrees(found.theta_rad)])
    steps = 2 * job.HALF_STEP
    errors: FloatArray = np.round(values / steps) * steps - applied
    errors[:, 1:] = (errors[:, 1:] + 180.0) % 360.0 - 180.0
    return errors


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("pull", [True, False])
@pytest.mark.parametrize("groove", [0, 4, 9, 10, 14, 18])
def test_the_bound_against_a_simulation(case: str, pull: bool, groove: int) -> None:
    """With z = 3.29 at least 99.9 % are inside, and the bound is no more than three times the largest of many."""
    phi, theta = GROOVES_DEG[groove]
    applied = np.array([job.WEIGHT_NEWTONS, phi if pull else phi - math.copysign(180.0, phi - 1.0), theta])
    calibration = job.case_calibration(case, pull)
    u, bound, _ = job.bounds(calibration, applied, z=3.29)
    errors = simulated_errors(calibration, applied, 20_000, seed=groove)
    inside = np.mean(np.abs(errors) <= bound, axis=0)
    assert (inside >= 0.999).all(), inside
    assert (np.abs(errors).max(axis=0) > bound / 3).all()
    # u says what the errors scatter, rounding to PDO steps on top (a uniform error: step / sqrt(12)).
    expected = np.hypot(u, 2 * job.HALF_STEP / math.sqrt(12))
    np.testing.assert_allclose(errors.std(axis=0), expected, rtol=0.03)
    assert (np.abs(errors.mean(axis=0)) < 0.05 * expected).all(), "no bias"


SCENES = Path(__file__).parents[2] / "scenes"
SHIPPED = sorted(path.stem for path in SCENES.glob("*.toml"))


def test_a_run_prints_a_table_and_judges(printed: Printed) -> None:
    out, err = printed(0, f"run {SCENES / 'grasp.toml'}")
    for node_id in range(1, 6):
        assert f"{node_id} (0x0{node_id})" in out
    assert "RMS error" in out
    assert "no contact" in out
    assert "PASS: 50 of 50 expectations hold, 0 do not" in out
    assert len(re.findall(r"^\W*ok .*\W1,2,3,4,5\W", out, re.MULTILINE)) == 10
    assert "2 s with 1000 SYNCs and 11006 frames" in err


def test_a_run_as_json(printed: Printed, tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    found = printed(0, f"run {SCENES}/overload.toml --json -q -o {log}").records
    one, two = (record for record in found if "samples" in record)
    assert one["estimated_P_N"] is None
    assert one["missing"]["saturated"] > 0
    assert one["slit_closed"] > 0
    assert two["estimated_P_N"] == pytest.approx(30.0, abs=0.01)
    assert found[-1]["summary"]
    assert found[-1]["files"] == [str(log)]
    assert log.stat().st_size > 0


def test_an_expectation_that_fails_is_exit_code_1_and_a_bus_that_cannot_carry_it_is_told(
    scene: Path, printed: Printed
) -> None:
    scene.write_text("bit_rate = 20000\n" + SCENE.replace("P_error_N = 0.1", "phi_error_deg = 1e-6"))
    out, err = printed(1, f"run {scene}")
    assert re.search(r"FAILED\W+0\.1 s to 0\.2 s: largest error of phi at most 1e-06 deg\W+5,6\W+0\.02 deg", out)
    assert "FAIL: 0 of 2" in out
    assert "too much for a bus of 20000 bit/s: 246 % load" in err
    assert "(it does not fit)" in printed(0, f"run --explain {scene}").out


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


def test_explain_as_json(printed: Printed) -> None:
    found = printed(0, f"run --explain {SCENES}/tap.toml --json").records
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


def test_a_shipped_scene_is_found_by_name(printed: Printed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("static", "static.toml"):
        assert printed(0, f"run {name} --json -q").records[-1]["ok"]
    assert printed(0, "run --explain static --json").out
    (tmp_path / "static.toml").write_text("[[")
    assert "scene static.toml: " in printed(2, "run static.toml").err
