"""The fit doubts its own model: grooves that stray, curvature, temperature, rows left out, rails, drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench.honesty import INVISIBLE, Rig, cells, drifting, false_alarms, row_of, verdict

from sensor.calibration.made import CLEAN, readings, simulated
from tipforce.errors import InputError
from tipforce.sensor.calibration.data import require_degrees, require_order, require_size
from tipforce.sensor.calibration.distributions import variance_factors
from tipforce.sensor.calibration.fit import Model, best_fit, fit_calibration
from tipforce.sensor.calibration.outliers import rejections
from tipforce.sensor.calibration.simulation import simulate
from tipforce.sensor.calibration.statistics import overload_newtons, redundancy_limit
from tipforce.sensor.contact.scalar_redundancy import chi_square_threshold
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import layout
from tipforce.sensor.structure.strain import strain_matrix
from tipforce_lab.report.studies.honesty import GAUGES

HALF_DEGREE = float(np.radians(0.5))
STATED = Model(phi_scatter_rad=HALF_DEGREE, theta_scatter_rad=HALF_DEGREE)


def test_weights_in_one_groove_do_not_average_its_angle_out() -> None:
    sims = [simulated(seed, replace(CLEAN, groove_scatter_rad=HALF_DEGREE)) for seed in range(12)]
    fits = [fit_calibration(readings(sim), STATED) for sim in sims]
    assert np.mean([fit.groove_scatter for fit in fits]) == pytest.approx(1.0, abs=0.15)
    assert max(fit.hang_scatter for fit in fits) < 0.25
    assert all(fit.converged for fit in fits)
    off = [(fit.C - np.linalg.inv(sim.true_A)) / fit.C_uncertainty for fit, sim in zip(fits, sims, strict=True)]
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.25)
    straight = fit_calibration(readings(simulated(0)), STATED)
    assert straight.groove_scatter < 0.6  # where grooves do not stray, the data say so


def test_a_curved_gauge_is_found_with_its_term_and_a_straight_one_is_not() -> None:
    sim = simulated(3)
    assert fit_calibration(readings(sim)).nonlinearity is not None
    elastic = sim.clean_strain - sim.true_offset_strain
    for odd, bend in ((False, elastic**2), (True, elastic * np.abs(elastic))):
        found = fit_calibration(readings(sim, strain=sim.strain + 100.0 * bend), Model(loss="none")).nonlinearity
        assert found is not None
        assert found.significant
        assert found.odd == odd
        np.testing.assert_allclose(found.per_strain, 100.0, atol=20.0)
        assert 0.005 < found.model_uncertainty < 0.2
    alarms = [fit_calibration(readings(simulated(seed))).nonlinearity for seed in range(20, 50)]
    assert sum(one is not None and one.significant for one in alarms) <= 1


def test_temperature_coefficients_are_found_where_the_rows_show_them() -> None:
    sim, rng = simulated(5), np.random.default_rng(5)
    T = rng.uniform(15.0, 35.0, len(sim.strain))
    change = (T - np.mean(T))[:, np.newaxis]
    elastic, per_K = sim.clean_strain - sim.true_offset_strain, np.array([2e-6, -3e-6, 1e-6])
    warm = sim.strain + elastic * 5e-4 * change + per_K * change
    fit, model, scores = best_fit(readings(sim, strain=warm, temperature_degC=T), Model())
    assert model.temperature
    assert len(scores) == 6
    found = fit.temperature
    assert found is not None
    assert found.offset_fitted
    assert found.gain_fitted
    assert (np.abs(found.offset_strain_per_K - per_K) < 2.0 * found.offset_half_width).all()
    assert abs(found.gain_per_K - 5e-4) < 2.0 * found.gain_half_width
    assert found.gain_half_width < 1.5e-4
    constant = fit_calibration(readings(sim, temperature_degC=np.full(len(T), 21.5))).temperature
    assert constant is not None
    assert (constant.lowest_degC, constant.highest_degC, constant.gain_fitted) == (21.5, 21.5, False)


@pytest.mark.parametrize(("drift_strain", "warm_up", "allowed"), [
    (0.0, 0.0, {"none", "linear"}), (40e-6, 0.0, {"linear", "tare"}), (60e-6, 1.0, {"tare"}),
])  # fmt: skip
def test_the_drift_is_what_predicts_left_out_rows(drift_strain: float, warm_up: float, allowed: set[str]) -> None:
    fit, model, scores = best_fit(
        readings(simulated(7, replace(CLEAN, drift_strain=drift_strain, warm_up=warm_up))), Model()
    )
    assert fit.drift == model.drift
    assert fit.drift in allowed
    assert max(scores, key=lambda name: scores[name]) == fit.drift


def test_rows_left_out_that_gather_speak_against_the_model() -> None:
    sim = simulated(8)
    assert rejections(fit_calibration(readings(sim)), readings(sim)) == []
    wrong = sim.strain.copy()
    heavy = np.flatnonzero(sim.P_newtons == 4.4)[:7]
    wrong[heavy] *= 1.2
    found = rejections(fit_calibration(readings(sim, strain=wrong)), readings(sim, strain=wrong))
    assert any("left out as outliers, over 5%" in text for text in found)
    assert any("at high load" in text for text in found)


def test_units_and_order_beside_theory() -> None:
    A = strain_matrix(FABRICATED, "I")
    require_size(1.3 * A, A, 4.0, "I")
    for factor, words in ((1e-6, "SI units"), (0.0098, "grams"), (9.8, "kilograms"), (50.0, "another unit")):
        with pytest.raises(InputError, match=words):
            require_size(factor * A, A, 4.0, "I")
    require_order(A, A, "I")
    with pytest.raises(InputError, match="SG1 and SG2 look swapped"):
        require_order(A[[1, 0, 2]], A, "I")
    sim = simulated(9)
    require_degrees(readings(sim))
    with pytest.raises(InputError, match="look like radians"):
        require_degrees(readings(sim, phi_rad=np.radians(sim.phi_rad), theta_rad=np.radians(sim.theta_rad)))


def test_the_redundancy_limit_covers_what_the_calibration_may_contradict() -> None:
    gauges = layout(["K_H", "S_H", "U", "T", "L"])
    fit = fit_calibration(readings(simulate(gauges, np.random.default_rng(1), CLEAN)))
    Sigma, n = fit.noise_covariance_strain2, 5
    known = redundancy_limit(fit.A, Sigma, np.zeros((n, 4, n, 4)), np.inf, 4.4)
    assert known == pytest.approx(chi_square_threshold(1e-6, 2), rel=1e-3)
    limit = redundancy_limit(fit.A, Sigma, fit.parameter_covariance, fit.dof, 4.4)
    assert 1.1 * known < limit < 2.5 * known
    assert redundancy_limit(fit.A[:3], Sigma[:3, :3], np.zeros((3, 4, 3, 4)), 10.0, 4.4) == 0.0
    assert overload_newtons(FABRICATED) == pytest.approx(15.19, abs=0.01)
    assert overload_newtons(FABRICATED, 200e6) < overload_newtons(FABRICATED)


def test_ok_means_ok_for_three_gauges() -> None:
    clean, rail, warm, si = cells(3, Rig(8, 2, 1), ("clean", "rail", "warm, calibrated cold", "SI units"), 6)
    assert (clean.counts["calibrations"], clean.counts["wrong"]) == (6, 0)
    assert clean.ratio("ok", "rows") > 0.98
    assert 0.85 < clean.ratio("covered", "ok") < 1.0
    assert rail.counts["ok"] == warm.counts["ok"] == 0
    assert si.refused.total() == si.counts["calibrations"] == 1
    assert row_of(si)[-1] == "good: refused"


def test_ok_means_ok_for_five_gauges() -> None:
    by_fault = {cell.fault: cell for cell in cells(5, Rig(), ("clean", "drift", "gain"), 4)}
    clean, drift, gain = (by_fault[name] for name in ("clean", "drift", "gain"))
    assert (clean.counts["wrong"], drift.counts["wrong"]) == (0, 0)
    # A tenth more of a gauge passes where the force is small: what it may do there is in the uncertainty.
    assert verdict(gain) == "good"
    assert 0.2 < gain.ratio("ok", "rows") < 0.8
    assert clean.ratio("ok", "rows") > 0.99
    assert clean.u_over_error < 1.2
    assert 0.0 < drift.ratio("ok", "rows") < 0.3
    # The layout has one gauge whose fault passes as a force; the verdict has the figure.
    hidden = next(cell for name, cell in by_fault.items() if name.endswith(INVISIBLE))
    assert hidden.shares.keys() == {"S_H"}
    assert verdict(hidden).startswith("cannot tell: of its own noise the residuals show, at least, S_H")
    samples, wrong, known = drifting(GAUGES.index("L"), 2)
    assert (samples, wrong) == (10_000, 0)
    assert known > 0.8
    assert false_alarms(5, 20_000, 0) == 0


def test_few_degrees_of_freedom_widen_the_record() -> None:
    assert variance_factors(np.inf, 2) == (1.0, 1.0)
    noise, parameters = variance_factors(6.0, 0)
    assert noise == parameters == pytest.approx((2.446912 / 1.959964) ** 2, rel=1e-5)
    # Rao: the variance stated is 8 / 10 of that with the true weights, and that of the force 9 / 7 of it.
    noise, parameters = variance_factors(10.0, 2)
    assert noise / parameters == pytest.approx(10.0 / 8.0 * 9.0 / 7.0)
    with pytest.raises(InputError, match="3 degrees of freedom for 5 gauges do not show their noise"):
        variance_factors(3.0, 2)


def test_a_noise_that_is_stated_is_not_widened() -> None:
    sim = simulate("I", np.random.default_rng(3), CLEAN)
    data = readings(sim)
    stated = fit_calibration(data, Model(noise_strain=1e-6))
    noise, parameters = stated.record_covariances
    np.testing.assert_array_equal(noise, stated.noise_covariance_strain2)
    np.testing.assert_array_equal(parameters, stated.parameter_covariance)
    free = fit_calibration(data)
    factor = (free.coverage_factor / 1.959964) ** 2
    np.testing.assert_allclose(free.record_covariances[0], factor * free.noise_covariance_strain2, rtol=1e-6)
