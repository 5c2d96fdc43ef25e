"""Calibration: readings under known loads to C, offsets and uncertainty: V = A F + b is fitted, then inverted. The rows
that it leaves out: suspects before it, outliers of it, and when they speak against the model."""

from collections.abc import Sequence
from dataclasses import replace
from math import comb, sqrt

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.sensor.calibration import regressors, statistics
from tipforce.sensor.calibration.data import Model, Readings, checked
from tipforce.sensor.calibration.distributions import f_quantile, t_quantile
from tipforce.sensor.calibration.regressors import OffsetBasis
from tipforce.sensor.calibration.result import Fit, Temperature
from tipforce.sensor.calibration.solve import NOISE_FLOOR, Problem, Solution, pick, solve
from tipforce.sensor.contact.estimate import force_vector

MARGIN = 3.0
"""Standard deviations from the converter's limit within which a reading is left out."""
MAX_PASSES, SETTLING_PASSES = 14, 6
MAX_GAIN_PASSES = 4


def fit_calibration(readings: Readings, model: Model | None = None) -> Fit:
    """Return the calibration that the readings support. Raises InputError for shapes and values (naming the row), an
    offset or direction of load that the rows do not show (and what to add), and too few rows to estimate the noise."""
    model = model or Model()
    readings = checked(readings, model)
    try:
        return _with_gain(readings, model)
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"calibration: {len(readings.P_newtons)} rows decide too little for this model ({error}): add loads and "
            "unloaded readings, or ask for less (no drift, no robust loss)"
        ) from None


def _with_gain(readings: Readings, model: Model) -> Fit:
    """Fit, and fit again with a gain that depends on temperature where the rows show one."""
    change, T = _change_K(readings), readings.temperature_degC
    gain, (fit, problem, solution) = 0.0, _fitted(readings, model, 0.0)
    if T is None:
        return fit
    low, high, n = float(T.min()), float(T.max()), readings.strain.shape[1]
    if not change.any():
        none = Temperature(low, low, high, np.zeros(n), np.full(n, np.nan), False, 0.0, float("nan"), False)
        return replace(fit, temperature=none)
    for _ in range(MAX_GAIN_PASSES):
        more, u = statistics.gain_of(problem, solution, change)
        significant = abs(gain + more) > u * t_quantile(1.0 - 0.5 * statistics.CHANCE, max(fit.dof, 1.0))
        if not significant or abs(more) < 0.01 * u:
            break
        gain += more
        fit, problem, solution = _fitted(readings, model, gain)
    offsets, u_offsets = statistics.offsets_of(problem, solution, change)
    k = t_quantile(0.975, max(fit.dof, 1.0))
    shown = Temperature(
        statistics.reference_temperature_degC(T), low, high, offsets, k * u_offsets, model.temperature,
        gain or more, k * u, gain != 0.0,
    )  # fmt: skip
    return replace(fit, temperature=shown)


