"""What somebody meets who has just installed it: no bus, a wrong file, a narrow terminal; and the demo."""

import io
import json
import math
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from rich.console import Console
from rich.table import Table

from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.scene import beam_calibration
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import CASES
from tipforce.sensor.structure.published import GROOVES_DEG
from tipforce.sensor.structure.strain import strain_matrix
from tipforce.watching.watcher import Finger
from tipforce_tools.cli import common
from tipforce_tools.cli.main import main
from tipforce_tools.demo import job
from tipforce_tools.page.sources import is_scene, scene_source
from tools.rig import Printed

SCENE = """\
duration_s = 0.2
sync_hz = 100

[[nodes]]
ids = [5, 6]
pdos = ["gauges", "contact"]
layout = "II"

[[loads]]
kind = "static"
P_N = 2.0
phi_deg = -90
theta_deg = 80
"""
EXPECTS = SCENE + "\n[[expect]]\nfrom_s = 0.1\nto_s = 0.2\nP_error_N = 0.1\n"
FloatArray = npt.NDArray[np.float64]

QUANTITIES = ("P_N", "phi_deg", "theta_deg")
LOADS = len(CASES) * 2 * len(GROOVES_DEG)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(EXPECTS)
    return path


@pytest.fixture
def log(scene: Path, tmp_path: Path) -> Path:
    path = tmp_path / "run.log"
    assert main(["run", str(scene), "-q", "--json", "-o", str(path)]) == 0
    return path


def test_no_row_says_why(log: Path, printed: Printed) -> None:
    out, err = printed(0, f"decode {log} --nodes 77")
    assert not out
    assert err.startswith("no sample of a fingertip in ")
    assert err.endswith(" frames; --nodes may exclude it\n")


def test_filters_behind_a_log_hold_for_it(log: Path, printed: Printed) -> None:
    lines = printed(0, f"dump {log},285:7FF -n 3").out.splitlines()
    assert [line.split()[1] for line in lines] == ["285"] * 3


@pytest.mark.parametrize("command", ["log -o {}.log --seconds 0.3", "dump -n 3", "monitor --once 0.3"])
def test_sync_is_sent_while_a_command_listens(command: str, tmp_path: Path, printed: Printed) -> None:
    """On a bus where no other device sends it; each also receives what it sends."""
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
    silent.write_text(SCENE.replace('"gauges", "contact"', ""))
    with pytest.raises(InputError, match=r"silent\.toml: no PDO of a fingertip"):
        scene_source(silent, Finger)


def test_gauges_of_a_decoded_log_are_measurements(log: Path, tmp_path: Path, printed: Printed) -> None:
    calibration, gauges, both = (str(tmp_path / name) for name in ("cal.toml", "gauges.csv", "both.csv"))
    write_calibration(calibration, beam_calibration("II"))
    assert main(["decode", str(log), "--nodes", "5", "--signals", "SG1,SG2,SG3", "-q", "-o", gauges]) == 0
    rows = printed(0, f"estimate {calibration} {gauges} --json -q").records
    assert len(rows) == 20
    assert all(abs(row["P_N"] - 2.0) < 0.01 and row["status"] == "ok" for row in rows)
    assert main(["decode", str(log), "--nodes", "5", "-q", "-o", both]) == 0
    assert "SG1_ue beside P_N: this is a decoded log" in printed(2, f"estimate {calibration} {both}").err


def test_a_number_is_never_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (200, 40, 10):
        stream = io.StringIO()
        monkeypatch.setattr(common, "console", lambda w=width, s=stream: Console(file=s, width=w))
        table = Table(title="t")
        for name in ("first value", "second value", "third value"):
            table.add_column(name, justify="right")
        table.add_column("words")
        table.add_row("-179.961", "1234.567", "+0.003", "some words that may wrap anywhere")
        common.print_table(table)
        told = stream.getvalue()
        assert all(number in told for number in ("-179.961", "1234.567", "+0.003")), told
        assert ("\u2502" in told) == (width == 200)


@pytest.mark.parametrize(
    "words", ["run scenes/grasp.toml --explain", "design table 1", "design table fig9 --repeats 2"]
)
def test_no_word_of_a_table_is_cut_in_eighty_columns(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too long for its column goes on in the next line: a key is there to be copied."""
    stream = io.StringIO()
    monkeypatch.setattr(common, "console", lambda *_, **__: Console(file=stream, width=80))
    monkeypatch.chdir(Path(__file__).parents[2])
    assert main(words.split()) == 0
    told = stream.getvalue()
    assert max(map(len, told.splitlines())) <= 80
    assert "\u2026" not in told
    if words.startswith("run"):
        assert "noise.one_over_f_microstrain" in re.sub(r"\s+", "", told)


def demo(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[dict[str, object]], dict[str, object]]:
    code = main(["demo", "--json", "-q", *words])
    out, err = capsys.readouterr()
    assert err == ""
    *rows, summary = [json.loads(line) for line in out.splitlines()]
    return code, rows, summary


def test_every_estimate_is_inside_its_bound(capsys: pytest.CaptureFixture[str]) -> None:
    code, rows, summary = demo(capsys)
    assert code == 0
    assert len(rows) == summary["loads"] == LOADS == 114
    assert all(row["inside"] and row["host_agrees"] for row in rows)
    assert {(row["case"], row["sense"]) for row in rows} == {(c, s) for c in CASES for s in ("pull", "push")}
    assert summary["ok"] is True
    assert (summary["outside"], summary["host_disagrees"]) == (0, 0)
    # The flags are what the printed numbers say.
    for row in rows:
        for quantity in QUANTITIES:
            error, bound, u = (float(str(row[f"{name}_{quantity}"])) for name in ("error", "bound", "u"))
            assert abs(error) <= bound
            assert 0 < u < bound


def test_spoiled_calibrations_are_found(capsys: pytest.CaptureFixture[str]) -> None:
    code, rows, summary = demo(capsys, "--spoil")
    assert code == 1
    assert summary["ok"] is False
    outside = [row for row in rows if not row["inside"]]
    assert len(outside) == summary["outside"]
    assert {row["case"] for row in outside} == set(CASES), "each node has a falsified matrix"


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


def test_without_a_table_what_is_wrong_is_shown(printed: Printed) -> None:
    lines = printed(1, "demo --color never --spoil -q").out
    assert 0 < lines.count("OUT") < LOADS
    assert " ok " not in lines


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
    _, found = contact_model.estimate(calibration.C, counted * 1e-6, offset * 1e-6, pull=calibration.pull)
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
