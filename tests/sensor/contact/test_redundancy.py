"""More than three gauges: the weighted inverse and back, subsets, chi-square, isolation; numpy against scalar."""

from math import inf, isnan, nan
from typing import Any

import numpy as np
import pytest
from bench.fault_detection import alike, separation

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor import detect, parity
from tipforce.sensor.contact import scalar_redundancy
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.redundancy import NONE, UNCLEAR, detectable_strain, structure_matrix, weighted_inverse
from tipforce.sensor.structure.layouts import POINTS
from tipforce.sensor.structure.strain import FABRICATED, GaugePosition, position_matrix, strain_matrix

SIGMA = 1e-6
FIVE = [GaugePosition("H", "left", 0.0), GaugePosition("H", "right", 0.0), GaugePosition("V", "right", 15e-3)]
FIVE += [GaugePosition("H", "left", 15e-3), GaugePosition("V", "left", 5e-3)]  # case I, then L, then one of its own
SIX = [GaugePosition("H", "left", 0.0), GaugePosition("H", "right", 0.0), GaugePosition("H", "left", 15e-3)]
SIX += [GaugePosition("V", "right", s) for s in (5e-3, 10e-3, 15e-3)]


def structure(n: int) -> FloatArray:
    if n == 8:
        return strain_matrix(FABRICATED, POINTS)
    return position_matrix(FABRICATED, SIX if n == 6 else FIVE[:n])


def correlated(n: int, seed: int = 1) -> FloatArray:
    """A covariance whose gauges differ by a factor of a few and share some of their noise."""
    rng = np.random.default_rng(seed)
    root = np.diag(rng.uniform(0.5, 2.0, n)) + 0.3 * rng.normal(size=(n, n))
    return SIGMA**2 * root @ root.T


def upper(covariance: FloatArray) -> list[float]:
    return [float(value) for value in covariance[np.triu_indices(len(covariance))]]


@pytest.mark.parametrize("n", [3, 4, 5, 6, 8])
def test_the_structure_comes_back_from_the_calibration(n: int) -> None:
    A, covariance = structure(n), correlated(n)
    C = weighted_inverse(A, covariance)
    np.testing.assert_allclose(C @ A, np.eye(3), atol=1e-9)
    for unit in (1e-300, 1e-160, 1.0, 1e160, 1e300):  # of newtons
        np.testing.assert_allclose(structure_matrix(unit * C, covariance) * unit, A, atol=1e-9 * np.abs(A).max())
        if n > 3:
            np.testing.assert_allclose(parity(unit * C, covariance).visible, parity(C, covariance).visible)
    weights = np.linalg.inv(covariance)
    normal = np.linalg.solve(A.T @ weights @ A, A.T @ weights)
    np.testing.assert_allclose(C, normal, rtol=1e-6, atol=1e-9 * np.abs(C).max())


def without(C: FloatArray, covariance: FloatArray, gauges: list[int], *limit: float) -> Any:
    return scalar_redundancy.leave_out(C.tolist(), upper(covariance), gauges, *limit)


