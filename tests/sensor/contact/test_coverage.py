"""Where first order holds, nominal 95 % intervals cover 95 %; where it does not, that is said: the quick study."""

from __future__ import annotations

from math import inf, nan, sqrt

import numpy as np
import pytest
from bench import fault_detection
from bench.coverage import DELTAS_DEG, QUICK_TRIALS, SNRS, failures, report, study, without_the_one
from bench.fault_detection import FIVE, SIX, false_alarms, rates, weights

from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import CURVATURE_LIMIT, curvature, first_order_holds, force_vector


def test_quick_study() -> None:
    cells = study(QUICK_TRIALS)
    assert len(cells) == len(SNRS) * len(DELTAS_DEG) * (1 + 3 + 2 * 2 * 3)
    # Three standard deviations of a count of so many trials on top of the two points.
    assert failures(cells, 2.0 + 300.0 * sqrt(0.95 * 0.05 / QUICK_TRIALS)) == []
    for cell in cells:
        if cell.delta_deg <= 30 or (cell.delta_deg, cell.snr) in ((60, 100), (60, 1000), (75, 1000)):
            assert all(cell.holds), cell
        if cell.delta_deg == 90 or (cell.delta_deg == 85 and cell.snr < 1000):
            assert not cell.holds[2]
            assert cell.flagged_percent > 90.0
        # An interval that misses the truth without a flag is hardly more frequent than its 5 %.
        assert cell.silent_percent < 5.0 + 2.0 + 300.0 * sqrt(0.05 * 0.95 / QUICK_TRIALS)
    isotropic = [c for c in cells if c.layout == "isotropic" and c.delta_deg == 90]
    assert all(82.0 < c.percents[2] < 92.0 for c in isotropic)  # what the flag warns of
    one = without_the_one(np.random.default_rng(1), QUICK_TRIALS)
    push = one[1]
    assert (push["grooves_to_deg"], push["sense"]) == (90.0, "push")
    assert push["leverage_ratio"] == pytest.approx(3.7, abs=0.1)
    assert float(push["P_percent_with"]) == pytest.approx(95.0, abs=1.5)
    assert float(push["P_percent_without"]) < 92.0
    text = report(cells, one, QUICK_TRIALS)
    assert "grooves to 90 deg, push" in text.lower()
    assert "95.0" in text


def test_curvature_is_the_change_of_the_slope() -> None:
    s, delta = 1e-3, np.radians(60.0)
    F = force_vector(2.0, 1.0, 1.0 - delta)
    K = s * s * np.eye(3)
    u_x = s / 2.0 * sqrt(1.0 + np.sin(delta) ** 2)
    expected = [max(s / 2.0, u_x / 0.25), s / 2.0, u_x / 0.25]
    np.testing.assert_allclose(curvature(F, K), expected, rtol=1e-9)
    straight = curvature(force_vector(2.0, 1.0, 1.0), K)
    np.testing.assert_allclose(straight, s / 2.0, rtol=1e-9)
    # P's own: 2 * bias / u(P), for noise across the force alone and beside it.
    across = curvature([0.0, 0.0, 2.0], np.diag([0.04, 0.0, 1e-4]))
    assert across[0] == pytest.approx(0.04 / (2.0 * 0.01))


def test_criterion_for_theta_is_u_of_F2_over_P_against_cosine_squared() -> None:
    s = 0.01
    for delta_deg in np.arange(0.0, 90.0, 0.5):
        sine = np.sin(np.radians(delta_deg))
        holds = first_order_holds(force_vector(1.0, 0.3, 0.3 - np.radians(delta_deg)), s * s * np.eye(3))
        assert holds[2] == (s * sqrt(1.0 + sine * sine) <= CURVATURE_LIMIT * (1.0 - sine * sine))
    assert first_order_holds([0.6, 0.9, 0.8], s * s * np.eye(3), limit=1.0)[2]


def test_edges() -> None:
    K = 1e-4 * np.eye(3)
    assert curvature([0.0, 1.0, 0.0], K).tolist() == [inf] * 3
    assert curvature([0.0, 0.0, 0.0], K).tolist() == [inf] * 3
    assert curvature([0.6, 1.2, 0.8], K)[2] == inf
    assert np.isnan(curvature([nan, 1.0, 0.0], K)).all()
    assert not first_order_holds([nan, 1.0, 0.0], K).any()
    assert not first_order_holds([0.0, 0.0, 0.0], K).any()
    assert first_order_holds([0.6, 0.3, 0.8], np.zeros((3, 3))).all()
    many = first_order_holds(np.ones((4, 5, 3)), K)
    assert many.shape == (4, 5, 3)
    for scale in (1e-100, 1e100):
        np.testing.assert_allclose(
            curvature(np.array([0.6, 0.3, 0.8]) * scale, K * scale**2), curvature([0.6, 0.3, 0.8], K), rtol=1e-9
        )
    with pytest.raises(InputError, match=r"limit = 0\.0"):
        first_order_holds([1.0, 0.0, 0.0], K, limit=0.0)
    with pytest.raises(InputError, match="covariance_F has the shape"):
        curvature([1.0, 0.0, 0.0], np.eye(2))


def test_quick_fault_detection() -> None:
    five, six = rates(FIVE, 1000), rates(SIX, 200)
    for rate in five:
        assert rate.wrong < 3.0
        if rate.kind.startswith("offset") and rate.size == 50:
            assert rate.detected > 99.0
            assert rate.isolated < 20.0 if rate.gauge in ("U", "V5") else rate.isolated > 95.0
        if rate.detected > 50.0:
            assert rate.among > 95.0
    alarms = false_alarms(500)
    assert alarms["C known"] == pytest.approx(0.1, abs=0.1)
    assert alarms["C calibrated"] == pytest.approx(0.1, abs=0.1)
    weighed = weights(20)
    other, diagonal, same = weighed.values()
    assert other[0] > 90.0  # the record must hold the covariance that weighed C
    assert other[1] > 0.2
    for alarm, error in (diagonal, same):
        assert alarm < 1.0
        assert error < 0.04
    assert "isolated" in fault_detection.report({5: five, 6: six}, alarms, weighed, 1000)
