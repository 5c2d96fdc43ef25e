"""Standard uncertainties: derivatives, Monte Carlo, scalar against array; the coverage of their intervals."""

from math import inf, isnan, nan, pi, sqrt

import numpy as np
import pytest
from bench import fault_detection
from bench.coverage import DELTAS_DEG, QUICK_TRIALS, SNRS, failures, miss_uncertainties, report, study, without_the_one
from bench.fault_detection import FIVE, SIX, false_alarms, rates, weights
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor import contacts, curvature, first_order_holds, force_vector, standard_uncertainties
from tipforce.sensor.contact import scalar_uncertainty

UPPER = np.triu_indices(3)
# Between are components with subnormal squares: they have fewer digits, in either formula.
NORMAL = st.floats(-1e3, 1e3).filter(lambda value: not 1e-166 < abs(value) < 1e-142)
COMPONENT = st.one_of(NORMAL, st.sampled_from([0.0, 0.6, 0.8, 1.0, -1.0, 1e-300, 1e300, nan]))


def upper(covariance: FloatArray) -> tuple[float, float, float, float, float, float]:
    k11, k12, k13, k22, k23, k33 = (float(value) for value in covariance[UPPER])
    return k11, k12, k13, k22, k23, k33


def wrapped(angle_rad: FloatArray) -> FloatArray:
    return np.remainder(angle_rad + pi, 2 * pi) - pi


def random_covariance(rng: np.random.Generator) -> FloatArray:
    root: FloatArray = rng.normal(size=(3, 3))
    return root @ root.T


@pytest.mark.parametrize("pull", [True, False])
def test_first_order_is_the_derivative(pull: bool) -> None:
    rng, h = np.random.default_rng(5), 1e-6
    for _ in range(50):
        theta, delta = rng.uniform(-pi, pi), rng.uniform(-1.2, 1.2)
        F = force_vector(1.7, theta + delta + (0.0 if pull else pi), theta)
        above, below = contacts(F + h * np.eye(3), pull=pull), contacts(F - h * np.eye(3), pull=pull)
        angles = (wrapped(above.phi_rad - below.phi_rad), wrapped(above.theta_rad - below.theta_rad))
        J = np.array([above.P_newtons - below.P_newtons, *angles]) / (2 * h)
        covariance = 1e-18 * random_covariance(rng)
        expected = np.sqrt(np.diag(J @ covariance @ J.T))
        np.testing.assert_allclose(standard_uncertainties(F, covariance, pull=pull), expected, rtol=1e-6)


def test_magnitude_is_biased_by_half_the_variance() -> None:
    rng, s = np.random.default_rng(8), 0.05
    noisy = np.array([0.6, 0.1, 0.8]) + s * rng.normal(size=(400_000, 3))
    assert np.mean(contacts(noisy, pull=True).P_newtons) - 1.0 == pytest.approx(s * s / 2, rel=0.2)


def test_no_load_has_the_uncertainty_of_its_worst_direction() -> None:
    covariance = np.array([[4.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 1.0]])
    for F in ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        u_P, u_phi, u_theta = scalar_uncertainty.uncertainty(*F, upper(covariance), True)
        assert u_P == pytest.approx(2.0)
        assert isnan(u_phi)
        assert isnan(u_theta)
        assert scalar_uncertainty.miss_uncertainty(*F, upper(covariance)) == pytest.approx(5.0)
        assert miss_uncertainties(np.array(F), covariance) == pytest.approx(5.0)


def test_the_uncertainty_of_the_magnitude_alone_is_the_same_number() -> None:
    rng = np.random.default_rng(9)
    odd = [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [nan, 1.0, 0.0], [1.0, inf, 0.0], [1e-300, 1e-300, 0.0], [1e300, 0.0, 1.0]]
    for F1, F2, F3 in odd + (rng.normal(size=(200, 3)) * 10.0 ** rng.uniform(-6, 3, (200, 1))).tolist():
        for covariance in (random_covariance(rng), np.zeros((3, 3)), 1e-300 * random_covariance(rng)):
            found = scalar_uncertainty.magnitude_uncertainty(F1, F2, F3, upper(covariance))
            expected = scalar_uncertainty.uncertainty(F1, F2, F3, upper(covariance), False)[0]
            assert found == expected or (isnan(found) and isnan(expected))