@pytest.mark.parametrize("n", [4, 5, 6, 8])
def test_without_a_gauge_is_the_weighted_fit_of_the_others(n: int) -> None:
    A, covariance = structure(n), correlated(n)
    C = weighted_inverse(A, covariance)
    for k in range(n):
        matrix, of_force = without(C, covariance, [k])
        found = np.array(matrix)
        assert not found[:, k].any()
        kept = [i for i in range(n) if i != k]
        part = covariance[np.ix_(kept, kept)]
        direct = weighted_inverse(A[kept], part)
        np.testing.assert_allclose(found[:, kept], direct, rtol=1e-6, atol=1e-9 * np.abs(direct).max())
        np.testing.assert_allclose(of_force, upper(direct @ part @ direct.T), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("n", [4, 5, 6])
def test_chi_square_is_chi_square(n: int) -> None:
    rng = np.random.default_rng(2)
    A, covariance = structure(n), correlated(n)
    model = parity(weighted_inverse(A, covariance), covariance)
    V = force_vector(4.4, 1.0, 1.3) @ A.T + rng.multivariate_normal(np.zeros(n), covariance, 40_000)
    for rate in (0.1, 0.01):
        faults = detect(model, V, false_alarm_rate=rate)
        assert np.mean(faults.fault) == pytest.approx(rate, rel=0.15)
    assert np.mean(faults.chi_square) == pytest.approx(n - 3, rel=0.05)
    assert np.var(faults.chi_square) == pytest.approx(2 * (n - 3), rel=0.1)
    assert np.all(faults.isolated[~faults.fault] == NONE)
    wide = detect(model, V, false_alarm_rate=0.01, variance_factor=2.0)
    np.testing.assert_allclose(wide.chi_square, faults.chi_square / 2.0)


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("rate", [0.5, 1e-2, 1e-4, 1e-9])
def test_chi_square_threshold(degrees: int, rate: float) -> None:
    from scipy.stats import chi2

    assert scalar_redundancy.chi_square_threshold(rate, degrees) == pytest.approx(chi2.isf(rate, degrees), rel=1e-9)
    assert scalar_redundancy.chi_square_threshold(rate, 0) == 0.0


def test_six_gauges_three_a_beam_isolate_every_one() -> None:
    rng = np.random.default_rng(4)
    A, covariance = structure(6), SIGMA**2 * np.eye(6)
    model = parity(weighted_inverse(A, covariance), covariance)
    assert alike(model, smallest_sine=0.05) == []
    assert detectable_strain(model).max() < 20.0 * SIGMA
    for k in range(6):
        V = A @ force_vector(2.0, 1.0, 1.3) + SIGMA * rng.normal(size=(2000, 6))
        V[:, k] += 60.0 * SIGMA
        assert np.mean(detect(model, V).isolated == k) > 0.98


def test_four_gauges_isolate_nothing() -> None:
    A, covariance = structure(4), SIGMA**2 * np.eye(4)
    model = parity(weighted_inverse(A, covariance), covariance)
    found = detect(model, A @ force_vector(2.0, 1.0, 1.3) + np.array([1e-4, 0.0, 0.0, 0.0]))
    assert found.fault
    assert found.isolated == UNCLEAR
    # Without U only the axial strain of the other beam tells F3: its fault shows 4000 times less, but it shows.
    assert found.candidates.tolist() == [True, True, bool(model.visible[2]), True]
    # Unless one gauge alone is visible: it responds to no force, the other three are all needed.
    lonely = parity(weighted_inverse(np.vstack([structure(3), np.zeros(3)]), covariance), covariance)
    assert np.flatnonzero(lonely.visible).tolist() == [3]
    assert detect(lonely, [0.0, 0.0, 0.0, 1e-4]).isolated == 3
    assert not detect(lonely, [1e-4, 0.0, 0.0, 0.0]).fault  # taken for a force
    assert detectable_strain(lonely)[0] == inf
    assert isnan(separation(lonely)[0, 1])


def test_two_faults_leave_no_candidate_and_nan_is_a_fault() -> None:
    A, covariance = structure(5), SIGMA**2 * np.eye(5)
    model = parity(weighted_inverse(A, covariance), covariance)
    two = detect(model, [[1e-4, 0.0, 5e-4, 0.0, 0.0], [nan, 0.0, 0.0, 0.0, 0.0], [0.0] * 5])
    assert two.fault.tolist() == [True, True, False]
    assert two.isolated.tolist() == [UNCLEAR, UNCLEAR, NONE]
    assert not two.candidates.any()


@pytest.mark.parametrize("n", [4, 5, 6, 8])
def test_scalar_is_the_array_formula(n: int) -> None:
    """And both are the weighted residuals of the force that fits best."""
    rng = np.random.default_rng(5)
    A, covariance = structure(n), correlated(n)
    C = weighted_inverse(A, covariance)
    rows, noise = C.tolist(), upper(covariance)
    back = scalar_redundancy.structure_matrix(rows, noise)
    assert back is not None
    np.testing.assert_allclose(back, A, atol=1e-9 * np.abs(A).max())
    W = scalar_redundancy.directions(rows, noise, list(range(n)))
    assert W is not None
    shown = scalar_redundancy.columns(W, noise)
    V = rng.normal(size=(300, n)) * np.geomspace(SIGMA, 1e-3, 300)[:, np.newaxis]
    faults = detect(parity(C, covariance), V)
    r, Q = V - V @ C.T @ A.T, np.linalg.inv(covariance)
    np.testing.assert_allclose(faults.chi_square, np.einsum("mi,ij,mj->m", r, Q, r), rtol=1e-6)
    alarm = scalar_redundancy.chi_square_threshold(scalar_redundancy.FALSE_ALARM_RATE, n - 3)
    exclusion = scalar_redundancy.chi_square_threshold(scalar_redundancy.EXCLUSION_RATE, n - 4)
    for strains, chi_square, fault, candidates in zip(
        V, faults.chi_square, faults.fault, faults.candidates, strict=True
    ):
        found, bits, _ = scalar_redundancy.judge(W, shown, strains.tolist(), None, alarm, exclusion)
        assert found == pytest.approx(chi_square, rel=1e-6)
        assert bits == (sum(1 << int(k) for k in np.flatnonzero(candidates)) if fault else -1)


@pytest.mark.parametrize("n", [4, 5, 6, 8])
def test_extra_variance_is_that_of_a_larger_covariance(n: int) -> None:
    """Weighed by Sigma + diag(extra): chi-square is the smallest that any force leaves of it."""
    rng = np.random.default_rng(6)
    A, covariance = structure(n), correlated(n)
    W = scalar_redundancy.directions(weighted_inverse(A, covariance).tolist(), upper(covariance), list(range(n)))
    assert W is not None
    np.testing.assert_allclose(np.array(W) @ covariance @ np.array(W).T, np.eye(n - 3), atol=1e-8)
    shown = scalar_redundancy.columns(W, upper(covariance))
    for V in rng.normal(size=(50, n)) * 1e-5:
        extra = np.square(0.05 * V)
        Q = np.linalg.inv(covariance + np.diag(extra))
        r = V - A @ np.linalg.solve(A.T @ Q @ A, A.T @ Q @ V)
        found, _, _ = scalar_redundancy.judge(W, shown, V.tolist(), extra.tolist(), 1.0, 1.0)
        assert found == pytest.approx(r @ Q @ r, rel=1e-6)


def test_scalar_refuses_what_has_no_rank_3() -> None:
    thin = np.array([[1.0, -2.0, 0.0], [1.0, 2.0, 0.0], [0.0, 1.5, -1.5], [-1.0, 1.0, 0.0]]) * 1e-4
    C, noise = weighted_inverse(thin, np.eye(4)).tolist(), upper(np.eye(4))
    assert [scalar_redundancy.leave_out(C, noise, [k]) is None for k in range(4)] == [False, False, True, False]
    assert scalar_redundancy.leave_out(C, noise, [0, 1]) is None
    assert scalar_redundancy.leave_out(C, noise, [3], condition_limit=1.0) is None
    assert scalar_redundancy.structure_matrix([[1.0, 0.0, 0.0]] * 3, upper(np.eye(3))) is None
    assert scalar_redundancy.leave_out([[1.0, 0.0, 0.0]] * 3, upper(np.eye(3)), []) is None
    assert scalar_redundancy.directions([[1.0, 0.0, 0.0]] * 3, upper(np.eye(3)), [0, 1, 2]) is None
    singular = upper(np.ones((4, 4)))
    assert scalar_redundancy.leave_out(C, singular, [3]) is None
    assert scalar_redundancy.directions(C, singular, [0, 1, 2, 3]) is None


def test_scalar_without_noise_weighs_equally_and_checks_nothing() -> None:
    A = structure(5)
    C, noise = np.linalg.pinv(A), [0.0] * 15
    found = scalar_redundancy.leave_out(C.tolist(), noise, [1])
    assert found is not None
    assert found[1] == (0.0,) * 6
    expected = np.insert(np.linalg.pinv(np.delete(A, 1, axis=0)), 1, 0.0, axis=1)
    np.testing.assert_allclose(found[0], expected, atol=1e-7 * np.abs(expected).max())
    assert scalar_redundancy.directions(C.tolist(), noise, [0, 1, 2, 3, 4]) is None


def test_a_reading_that_is_no_number_is_a_fault_of_no_gauge() -> None:
    covariance = SIGMA**2 * np.eye(5)
    C = weighted_inverse(structure(5), covariance)
    W = scalar_redundancy.directions(C.tolist(), upper(covariance), [0, 1, 2, 3, 4])
    assert W is not None
    shown = scalar_redundancy.columns(W, upper(covariance))
    chi_square, bits, _ = scalar_redundancy.judge(W, shown, [nan] * 5, None, 1.0, 1.0)
    assert isnan(chi_square)
    assert bits == 0


def test_errors() -> None:
    C = weighted_inverse(structure(5), np.eye(5))
    for call, text in (
        (lambda: weighted_inverse(np.ones((2, 3)), np.eye(2)), "A has the shape"),
        (lambda: weighted_inverse(np.ones((4, 3)), np.eye(4)), "allowed is A of rank 3"),
        (lambda: weighted_inverse(structure(5), np.eye(4)), "covariance_strain2 has the shape"),
        (lambda: weighted_inverse(structure(5), np.zeros((5, 5))), "not positive definite"),
        (lambda: structure_matrix(np.ones((3, 5)), np.eye(5)), "allowed is C of rank 3"),
        (lambda: structure_matrix(np.ones((2, 5)), np.eye(5)), "C has the shape"),
        (lambda: parity(np.eye(3), np.eye(3)), "at least four"),
        (lambda: detect(parity(C, np.eye(5)), np.ones(4)), "strain has the shape"),
        (lambda: detect(parity(C, np.eye(5)), np.ones(5), false_alarm_rate=0.0), "false_alarm_rate = 0.0"),
        (lambda: detect(parity(C, np.eye(5)), np.ones(5), exclusion_rate=1.0), "exclusion_rate = 1.0"),
    ):
        with pytest.raises(InputError, match=text):
            call()


def test_a_fault_below_the_limit_counts_by_its_probability() -> None:
    C = [[1.0, 2.0, 0.0, 1.0], [0.0, 1.0, 3.0, 1.0], [2.0, 0.0, 1.0, 1.0]]
    noise, none = upper(np.eye(4)), (0.0, 0.0)
    explained, visible = 2.0 * np.log(scalar_redundancy.NO_FAULT), 0.5
    # Alone, a gauge that explains so much is at fault with the probability 1/2.
    alone = scalar_redundancy.doubt(C, noise, [(explained, visible), none, none, none])
    half = 0.5 * explained / visible
    assert alone == pytest.approx((half, 0.0, 2.0 * half, 0.0, 0.0, 4.0 * half))
    # Two that explain it alike share; one that hardly shows, and one that explains nothing, add nothing of their own.
    both = scalar_redundancy.doubt(C, noise, [(explained, visible), (explained, visible), (explained, 0.05), none])
    third = explained / visible / 3.0
    assert both == pytest.approx((5.0 * third, 2.0 * third, 2.0 * third, third, 0.0, 4.0 * third))
    assert scalar_redundancy.doubt(C, noise, [(0.0, visible)] * 4) == (0.0,) * 6
    certain = scalar_redundancy.doubt(C, noise, [(1e6, visible), none, none, none])  # a limit that nothing reaches
    assert certain[0] == pytest.approx(1e6 / visible)