def _fitted(readings: Readings, model: Model, gain_per_K: float) -> tuple[Fit, Problem, Solution]:
    """Fit, leave out what is odd or clipped, and fit again until nothing changes."""
    whole = _problem(readings, model, gain_per_K)
    V, n = whole.V, readings.strain.shape[1]
    limit = np.inf if model.saturation_strain is None else np.asarray(model.saturation_strain) / whole.strain
    corner = sqrt(n * f_quantile(0.99, n, 1e6))  # where the robust loss bends: the 99 % point of good rows
    saturated = np.abs(V) >= limit
    near, robust = np.zeros_like(saturated), model.loss != "none"
    outlier = _suspected(readings, model, _problem(readings, model, 0.0)._replace(observed=~saturated))
    solution: Solution | None = None
    settled = False
    for count in range(MAX_PASSES):
        counted = ~(saturated | near)
        keep = ~outlier if robust else np.ones_like(outlier)
        problem = pick(_with_offset(whole._replace(observed=counted), readings, model, keep), keep)
        g, observed = problem.g[:, ~problem.kinks], problem.observed
        if problem.prior_information.any():
            g = np.concatenate((g, np.eye(3, g.shape[1])))
            observed = np.concatenate((observed, np.ones((3, n), dtype=np.bool_)))
        regressors.require_seen(g, observed, (*regressors.FORCES, *problem.basis.names), problem.newtons)
        solution = solve(problem, model.loss, corner, solution)
        at_reference = regressors.at_reference(problem.basis, solution.coefficients, solution.covariance)
        regressors.require_clear(*at_reference, (*regressors.FORCES, "offset"), problem.newtons)
        before, near_before = outlier, near
        outlier = outlying(problem, solution, counted)
        # A tare that is odd beside its loads yet fits between its neighbours comes and goes: it is kept.
        outlier = outlier & before if count >= SETTLING_PASSES else outlier
        spread = np.sqrt(np.diagonal(solution.R, axis1=1, axis2=2))
        near = ~saturated & (np.abs(V - solution.residual) + MARGIN * spread >= limit)
        near = near | near_before if count >= SETTLING_PASSES else near
        settled = np.array_equal(near, near_before) and (np.array_equal(outlier, before) or not robust)
        if settled:
            break
    assert solution is not None
    fit = statistics.result(readings, model, problem, solution, outlier, saturated, near)
    largest = float(readings.P_newtons.max())
    straight = statistics.nonlinearity(problem, solution, fit.C, fit.sigma0, largest)
    if straight is not None and not straight.significant and outlier.any():
        # A fault that grows with the load is first thrown out as outliers: those rows have a say, too.
        other = statistics.nonlinearity(problem._replace(observed=counted), solution, fit.C, fit.sigma0, largest)
        straight = other if other is not None and rejections(fit, readings) else straight
    return replace(fit, nonlinearity=straight, converged=solution.converged and settled), problem, solution


def linear_fit(strain: npt.ArrayLike, F_newtons: npt.ArrayLike) -> FloatArray:
    """Return the paper's fit, for comparison: C (3, n) by least squares of F = C V. strain: (m, n); F: (m, 3). Raises
    InputError for other shapes, numbers that are not finite, or readings of rank below 3."""
    V, F = floats("strain", strain), floats("F", F_newtons)
    if V.ndim != 2 or F.shape != (V.shape[0], 3) or not np.isfinite(V).all() or not np.isfinite(F).all():
        raise InputError(f"strain {V.shape}, F {F.shape}: allowed are (m, n) and (m, 3), finite")
    C, _, rank, _ = np.linalg.lstsq(V, F, rcond=None)
    if rank < 3:
        raise InputError(
            f"the readings have rank {rank}: allowed are readings of loads in three independent directions"
        )
    return np.asarray(C.T, dtype=np.float64)


def _suspected(readings: Readings, model: Model, problem: Problem) -> BoolArray:
    out = np.zeros(len(problem.V), dtype=np.bool_)
    if model.loss == "none":
        return out
    usable: BoolArray = np.asarray(problem.observed.all(axis=1))
    unloaded = readings.P_newtons == 0.0
    if model.drift == "tare" and readings.t_s is not None:
        out = regressors.bad_tares(readings.strain, readings.t_s, unloaded, usable)
    problem = pick(_with_offset(problem, readings, model, ~out), ~out)
    if model.drift == "tare":
        # Small random subsets cannot carry a drift of many knots: the tares take it off beforehand.
        tares = np.flatnonzero(unloaded & usable & ~out)
        times = np.asarray(readings.t_s, dtype=np.float64)
        lines = [np.interp(times, times[tares], V) for V in problem.V[tares].T]
        problem = problem._replace(V=problem.V - np.stack(lines, axis=-1), g=problem.g[:, :3])
    return out | suspects(problem)


def _with_offset(problem: Problem, readings: Readings, model: Model, keep: BoolArray) -> Problem:
    usable, unloaded = keep & problem.observed.all(axis=1), readings.P_newtons == 0.0
    basis = regressors.offset_basis(model.drift, model.offset, readings.t_s, unloaded, usable)
    basis = basis.with_temperature(_change_K(readings)) if model.temperature else basis
    return problem._replace(g=np.concatenate((problem.g, basis.columns), axis=1), basis=basis)


