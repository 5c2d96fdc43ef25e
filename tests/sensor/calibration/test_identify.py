"""What the data cannot show is refused by name; the fit doubts its own model: grooves, curvature, drift, rails."""

import re
from dataclasses import replace

import numpy as np
import pytest
from bench.honesty import INVISIBLE, Rig, cells, drifting, false_alarms, row_of, verdict

from sensor.calibration.made import CLEAN, readings, simulated
from tipforce.errors import InputError
from tipforce.sensor import FABRICATED, Fit, force_vector, layout, strain_matrix
from tipforce.sensor.calibration.data import Model, Readings, require_degrees, require_order, require_size
from tipforce.sensor.calibration.distributions import f_quantile, t_quantile, variance_factors
from tipforce.sensor.calibration.fit import best_fit, fit_calibration, rejections
from tipforce.sensor.calibration.regressors import MOST_KNOTS, offset_basis
from tipforce.sensor.calibration.simulation import paper_grooves, simulate
from tipforce.sensor.calibration.statistics import overload_newtons, redundancy_limit
from tipforce.sensor.contact.scalar_redundancy import chi_square_threshold
from tipforce_lab.report.studies.honesty import GAUGES

A = strain_matrix(FABRICATED, "I")
QUADRANT = [(0, theta) for theta in (5, 15, 30, 45, 60)] + [(90, theta) for theta in (30, 45, 60, 75, 90)]
TARE = [(0.0, 0, 0)]
NEARLY_EQUAL = [(4.4 + 0.001 * (k % 3), phi, theta) for k, (phi, theta) in enumerate(QUADRANT * 2)]
HALF_DEGREE = float(np.radians(0.5))
STATED = Model(phi_scatter_rad=HALF_DEGREE, theta_scatter_rad=HALF_DEGREE)


def fitted(rows: list[tuple[float, int, int]], model: Model | None = None) -> Fit:
    """Fit of readings with 1 microstrain of noise and 20 of offset; rows of (P, phi, theta) in degrees."""
    P, phi, theta = np.array(rows, dtype=np.float64).T
    load = P, np.radians(phi), np.radians(theta)
    noise = 1e-6 * np.random.default_rng(0).normal(size=(len(P), 3))
    V = force_vector(*load) @ A.T + 20e-6
    return fit_calibration(Readings(V + noise, *load, t_s=np.arange(len(P), dtype=np.float64)), model)


def one_weight(places: list[tuple[int, int]], P: float = 4.4) -> list[tuple[float, int, int]]:
    return [(P, phi, theta) for phi, theta in places]


def test_the_papers_range_cannot_show_an_offset() -> None:
    with pytest.raises(InputError) as caught:
        fitted(one_weight(QUADRANT * 2))
    text = str(caught.value)
    assert "cannot show 1 of the 4 unknowns" in text
    assert "F1 + F3 is 4.4 N in every row, so that an offset cannot be told" in text
    assert "add tare rows (unloaded readings), or loads with another F1 + F3" in text
    assert "beyond theta = 90 degrees" in text
    assert float(re.findall(r"singular values [^)]*?([\d.e-]+)\)", text)[0]) < 1e-10


@pytest.mark.parametrize(
    "more",
    [TARE, one_weight([(180, 120)]), one_weight([(0, 30)], 2.2)],
    ids=["a tare", "an x-groove beyond 90 degrees", "another weight"],
)
def test_what_the_message_asks_for_helps(more: list[tuple[float, int, int]]) -> None:
    np.testing.assert_allclose(fitted(one_weight(QUADRANT * 2) + more).offset_strain, 20e-6, atol=5e-6)


def test_all_19_grooves_show_an_offset_with_one_weight() -> None:
    grooves = paper_grooves()
    places = np.degrees(np.stack((grooves.phi_rad, grooves.theta_rad), axis=-1)).round().astype(int)
    fit = fitted([(4.4, phi, theta) for phi, theta in places.tolist()])
    np.testing.assert_allclose(fit.offset_strain, 20e-6, atol=2e-6)


def test_without_an_offset_the_papers_range_is_enough() -> None:
    assert fitted(one_weight(QUADRANT), Model(offset=False)).N.shape == (3, 3)


