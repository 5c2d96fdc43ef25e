"""The fit against the truth, closed forms and faults of every kind, rounded to what is finer than REAL32."""

from dataclasses import replace

import numpy as np
import pytest
from bench.calibration import CONDITIONS, SEEDS, compare, coverage, pooled

from sensor.calibration.made import CLEAN, readings, simulated, some
from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor import FABRICATED, Fit, condition_number, covariance_of_estimate, force_vector, strain_matrix
from tipforce.sensor.calibration.data import Model, beam_prior
from tipforce.sensor.calibration.fit import fit_calibration, linear_fit
from tipforce.sensor.calibration.result import DIGITS, kronecker, matrix_to_digits, rounded, to_digits
from tipforce.sensor.calibration.simulation import Simulated, simulate
from tipforce.sensor.structure.layouts import POINTS, layout

PLAIN = Model(loss="none")


@pytest.mark.parametrize("n", [3, 4, 5, 8])
@pytest.mark.parametrize("drift", ["none", "tare", "linear"])
@pytest.mark.parametrize("loss", ["none", "huber", "soft_l1"])
def test_exact_readings_give_the_truth(n: int, drift: str, loss: str) -> None:
    gauges = ("K_H", "S_H", "U", "L", "R", "T", "K_V", "S_V")[:n]
    sim = simulated(n, replace(CLEAN, noise_strain=0.0), gauges)
    fit = fit_calibration(readings(sim), Model(drift=drift, loss=loss))  # type: ignore[arg-type]
    np.testing.assert_allclose(fit.A, sim.true_A, atol=1e-7 * np.abs(sim.true_A).max())
    np.testing.assert_allclose(fit.C @ sim.true_A, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(fit.C @ fit.A, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(fit.offset_strain, sim.true_offset_strain[-1], atol=1e-10)
    assert (fit.outliers, fit.saturated, fit.near_limit) == ((), (), ())
    assert fit.condition_number == pytest.approx(condition_number(sim.true_A), rel=1e-5)


def test_without_faults_it_is_ordinary_least_squares() -> None:
    sim = simulated(1)
    fit = fit_calibration(readings(sim), PLAIN)
    G = np.column_stack((force_vector(sim.P_newtons, sim.phi_rad, sim.theta_rad), np.ones(77)))
    beta, *_ = np.linalg.lstsq(G, sim.strain, rcond=None)
    residual = sim.strain - G @ beta
    S = residual.T @ residual / (77 - 4)
    np.testing.assert_allclose(fit.A, beta[:3].T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fit.offset_strain, beta[3], atol=1e-12)
    np.testing.assert_allclose(fit.N, G.T @ G, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(fit.residual_covariance_strain2, S, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(fit.noise_covariance_strain2, S, rtol=2e-3, atol=2e-15)
    np.testing.assert_allclose(fit.parameter_covariance, kronecker(S, G.T @ G), rtol=5e-3, atol=1e-16)
    assert fit.dof == pytest.approx(73)
    assert fit.leverage.sum() == pytest.approx(4)
    np.testing.assert_allclose(fit.leverage, np.einsum("ip,pq,iq->i", G, np.linalg.inv(G.T @ G), G), rtol=1e-6)
    assert fit.coverage_factor == pytest.approx(1.993, abs=1e-3)
    assert fit.sigma0 == pytest.approx(1.0, abs=1e-2)


def test_covariance_of_an_estimate_is_the_formula_of_the_paper_notes() -> None:
    fit = fit_calibration(readings(simulated(2)), PLAIN)
    S, N, F = fit.residual_covariance_strain2, fit.N, np.array([[1.0, -0.5, 2.0], [0.0, 0.0, 0.0]])
    found = covariance_of_estimate(fit.C, S, kronecker(S, N), F)
    for force, covariance in zip(F, found, strict=True):
        G = np.append(force, 1.0)
        expected = fit.C @ (S + S * (G @ np.linalg.inv(N) @ G)) @ fit.C.T
        np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-16)
    exact = covariance_of_estimate(fit.C, fit.noise_covariance_strain2, fit.parameter_covariance, F)
    np.testing.assert_allclose(exact, found, rtol=5e-3, atol=1e-7)
    known = covariance_of_estimate(fit.C, S, kronecker(S, N), F, offset_known=True)
    np.testing.assert_allclose(known[1], fit.C @ S @ fit.C.T, rtol=1e-9, atol=1e-16)
    assert np.trace(known[0]) < np.trace(found[0])


def test_uncertainty_of_the_matrix_is_its_derivative_for_more_gauges_than_forces() -> None:
    fit = fit_calibration(readings(simulated(3, gauges=layout(["K_H", "S_H", "U", "T", "L"]))), PLAIN)
    whitener = np.linalg.inv(np.linalg.cholesky(fit.noise_covariance_strain2))
    variance = np.zeros(fit.C.shape)
    values, vectors = np.linalg.eigh(fit.parameter_covariance[:, :3, :, :3].reshape(15, 15))
    for value, vector in zip(values, vectors.T, strict=True):
        step = 1e-3 * vector.reshape(5, 3) * np.abs(fit.A).max()
        change = [np.linalg.pinv(whitener @ (fit.A + side * step)) @ whitener for side in (1, -1)]
        variance += max(value, 0.0) * ((change[0] - change[1]) / (2e-3 * np.abs(fit.A).max())) ** 2
    np.testing.assert_allclose(fit.C_uncertainty, np.sqrt(variance), rtol=1e-4)


def test_weight_is_a_number_of_readings() -> None:
    sim = simulated(5)
    thrice = np.where(np.arange(77) % 2 == 0, 3.0, 1.0)
    model = Model(loss="none", noise_strain=1e-6)
    weighted = fit_calibration(readings(sim, weight=thrice), model)
    rows = np.repeat(np.arange(77), thrice.astype(int))
    repeated = fit_calibration(some(sim, rows), model)
    np.testing.assert_allclose(weighted.A, repeated.A, rtol=1e-9)
    np.testing.assert_allclose(weighted.N, repeated.N, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(weighted.C_uncertainty, repeated.C_uncertainty, rtol=1e-9)


@pytest.mark.parametrize("loss", ["huber", "soft_l1"])
def test_outliers_are_named_and_do_not_matter(loss: str) -> None:
    sim = simulated(6)
    wrong, P = sim.strain.copy(), sim.P_newtons.copy()
    wrong[10, 1] += 200e-6
    wrong[33] *= -1.0
    P[50] *= 10.0  # a decimal point forgotten: the row has nearly all the leverage
    fit = fit_calibration(readings(sim, strain=wrong, P_newtons=P), Model(loss=loss))  # type: ignore[arg-type]
    assert fit.outliers == (10, 33, 50)
    expected = fit_calibration(some(sim, np.setdiff1d(np.arange(77), fit.outliers)), PLAIN)
    np.testing.assert_allclose(fit.C, expected.C, atol=0.5 * expected.C_uncertainty.max())
    assert not fit.used[[10, 33, 50]].any()
    kept = fit_calibration(readings(sim, strain=wrong), PLAIN)
    assert set(kept.outliers) & {10, 33}
    assert kept.used.all()


def test_a_tare_alone_at_its_time_can_be_an_outlier_the_last_one_too() -> None:
    sim = simulated(7, replace(CLEAN, drift_strain=15e-6))
    wrong = sim.strain.copy()
    wrong[[36, 76], 0] += 150e-6
    fit = fit_calibration(readings(sim, strain=wrong), Model(drift="tare"))
    assert fit.outliers == (36, 76)
    np.testing.assert_allclose(fit.offset_strain, sim.true_offset_strain[-1], atol=4e-6)


def test_saturated_readings_are_left_out_with_those_that_noise_kept_below_the_limit() -> None:
    sim = simulated(8, replace(CLEAN, saturation=0.8, noise_strain=5e-6))
    assert sim.saturation_strain is not None
    fit = fit_calibration(readings(sim), Model(saturation_strain=sim.saturation_strain))
    assert len(fit.saturated) >= 2
    for row, gauge in (*fit.saturated, *fit.near_limit):
        assert not fit.used[row, gauge]
        assert fit.used[row].any()
    assert np.abs(fit.A - sim.true_A).max() < 0.01 * np.abs(sim.true_A).max()
    with pytest.raises(InputError, match=r"SG3 reads exactly .* the extreme, in 3 rows .* converter's limit"):
        fit_calibration(readings(sim), PLAIN)
    blind = fit_calibration(readings(sim), replace(PLAIN, saturation_strain=np.inf))
    assert np.abs(blind.A - sim.true_A).max() > np.abs(fit.A - sim.true_A).max()


def offsets(fit: Fit, sim: Simulated) -> FloatArray:
    """The fitted offset with its drift at each row: what force and residual leave of the readings."""
    return sim.strain - force_vector(sim.P_newtons, sim.phi_rad, sim.theta_rad) @ fit.A.T - fit.residual_strain


@pytest.mark.parametrize(("drift", "warm_up"), [("tare", 0.5), ("tare", 0.0), ("linear", 0.0)])
def test_drift_is_followed(drift: str, warm_up: float) -> None:
    sim = simulated(9, replace(CLEAN, drift_strain=40e-6, warm_up=warm_up))
    fit = fit_calibration(readings(sim), Model(drift=drift))  # type: ignore[arg-type]
    assert np.abs(offsets(fit, sim) - sim.true_offset_strain).max() < 2e-6
    np.testing.assert_allclose(fit.offset_strain, offsets(fit, sim)[-1], atol=1e-15)
    blind = fit_calibration(readings(sim), PLAIN)
    assert blind.sigma0 == pytest.approx(1.0, abs=0.02)
    assert np.diag(blind.noise_covariance_strain2).max() > 10 * np.diag(fit.noise_covariance_strain2).max()


def test_a_restless_drift_is_interpolated_between_the_tares() -> None:
    sim = simulated(10)
    walk = np.cumsum(np.random.default_rng(10).normal(size=(20, 3)) * 30e-6, axis=0)
    tares = np.arange(0, 77, 4)
    wander = np.stack([np.interp(np.arange(77), tares, one) for one in walk.T], axis=-1)
    fit = fit_calibration(readings(sim, strain=sim.strain + wander), Model(drift="tare"))
    assert np.abs(offsets(fit, sim) - sim.true_offset_strain).max() < 4e-6
    assert fit.outliers == ()


def test_uncertain_directions_weigh_less_than_they_scatter() -> None:
    sim = simulated(11, replace(CLEAN, hang_scatter_rad=0.02))
    fit = fit_calibration(readings(sim), Model(phi_scatter_rad=0.02, theta_scatter_rad=0.02))
    assert np.sqrt(np.diag(fit.noise_covariance_strain2)).max() < 3e-6
    assert np.sqrt(np.diag(fit.residual_covariance_strain2)).max() > 5e-6
    assert fit.sigma0 == pytest.approx(1.0, abs=0.15)
    told = fit_calibration(readings(sim), Model(loss="none", phi_scatter_rad=0.002, noise_strain=1e-6))
    assert told.sigma0_loaded > 2.0
    assert told.hang_scatter > 5.0
    assert told.sigma0_unloaded == pytest.approx(1.0, abs=0.4)


def test_three_loads_and_beam_theory() -> None:
    sim = simulated(12)
    few = some(sim, [0, 1, 2, 6])  # a tare, one groove with two weights, another groove
    with pytest.raises(InputError, match="cannot show"):
        fit_calibration(few, Model(noise_strain=1e-6))
    prior = beam_prior(FABRICATED, layout("I"), 0.05)
    fit = fit_calibration(few, Model(noise_strain=1e-6, prior=prior))
    theory = strain_matrix(FABRICATED, "I")
    assert np.linalg.norm(fit.A - sim.true_A) < 0.9 * np.linalg.norm(theory - sim.true_A)
    sure = fit_calibration(few, Model(noise_strain=1e-6, prior=replace(prior, relative_scatter=1e-9)))
    np.testing.assert_allclose(sure.A, theory, rtol=1e-6, atol=1e-6 * np.abs(theory).max())
    loose = fit_calibration(readings(sim), Model(noise_strain=1e-6, prior=replace(prior, relative_scatter=1e3)))
    free = fit_calibration(readings(sim), Model(noise_strain=1e-6))
    np.testing.assert_allclose(loose.A, free.A, rtol=1e-7, atol=1e-7 * np.abs(free.A).max())


def test_residuals_by_load() -> None:
    fit = fit_calibration(readings(simulated(13)), PLAIN)
    tares, *loads = fit.loads
    assert (tares.P_newtons, len(tares.rows), len(loads)) == (0.0, 20, 57)
    assert sorted(row for load in fit.loads for row in load.rows) == list(range(77))
    for load in fit.loads:
        rows = list(load.rows)
        np.testing.assert_allclose(load.mean_strain, fit.residual_strain[rows].mean(axis=0))
        force = fit.residual_strain[rows] @ fit.C.T
        np.testing.assert_allclose(load.rms_newtons, np.sqrt(np.square(force).mean(axis=0)))
        assert load.leverage == fit.leverage[rows].max()


def test_the_papers_fit() -> None:
    sim = simulated(15, replace(CLEAN, offset_strain=0.0, noise_strain=0.0))
    F = force_vector(sim.P_newtons, sim.phi_rad, sim.theta_rad)
    np.testing.assert_allclose(linear_fit(sim.strain, F) @ sim.true_A, np.eye(3), atol=1e-9)
    with pytest.raises(InputError, match=r"F \(3, 3\)"):
        linear_fit(sim.strain, F[:3])
    with pytest.raises(InputError, match="rank 1"):
        linear_fit(np.outer(np.arange(5.0), np.ones(3)), np.ones((5, 3)))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"strain": np.zeros((5, 2))}, r"\(5, 2\)"),
        ({"P_newtons": np.zeros(77)}, "all 77 rows are unloaded"),
        ({"P_newtons": np.full(77, -1.0)}, r"P_newtons\[0\] = -1"),
        ({"phi_rad": np.zeros(3)}, r"phi_rad has the shape \(3,\)"),
        ({"weight": np.zeros(77)}, r"weight\[0\] = 0"),
        (Model(drift="cubic"), "'cubic' is not known"),  # type: ignore[arg-type]
        (Model(loss="l2"), "'l2' is not known"),  # type: ignore[arg-type]
        (Model(offset=False, drift="tare"), "needs an offset"),
        (Model(phi_scatter_rad=-0.1), "phi_scatter_rad = -0.1"),
        (Model(noise_strain=0.0), "noise_strain = 0.0"),
        (Model(saturation_strain=np.ones(2)), "saturation_strain"),
        (Model(prior=beam_prior(FABRICATED, POINTS[:4])), r"shape \(4, 3\)"),
    ],
)
def test_readings_and_models_that_cannot_be_used(given: Model | dict[str, FloatArray], text: str) -> None:
    changes, model = (given, None) if isinstance(given, dict) else ({}, given)
    with pytest.raises(InputError, match=text):
        fit_calibration(readings(simulated(16), **changes), model)