def _change_K(readings: Readings) -> FloatArray:
    T = readings.temperature_degC
    return np.zeros(len(readings.P_newtons)) if T is None else T - statistics.reference_temperature_degC(T)


def _problem(readings: Readings, model: Model, gain_per_K: float) -> Problem:
    """The problem of all readings without an offset, in units of their root mean squares."""
    m, n = readings.strain.shape
    newtons = float(np.sqrt(np.mean(np.square(readings.P_newtons[readings.P_newtons > 0.0]))))
    strain = float(np.sqrt(np.mean(np.square(readings.strain)))) or 1.0
    load = readings.P_newtons * (1.0 + gain_per_K * _change_K(readings)), readings.phi_rad, readings.theta_rad
    Sigma, mean, information = None, np.zeros((n, 3)), np.zeros(n)
    if model.noise_strain is not None:
        Sigma = np.diag(np.broadcast_to((np.asarray(model.noise_strain) / strain) ** 2, n))
    if model.prior is not None:
        mean = np.asarray(model.prior.A, dtype=np.float64) * newtons / strain
        information = 1.0 / (model.prior.relative_scatter**2 * np.mean(np.square(mean), axis=1))
    return Problem(
        V=readings.strain / strain, g=force_vector(*load) / newtons, basis=OffsetBasis.of(np.zeros((m, 0))),
        D=regressors.direction_scatter(*load, model.phi_scatter_rad, model.theta_scatter_rad) / newtons,
        groove=regressors.grooves(readings.phi_rad, readings.theta_rad),
        weight=np.ones(m) if readings.weight is None else readings.weight,
        observed=np.ones((m, n), dtype=np.bool_), Sigma=Sigma, prior_mean=mean, prior_information=information,
        strain=strain, newtons=newtons,
    )  # fmt: skip


FALSE_ALARM = 0.01
"""Chance that a fit without any outlier names one."""
KEPT_SHARE = 0.75
TRIALS, BEST, FIRST_STEPS, LAST_STEPS = 300, 8, 2, 12


def squared_cuts(m: int, count: int, dof: FloatArray) -> FloatArray:
    """Return the squared distance beyond which a row with ``count`` readings is an outlier: F, m rows together."""
    able = dof > count + 1.5
    if not able.any():
        return np.full(dof.shape, np.inf)
    # Smooth in 1 / dof: a few exact points serve any number of rows.
    inverse = np.unique(np.linspace(1.0 / dof[able].max(), 1.0 / dof[able].min(), 6))
    chance = 1.0 - FALSE_ALARM / m
    exact = [count * nu / (nu - count + 1) * f_quantile(chance, count, nu - count + 1) for nu in 1.0 / inverse]
    cuts = np.exp(np.interp(1.0 / dof, inverse, np.log(exact)))
    return np.where(able, cuts, np.inf)


def outlying(problem: Problem, solution: Solution, judged: BoolArray) -> BoolArray:
    """Return which rows are outliers of a fit, (m,), those left out too. judged: (m, n), the readings that count."""
    counts = judged.sum(axis=1)
    used = problem.observed.any(axis=1)
    dof = noise_dof(problem, solution)
    # The row's own residual has widened the noise that it is judged by: undo it.
    own = solution.distance * (1.0 - 1.0 / dof) / (1.0 - np.minimum(solution.distance / dof, 0.9))
    distance = np.where(used, own, solution.distance)
    # A row that alone carries a coefficient fits itself: nothing can be said of it.
    fair = (counts > 0) & ~(used & (solution.leverage > 0.999))
    outlier = np.zeros(len(counts), dtype=np.bool_)
    for count in np.unique(counts[fair]):
        rows = fair & (counts == count)
        outlier[rows] = distance[rows] > squared_cuts(len(counts), int(count), dof[rows])
    return outlier


