"""Figure 9: the grooves, and the simulated errors against their first-order uncertainties."""

from __future__ import annotations

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce_lab.design.paper_figures import simulate_groove_errors


def test_grooves_pull_outward() -> None:
    grooves = paper_grooves()
    assert len(grooves.theta_rad) == 19
    assert int(grooves.along_x.sum()) == 10
    assert (np.cos(grooves.phi_rad - grooves.theta_rad) > 0.49).all()  # |phi - theta| up to 60 degrees
    assert np.degrees(grooves.phi_rad[:10]).tolist() == [0.0] * 5 + [180.0] * 5
    assert set(np.degrees(grooves.phi_rad[10:])) == {90.0}


def test_errors_have_the_stated_uncertainty() -> None:
    found = simulate_groove_errors(FABRICATED, "I", 2e-6, repeats=1500, seed=5)
    ratio = found.errors.std(axis=0) / found.standard_uncertainties
    assert ratio.shape == (19, 3)
    assert np.abs(ratio - 1.0).max() < 0.09  # 1500 runs: 1.8 % standard error each, 57 numbers
    covered = (np.abs(found.errors) < 1.96 * found.standard_uncertainties).mean()
    assert covered == pytest.approx(0.95, abs=0.01)


def test_theta_is_worst_where_the_rope_pulls_tangentially() -> None:
    found = simulate_groove_errors(FABRICATED, "I", 2e-6, repeats=1, seed=6)
    u_theta = found.standard_uncertainties[:, 2]
    assert u_theta[4] > 2.0 * u_theta[0]  # x-grooves at 60 and 5 degrees
    assert found.standard_uncertainties[18, 0] > 1.4 * found.standard_uncertainties[14, 0]  # extrapolated y-groove


def test_same_seed_same_errors_and_noise_scales() -> None:
    one, two = (simulate_groove_errors(FABRICATED, "III", 1e-6, repeats=3, seed=7) for _ in range(2))
    np.testing.assert_array_equal(one.errors, two.errors)
    double = simulate_groove_errors(FABRICATED, "III", 2e-6, repeats=3, seed=7)
    np.testing.assert_allclose(double.standard_uncertainties, 2.0 * one.standard_uncertainties, rtol=0.05)


def test_refuses() -> None:
    for noise, repeats in ((0.0, 1), (-1e-6, 1), (float("nan"), 1), (1e-6, 0)):
        with pytest.raises(InputError, match="allowed are positive numbers"):
            simulate_groove_errors(FABRICATED, "I", noise, repeats=repeats, seed=1)
    with pytest.raises(InputError, match="layouts of 3 gauges"):
        simulate_groove_errors(FABRICATED, ("L", "R", "U", "T"), 1e-6, repeats=1, seed=1)
