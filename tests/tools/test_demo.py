"""The demo: it passes, it fails when it must, and the bound that it prints is neither too wide nor too narrow."""

from __future__ import annotations

import json
import math

import numpy as np
import numpy.typing as npt
import pytest

from tipforce.host.configuration.calibration import Calibration
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import CASES
from tipforce.sensor.structure.published import GROOVES_DEG
from tipforce.sensor.structure.strain import strain_matrix
from tipforce_tools.cli.main import main
from tipforce_tools.demo import job
from tools.rig import Printed

FloatArray = npt.NDArray[np.float64]

QUANTITIES = ("P_N", "phi_deg", "theta_deg")
LOADS = len(CASES) * 2 * len(GROOVES_DEG)


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


def test_it_ends_in_three_lines(printed: Printed) -> None:
    first, second, third = printed(0, ["demo", "--color", "never"]).out.splitlines()
    assert first.startswith("114 loads of 4.4 N on 3 nodes: RMS error P 0.00")
    assert second == "errors outside their bound: 0; host estimates that differ from the node's: 0"
    assert third.startswith("PASS in ")
    lines = printed(1, ["demo", "--color", "never", "--spoil", "-q"]).out
    assert 0 < lines.count("OUT") < LOADS, "those that are wrong are shown"
    assert " ok " not in lines


def test_the_table_for_people(printed: Printed) -> None:
    out, err = printed(0, ["demo", "--color", "never", "--table"])
    assert out.count("Case ") == 3
    assert "\x1b" not in out
    assert out.count(" ok ") == LOADS
    assert "OUT" not in out
    assert "114 loads of 4.4 N on 3 nodes: RMS error P 0.00" in out
    assert "errors outside their bound: 0; host estimates that differ from the node's: 0\nPASS in " in out
    assert err.count("after a reset the stored calibration is active") == 6


def run(seed: int) -> list[job.Result]:
    return list(job.run_demo(seed, False, lambda _: None, lambda: None))


def test_any_seed_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five seeds on every third groove; z stays that of the whole demo."""
    few = GROOVES_DEG[::3]
    whole = job.coverage_factor(LOADS * 3)
    monkeypatch.setattr("tipforce_tools.demo.job.GROOVES_DEG", few)
    monkeypatch.setattr(job, "coverage_factor", lambda _: whole)
    estimates = []
    for seed in range(5):
        results = run(seed)
        assert len(results) == 6 * len(few)
        assert all(result.inside and result.host_agrees for result in results)
        estimates.append(tuple(float(result.estimated[0]) for result in results))
    assert len(set(estimates)) == 5, "the seed changes the noise"


def test_a_missing_value_is_outside() -> None:
    nothing = np.full(3, np.nan)
    result = job.Result("I", "pull", np.ones(3), nothing, np.ones(3), np.ones(3), np.full(3, 1e9), np.full(3, 1e9))
    assert not result.inside
    assert not result.host_agrees


def test_angles_are_compared_round_the_circle() -> None:
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