def noise_dof(problem: Problem, solution: Solution) -> FloatArray:
    """Return the degrees of freedom of each row's noise, (m,), at least 2 (Satterthwaite)."""
    if problem.Sigma is not None:
        return np.full(len(solution.R), 1e6)
    inverse = solution.R_inverse
    noise = solution.Sigma / problem.weight[:, np.newaxis, np.newaxis]
    free = noise @ inverse @ (solution.R - solution.H) @ inverse
    total = float(np.einsum("ikl,ilk->", free, free)) / problem.V.shape[1]
    share = np.einsum("ikl,ilk->i", noise, np.linalg.inv(solution.R)) / problem.V.shape[1]
    dof: FloatArray = np.maximum(total / np.square(share), 2.0)
    return dof


def suspects(problem: Problem) -> BoolArray:
    """Return which complete rows least trimmed squares finds too far off, (m,); none where too few are left to trim."""
    (m, n), p = problem.V.shape, problem.g.shape[1]
    none = np.zeros(m, dtype=np.bool_)
    rows = np.flatnonzero(problem.observed.all(axis=1))
    kept = int(np.ceil(KEPT_SHARE * rows.size))
    if kept < 2 * p + 2:
        return none
    g, V = problem.g[rows], problem.V[rows]
    beta = _least_trimmed(g, V, kept)
    e = V - g @ beta
    size = np.square(e).sum(axis=1)
    # A row that is the mean of many readings lies closer: residuals are compared as those of single readings.
    core = (e * np.sqrt(problem.weight[rows])[:, np.newaxis])[np.argsort(size)[:kept]]
    # 1.6: a trimmed quarter hides that much of the variance of three gauges.
    Sigma = 1.6 * core.T @ core / (kept - p) + NOISE_FLOOR**2 * np.eye(n)
    AD = beta[:3].T @ problem.D[rows]
    R = Sigma / problem.weight[rows, np.newaxis, np.newaxis] + AD @ AD.transpose(0, 2, 1)
    distance = np.einsum("ik,ik->i", e, np.linalg.solve(R, e[..., np.newaxis])[..., 0])
    none[rows] = distance > squared_cuts(rows.size, n, np.full(rows.size, float(kept - p)))
    return none


def _least_trimmed(g: FloatArray, V: FloatArray, kept: int) -> FloatArray:
    """Coefficients (p, n) of the ``kept`` rows that agree best: many small random subsets, then concentration."""
    rng = np.random.default_rng(0)
    m, p = g.shape
    size = min(p + 2, m)
    chosen = np.argsort(rng.random((TRIALS, m)), axis=1)[:, :size]
    for step in range(FIRST_STEPS + LAST_STEPS):
        beta, squares = _subset_fits(g, V, chosen)
        chosen = np.argsort(squares, axis=1)[:, :kept]
        if step == FIRST_STEPS:
            objective = np.take_along_axis(squares, chosen, axis=1).sum(axis=1)
            chosen = chosen[np.argsort(objective)[:BEST]]
    beta, squares = _subset_fits(g, V, chosen)
    objective = np.sort(squares, axis=1)[:, :kept].sum(axis=1)
    best: FloatArray = beta[int(np.argmin(objective))]
    return best