def test_all_values_are_rounded_to_the_place_of_the_largest() -> None:
    assert to_digits([12345.678912345, 0.00012345, -1e-12]).tolist() == [12345.6789, 0.0001, 0.0]
    assert to_digits([3.1e-15, 1.23456789012e-14]).tolist() == pytest.approx([3.1e-15, 1.23456789e-14], rel=1e-15)
    assert to_digits([1e-12], scale=1e-3).tolist() == [0.0]
    assert to_digits([0.0, -0.0]).tolist() == [0.0, 0.0]
    assert np.isnan(to_digits([np.nan, 1.0])[0])
    assert to_digits(2.0 / 3.0, 3) == 0.667
    # The rows of a matrix by themselves.
    assert matrix_to_digits([[1e6 / 3, 1.0], [1e-3 / 3, 1.0]]).tolist() == [[333333.333, 1.0], [0.00033333, 1.0]]
    assert np.finfo(np.float32).eps > 10.0 ** (1 - DIGITS) / 2  # finer than the node's numbers


def test_nothing_that_the_data_show_is_lost() -> None:
    exact = fit_calibration(readings(simulate("I", np.random.default_rng(4))), Model(saturation_strain=np.inf))
    found = rounded(exact)
    assert (np.abs(found.C - exact.C) < 1e-5 * exact.C_uncertainty).all()
    scatter = np.sqrt(np.einsum("kiki->ki", exact.parameter_covariance)[:, 3])
    assert (np.abs(found.offset_strain - exact.offset_strain) < 1e-5 * scatter).all()
    for name in ("noise_covariance_strain2", "residual_covariance_strain2", "parameter_covariance", "N"):
        before, after = getattr(exact, name), getattr(found, name)
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-8 * np.abs(before).max())
        matrix = after.reshape(int(np.sqrt(after.size)), -1)
        assert np.array_equal(matrix, matrix.T), name
        assert np.linalg.eigvalsh(matrix)[0] > 0.0, name


def test_twenty_calibrations_beside_the_fit_that_knows() -> None:
    faults, drift = CONDITIONS["everything"]
    comparisons = [compare(seed, faults, drift) for seed in range(SEEDS)]
    assert pooled(comparisons, "fit") <= 1.15 * pooled(comparisons, "oracle")
    assert pooled(comparisons, "fit_matrix") <= 1.15 * pooled(comparisons, "oracle_matrix")
    assert pooled(comparisons, "linear") > 10 * pooled(comparisons, "fit")
    assert sum(run.found for run in comparisons) >= 0.95 * sum(run.outliers for run in comparisons)
    assert sum(run.falsely for run in comparisons) <= 1


@pytest.mark.parametrize(
    ("condition", "simulations"),
    [("offset and noise", 40), ("angles of grooves", 25), ("outliers", 25), ("everything", 25)],
)
def test_intervals_hold_what_they_promise(condition: str, simulations: int) -> None:
    held = coverage(condition, simulations)
    # Two points, as for 2000 simulations, and what so few may be off by chance.
    assert 90.0 < held.matrix < 99.0
    assert 90.0 < held.force < 99.0
    assert held.false_alarm < 8.0