@pytest.mark.parametrize(
    ("rows", "model", "text"),
    [
        ([*one_weight([(90, theta) for theta in range(30, 151, 15)]), *TARE], None, "F3 is 0 N in every row"),
        (
            [(P, 0, 45) for P in (1.0, 2.0, 3.0, 4.0, 0.0)],
            None,
            "cannot show 2 .* F2 \\+ 0.707 F3 is 0 N in every row: .*; F1 is 0 N",
        ),
        ([(P, 0, 0) for P in (1.0, 2.0, 4.0, 0.0)], None, "F1 is 0 N in every row"),
        (one_weight([(0, 45), (90, 45), (90, 90)]), None, r"cannot show 1 .*\(3 rows"),
        ([*one_weight([(0, 45), (90, 45), (90, 90)]), *TARE], None, "leave no residuals .* state the gauge noise"),
        (one_weight(QUADRANT * 2), Model(drift="linear"), "F1 \\+ F3 is 4.4 N"),
        ([*one_weight(QUADRANT), *TARE], Model(drift="tare"), "at two times at least, .* there are 1"),
        (NEARLY_EQUAL, None, r"lost in the noise .*F1 \+ F3 is about 4.401 N"),
        ([*one_weight(QUADRANT), *TARE, *TARE], Model(saturation_strain=np.array([1.0, 1.0, 1e-6])), "for SG3"),
    ],
)
def test_each_direction_has_its_words(rows: list[tuple[float, int, int]], model: Model | None, text: str) -> None:
    with pytest.raises(InputError, match=text):
        fitted(rows, model)


def test_stated_noise_makes_up_for_missing_residuals() -> None:
    fit = fitted([*one_weight([(0, 45), (90, 45), (90, 90)]), *TARE], Model(noise_strain=1e-6))
    assert fit.dof == pytest.approx(0.0, abs=1e-6)
    assert fit.coverage_factor == pytest.approx(1.96, abs=1e-3)
    assert np.isnan(fit.sigma0)


def test_no_times_no_drift() -> None:
    P, phi, theta = np.ones(3), np.zeros(3), np.zeros(3)
    with pytest.raises(InputError, match="column t_s"):
        fit_calibration(Readings(np.ones((3, 3)), P, phi, theta), Model(drift="tare", saturation_strain=np.inf))
    model = Model(drift="linear", saturation_strain=np.inf)
    with pytest.raises(InputError, match="every row has t_s = 5"):
        fit_calibration(Readings(np.ones((3, 3)), P, phi, theta, np.full(3, 5.0)), model)


@pytest.mark.parametrize("dof", [1.0, 2.0, 5.5, 30.0, 1000.0])
def test_quantiles_are_scipys(dof: float) -> None:
    stats = pytest.importorskip("scipy.stats")
    for probability in (0.6, 0.975, 0.9999):
        assert t_quantile(probability, dof) == pytest.approx(stats.t.ppf(probability, dof), rel=1e-8)
        for count in (1.0, 3.0, 8.0):
            assert f_quantile(probability, count, dof) == pytest.approx(stats.f.ppf(probability, count, dof), rel=1e-8)
    assert t_quantile(0.975, np.inf) == pytest.approx(1.959964, abs=1e-6)


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
    elastic = force_vector(sim.P_newtons, sim.phi_rad, sim.theta_rad) @ sim.true_A.T
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
    elastic = force_vector(sim.P_newtons, sim.phi_rad, sim.theta_rad) @ sim.true_A.T
    per_K = np.array([2e-6, -3e-6, 1e-6])
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


def test_copies_and_samples_of_one_hang_are_no_independent_rows() -> None:
    hung = replace(CLEAN, hang_scatter_rad=HALF_DEGREE)
    again = simulate("I", np.random.default_rng(3), hung, (1.1, 1.1, 1.1, 4.4, 4.4))
    assert fit_calibration(readings(again), STATED).lack_of_fit == 0.0
    once = readings(simulated(3, hung))
    rows = np.arange(77).repeat(3)
    copies = {name: getattr(once, name)[rows] for name in ("strain", "P_newtons", "phi_rad", "theta_rad")}
    assert fit_calibration(Readings(**copies), STATED).lack_of_fit > 1e6
    samples = copies["strain"] + 1e-6 * np.random.default_rng(4).normal(size=(len(rows), 3))
    assert 2.0 < fit_calibration(Readings(**{**copies, "strain": samples}), STATED).lack_of_fit < 100.0


def test_more_tares_than_a_drift_has_knots() -> None:
    """A fit grows with their cube: 1000 would need hours."""
    t, unloaded = np.arange(2001.0), np.arange(2001) % 2 == 0
    basis = offset_basis("tare", True, t, unloaded, np.ones(2001, dtype=np.bool_))
    assert basis.columns.shape == (2001, MOST_KNOTS)
    drift = np.interp(t, (0.0, 700.0, 2000.0), (0.0, 5.0, -3.0))
    found = basis.columns @ np.linalg.lstsq(basis.columns, drift, rcond=None)[0]
    np.testing.assert_allclose(found, drift, atol=0.05)


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
    data = readings(simulate("I", np.random.default_rng(3), CLEAN))
    stated = fit_calibration(data, Model(noise_strain=1e-6))
    noise, parameters = stated.record_covariances
    np.testing.assert_array_equal(noise, stated.noise_covariance_strain2)
    np.testing.assert_array_equal(parameters, stated.parameter_covariance)
    free = fit_calibration(data)
    factor = (free.coverage_factor / 1.959964) ** 2
    np.testing.assert_allclose(free.record_covariances[0], factor * free.noise_covariance_strain2, rtol=1e-6)