def _subset_fits(g: FloatArray, V: FloatArray, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
    """Least squares on each subset of rows: coefficients (T, p, n), squared residuals of every row (T, m)."""
    sub, p = g[chosen], g.shape[1]
    normal = sub.transpose(0, 2, 1) @ sub + 1e-9 * np.eye(p)
    beta: FloatArray = np.asarray(np.linalg.solve(normal, sub.transpose(0, 2, 1) @ V[chosen]), dtype=np.float64)
    squares: FloatArray = np.square(V - g @ beta).sum(axis=2)
    return beta, squares


LARGEST_SHARE = 0.05
CHANCE = 0.01
"""That rows left out by chance gather as much as these; for all places together."""


def rejections(fit: Fit, readings: Readings) -> list[str]:
    """Return why the rows left out as outliers speak against the model; empty where they do not."""
    m = len(readings.P_newtons)
    out = np.zeros(m, dtype=np.bool_)
    out[list(fit.outliers)] = True
    reasons = []
    if out.sum() > LARGEST_SHARE * m:
        reasons.append(
            f"{int(out.sum())} of {m} rows ({100.0 * out.mean():.0f} %) are left out as outliers, over "
            f"{LARGEST_SHARE:.0%}: loads, times or the model (--drift, --angle-scatter, --saturation) are wrong"
        )
    places = _places(readings)
    for words, rows in places:
        here, count, left_out = int((out & rows).sum()), int(rows.sum()), int(out.sum())
        # Hypergeometric: the chance that at least so many of the rows left out fall on these.
        ways = sum(comb(count, k) * comb(m - count, left_out - k) for k in range(here, min(left_out, count) + 1))
        if here >= 3 and ways / comb(m, left_out) < CHANCE / len(places):
            reasons.append(
                f"{here} of the {left_out} rows left out are {words} ({count} of {m} rows): a fault that depends "
                "on it is no outlier"
            )
    return reasons


def _places(readings: Readings) -> list[tuple[str, BoolArray]]:
    """Where rows may gather: high loads, warm or cold ones, one direction."""
    P = readings.P_newtons
    loaded = P > 0.0
    high = np.median(P[loaded]) < P if (P[loaded] > np.median(P[loaded])).any() else P.max() <= P
    places = [("at high load", np.asarray(high & loaded))]
    T = readings.temperature_degC
    if T is not None and np.ptp(T) > 1.0:
        third = T.min() + np.ptp(T) / 3.0
        places += [("warm", np.asarray(third + np.ptp(T) / 3.0 < T)), ("cold", np.asarray(third > T))]
    groove = regressors.grooves(readings.phi_rad, readings.theta_rad)
    for number in np.unique(groove[loaded]):
        rows = loaded & (groove == number)
        first = int(np.argmax(rows))
        phi, theta = np.degrees(readings.phi_rad[first]), np.degrees(readings.theta_rad[first])
        places.append((f"at phi {phi:g}, theta {theta:g} degrees", np.asarray(rows)))
    for phi in np.unique(np.round(readings.phi_rad[loaded], 6)):
        rows = loaded & (np.abs(readings.phi_rad - phi) < 1e-6)
        places.append((f"of loads along phi {np.degrees(phi):g} degrees", np.asarray(rows)))
    return [(words, rows) for words, rows in places if 0 < rows.sum() < 0.7 * len(P)]


SMALLEST_SPAN_K = 0.5
"""Change of temperature below which its effect on the offsets is not asked for."""


def best_fit(
    readings: Readings, model: Model, drifts: Sequence[str] | None = None
) -> tuple[Fit, Model, dict[str, float]]:
    """Return the fit of the drift with the best hold-out score, its model, and the scores by name. drifts: by default
    what the times allow, each also with a coefficient of temperatures that change. Raises as fit_calibration()."""
    fits: dict[str, tuple[Fit, Model]] = {}
    refused: InputError | None = None
    T, t = readings.temperature_degC, readings.t_s
    if drifts is None:
        drifts, timed = ["none"], t is not None and model.offset
        drifts += ["linear"] if timed and np.ptp(t) > 0.0 else []  # type: ignore[arg-type]
        tares = np.asarray(readings.P_newtons) == 0.0
        drifts += ["tare"] if timed and len(regressors.tare_groups(tares, np.ones_like(tares))) > 2 else []
    warms = model.offset and T is not None and np.isfinite(T).all() and np.ptp(T) >= SMALLEST_SPAN_K
    for drift in drifts:
        for warm in (False, True) if warms else (False,):
            tried = replace(model, drift=drift, temperature=warm)  # type: ignore[arg-type]
            try:
                fits[f"{drift} and temperature" if warm else drift] = fit_calibration(readings, tried), tried
            except InputError as error:
                refused = refused or error
    if refused is not None and drifts[0] not in fits:
        raise refused
    best = max(fits, key=lambda name: fits[name][0].hold_out_score)
    return *fits[best], {name: fit.hold_out_score for name, (fit, _) in fits.items()}