def test_overflow_is_infinite_and_a_miss_without_noise_certain() -> None:
    assert scalar_uncertainty.uncertainty(0.6, 2.0, 0.8, (0.0,) * 6, True) == (0.0, 0.0, 0.0)
    assert not standard_uncertainties((0.6, 2.0, 0.8), np.zeros((3, 3)), pull=True).any()
    assert scalar_uncertainty.uncertainty(1e-300, 0.0, 1e-300, (1e300, 0.0, 0.0, 1e300, 0.0, 1e300), True)[1] == inf
    assert standard_uncertainties([1e-300, 0.0, 1e-300], np.eye(3) * 1e300, pull=True)[1] == inf


@settings(max_examples=300, derandomize=True, deadline=None)
@given(st.tuples(COMPONENT, COMPONENT, COMPONENT), st.integers(0, 10**6), st.integers(-150, 150), st.booleans())
def test_scalar_is_the_array_formula(F: tuple[float, float, float], seed: int, power: int, pull: bool) -> None:
    covariance = 10.0 ** (2 * power) * random_covariance(np.random.default_rng(seed))
    one = scalar_uncertainty.uncertainty(*F, upper(covariance), pull)
    np.testing.assert_allclose(standard_uncertainties([F], covariance[np.newaxis], pull=pull)[0], one, rtol=1e-12)
    miss = scalar_uncertainty.miss_uncertainty(*F, upper(covariance))
    np.testing.assert_allclose(miss_uncertainties(np.array(F), covariance), miss, rtol=1e-12)


def test_miss_uncertainty_is_the_derivative() -> None:
    rng, h = np.random.default_rng(9), 1e-6
    for sign in (1.0, -1.0):
        F, covariance = np.array([0.6, sign * 1.4, 0.8]), random_covariance(rng)
        difference = contacts(F + h * np.eye(3), pull=True).miss_newtons
        J = (difference - contacts(F - h * np.eye(3), pull=True).miss_newtons) / (2 * h)
        assert miss_uncertainties(F, covariance) == pytest.approx(sqrt(J @ covariance @ J), rel=1e-6)


def test_shape_errors() -> None:
    for shape in ((3,), (2, 2), (5, 3, 3)):
        with pytest.raises(InputError, match="covariance_F has the shape"):
            standard_uncertainties(np.ones((4, 3)), np.ones(shape), pull=True)
    with pytest.raises(InputError, match="F has the shape"):
        standard_uncertainties(np.ones((4, 2)), np.eye(3), pull=True)


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
    np.testing.assert_allclose(curvature(force_vector(2.0, 1.0, 1.0), K), s / 2.0, rtol=1e-9)
    # P's own: 2 * bias / u(P), for noise across the force alone and beside it.
    assert curvature([0.0, 0.0, 2.0], np.diag([0.04, 0.0, 1e-4]))[0] == pytest.approx(0.04 / (2.0 * 0.01))


def test_edges() -> None:
    K = 1e-4 * np.eye(3)
    assert curvature([0.0, 1.0, 0.0], K).tolist() == [inf] * 3
    assert curvature([0.0, 0.0, 0.0], K).tolist() == [inf] * 3
    assert curvature([0.6, 1.2, 0.8], K)[2] == inf
    assert np.isnan(curvature([nan, 1.0, 0.0], K)).all()
    assert not first_order_holds([nan, 1.0, 0.0], K).any()
    assert not first_order_holds([0.0, 0.0, 0.0], K).any()
    assert first_order_holds([0.6, 0.3, 0.8], np.zeros((3, 3))).all()
    assert first_order_holds(np.ones((4, 5, 3)), K).shape == (4, 5, 3)
    for scale in (1e-100, 1e100):
        np.testing.assert_allclose(
            curvature(np.array([0.6, 0.3, 0.8]) * scale, K * scale**2), curvature([0.6, 0.3, 0.8], K), rtol=1e-9
        )
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
