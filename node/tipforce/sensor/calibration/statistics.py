"""From the solved calibration to its result (intervals, residuals by load), further terms, and where it is valid."""

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError
from tipforce.sensor.calibration.data import Model, Readings
from tipforce.sensor.calibration.distributions import f_quantile, t_quantile, variance_factors
from tipforce.sensor.calibration.regressors import at_reference
from tipforce.sensor.calibration.result import Fit, LoadResidual, Nonlinearity
from tipforce.sensor.calibration.solve import Extra, Problem, Solution, extra
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.redundancy import weighted_inverse
from tipforce.sensor.structure.plane_frame import PAPER_SLIT_M, slit_closure, worst_stress
from tipforce.sensor.structure.quality import condition_number, row_equilibrated_condition_number
from tipforce.sensor.structure.strain import Geometry

HOLD_OUT_CAP = 8.0
"""Squared distance per gauge beyond which a row counts no more against a model."""


def matrix_uncertainty(A: FloatArray, C: FloatArray, Sigma: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard uncertainty of each entry of C, (3, n), from the covariance of A, (n, 3, n, 3). First order:
    dC = -C dA C + (A^T W A)^-1 dA^T W (I - A C); the second term is zero for three gauges."""
    n = A.shape[0]
    W = np.linalg.inv(Sigma)
    inner = np.linalg.inv(A.T @ W @ A)
    J = -np.einsum("ak,jl->alkj", C, C) + np.einsum("aj,kl->alkj", inner, W @ (np.eye(n) - A @ C))
    spread: FloatArray = np.einsum("alkj,kjmi,almi->al", J, covariance, J)
    if not (spread >= -1e-9 * np.abs(spread).max()).all():
        raise np.linalg.LinAlgError("the covariance of the matrix is not positive")
    return np.sqrt(np.maximum(spread, 0.0))


def result(
    readings: Readings,
    model: Model,
    problem: Problem,
    solution: Solution,
    outlier: BoolArray,
    saturated: BoolArray,
    near_limit: BoolArray,
) -> Fit:
    """Return the Fit in SI units. Left out were rows, ``outlier`` (m,), and readings, (m, n)."""
    rows, solved = at_reference(problem.basis, solution.coefficients, solution.covariance)
    rows = rows * problem.strain
    A, (n, q) = rows[:, :3] / problem.newtons, rows.shape
    unit = np.array([1.0 / problem.newtons] * 3 + [1.0] * (q - 3)) * problem.strain
    covariance = np.zeros((n, 4, n, 4))
    covariance[:, :q, :, :q] = solved * unit[:, np.newaxis, np.newaxis] * unit
    Sigma = solution.Sigma * problem.strain**2
    # By the covariance that the record holds: from the two a node with more than three gauges gets A back.
    C = weighted_inverse(A, Sigma)
    residual = (problem.V - problem.g @ solution.coefficients.T) * problem.strain  # the groove's angle left in
    noise_dof = solution.dof if model.noise_strain is None else float("inf")
    loads = _by_load(readings, problem.observed, residual, C, solution.leverage)
    sigma0, loaded, unloaded = _sizes(problem, solution, readings.P_newtons > 0.0)
    return Fit(
        C=C, A=A, offset_strain=rows[:, 3] if q == 4 else np.zeros(n),
        C_uncertainty=matrix_uncertainty(A, C, Sigma, covariance[:, :3, :, :3]),
        coverage_factor=t_quantile(0.975, noise_dof), noise_covariance_strain2=Sigma,
        residual_covariance_strain2=_residual_covariance(problem, residual, solution.dof),
        N=_normal_matrix(problem, solution), parameter_covariance=covariance,
        sigma0=sigma0, sigma0_loaded=loaded, sigma0_unloaded=unloaded, dof=solution.dof, noise_dof=noise_dof,
        condition_number=condition_number(A), row_equilibrated_condition_number=row_equilibrated_condition_number(A),
        residual_strain=residual, distance=np.sqrt(np.maximum(solution.distance, 0.0)), leverage=solution.leverage,
        used=problem.observed, outliers=tuple(np.flatnonzero(outlier).tolist()),
        saturated=tuple((row, gauge) for row, gauge in np.argwhere(saturated).tolist()),
        near_limit=tuple((row, gauge) for row, gauge in np.argwhere(near_limit).tolist()),
        loads=loads, drift=model.drift, loss=model.loss,
        groove_scatter=float(np.sqrt(solution.scatter.groove)), hang_scatter=float(np.sqrt(solution.scatter.hang)),
        hold_out_score=_hold_out_score(problem, solution), lack_of_fit=_lack_of_fit(problem, solution, loads),
    )  # fmt: skip


def _hold_out_score(problem: Problem, solution: Solution) -> float:
    """See Fit.hold_out_score: a row that was fitted is predicted with the covariance R (R - H)^-1 R, others R + H."""
    used = problem.observed.any(axis=1)
    n = solution.R.shape[1]
    left = solution.R - solution.H + 1e-9 * solution.R
    inside = 2.0 * np.linalg.slogdet(solution.R)[1] - np.linalg.slogdet(left)[1]
    size = np.where(used, inside, np.linalg.slogdet(solution.R + solution.H)[1])
    return float(-0.5 * np.sum(size + np.minimum(solution.distance, HOLD_OUT_CAP * n)))


def _sizes(problem: Problem, solution: Solution, loaded: BoolArray) -> tuple[float, float, float]:
    counts = problem.observed.sum(axis=1)
    inverse = solution.R_inverse
    squares = np.einsum("ik,ikl,il->i", solution.residual, inverse, solution.residual)
    free = counts - solution.absorbed

    def size(rows: BoolArray) -> float:
        total = float(free[rows].sum())
        return float(np.sqrt(squares[rows].sum() / total)) if total > 0.5 else float("nan")

    used = counts > 0
    return size(used), size(used & loaded), size(used & ~loaded)


LACK_CHANCE = 0.001
"""That rows which repeat loads independently are said not to."""


def _lack_of_fit(problem: Problem, solution: Solution, loads: tuple[LoadResidual, ...]) -> float:
    """See Fit.lack_of_fit. The fit took degrees of freedom from the means of loads only: the test is cautious."""
    n, complete = problem.V.shape[1], np.asarray(problem.observed.all(axis=1))
    e = np.linalg.solve(np.linalg.cholesky(solution.R), solution.residual[..., np.newaxis])[..., 0]
    loaded = (e[[row for row in load.rows if complete[row]]] for load in loads if load.P_newtons > 0.0)
    groups = [(group, group.mean(axis=0)) for group in loaded if len(group) > 1]
    between, within = n * len(groups), n * sum(len(group) - 1 for group, _ in groups)
    if not groups:
        return 0.0
    apart = sum(len(group) * float(np.square(mean).sum()) for group, mean in groups) / between
    ratio = apart / max(sum(float(np.square(group - mean).sum()) for group, mean in groups) / within, 1e-12)
    return ratio if ratio > f_quantile(1.0 - LACK_CHANCE, between, within) else 0.0


def _residual_covariance(problem: Problem, residual: FloatArray, dof: float) -> FloatArray:
    """S: weighted squares of the residuals over the degrees of freedom, by pairs where a reading is left out."""
    counted = problem.observed.astype(np.float64)
    e = np.where(problem.observed, residual, 0.0) * np.sqrt(problem.weight)[:, np.newaxis]
    rows = np.maximum(counted.T @ counted, 1.0)
    used = float(problem.observed.any(axis=1).sum())
    S: FloatArray = (e.T @ e) / rows * used / max(dof, 0.5)
    return S


def _normal_matrix(problem: Problem, solution: Solution) -> FloatArray:
    """N for A and the offset at the last row, in newtons: the other coefficients of a drift are eliminated."""
    used, L = problem.observed.any(axis=1), problem.basis.to_reference
    g = problem.g[used] * np.sqrt(problem.weight[used])[:, np.newaxis]
    unit = np.array([problem.newtons] * 3 + [1.0] * (len(L) - 3))
    # Kinks are held towards zero; in units of noise, as the sum is, differently for each gauge: their mean.
    held = float(np.mean(np.diag(solution.Sigma) / solution.kink_variance))
    information = g.T @ g + held * np.diag(problem.kinks.astype(np.float64))
    # A prior may have stood in for loads: only then can the sum itself be singular.
    N = information if np.array_equal(L, np.eye(len(L))) else np.linalg.inv(L @ np.linalg.pinv(information) @ L.T)
    scaled: FloatArray = N * unit[:, np.newaxis] * unit
    return 0.5 * (scaled + scaled.T)


def _by_load(
    readings: Readings, observed: BoolArray, residual: FloatArray, C: FloatArray, leverage: FloatArray
) -> tuple[LoadResidual, ...]:
    """Residuals of the rows used, by load, unloaded rows first, then as they came."""
    groups: dict[tuple[float, float, float], list[int]] = {}
    given = np.stack((readings.P_newtons, readings.phi_rad, readings.theta_rad), axis=-1).tolist()
    for row in np.flatnonzero(observed.any(axis=1)).tolist():
        P, phi, theta = given[row]
        groups.setdefault((P, phi, theta) if P > 0.0 else (0.0, 0.0, 0.0), []).append(row)
    by_load = []
    for load in sorted(groups, key=lambda load: load[0] > 0.0):
        rows = groups[load]
        counted = observed[rows]
        e = np.where(counted, residual[rows], 0.0)
        counts = counted.sum(axis=0)
        some = np.maximum(counts, 1)
        mean = np.where(counts > 0, e.sum(axis=0) / some, np.nan)
        rms = np.where(counts > 0, np.sqrt(np.square(e).sum(axis=0) / some), np.nan)
        force = residual[rows][counted.all(axis=1)] @ C.T
        newtons = np.sqrt(np.square(force).mean(axis=0)) if len(force) else np.full(3, np.nan)
        by_load.append(LoadResidual(*load, tuple(rows), mean, rms, newtons, float(leverage[rows].max())))
    return tuple(by_load)


FALSE_ALARM = 0.005
"""Chance that a straight sensor is called nonlinear."""


def nonlinearity(
    problem: Problem, solution: Solution, C: FloatArray, sigma0: float, largest_newtons: float
) -> Nonlinearity | None:
    """Return the test of a quadratic term; None where the rows determine none. sigma0 above 1 widens the intervals."""
    n, A = problem.V.shape[1], solution.coefficients[:, :3]
    elastic = problem.g[:, :3] @ A.T
    trials: list[tuple[float, bool, Extra]] = []
    for odd in (False, True):
        try:
            term = extra(problem, solution, _square(elastic, odd)[:, :, np.newaxis] * np.eye(n))
            term = term._replace(covariance=term.covariance * max(1.0, sigma0 if np.isfinite(sigma0) else 1.0) ** 2)
            size = float(term.value @ np.linalg.solve(term.covariance, term.value))
        except np.linalg.LinAlgError:
            continue
        trials.append((size, odd, term))
    dof = solution.dof - 1.0
    if not trials or dof < 1.0:
        return None
    size, odd, term = max(trials, key=lambda trial: trial[0])
    stated = problem.Sigma is not None
    significant = size > n * f_quantile(1.0 - 0.5 * FALSE_ALARM, n, 1e6 if stated else dof)
    u = np.sqrt(np.diagonal(term.covariance))
    factor = t_quantile(0.975, np.inf if stated else dof)
    strain, newtons = problem.strain, problem.newtons
    relative = _relative_error(term, C * strain / newtons, odd, largest_newtons / newtons) if significant else 0.0
    return Nonlinearity(term.value / strain, factor * u / strain, odd, bool(significant), relative)


def _square(strain: FloatArray, odd: bool) -> FloatArray:
    return strain * np.abs(strain) if odd else strain * strain


def _relative_error(term: Extra, C: FloatArray, odd: bool, P: float) -> float:
    """What the linear matrix makes of a sensor with the quadratic term: RMS of the force error over the force."""
    theta, delta = np.meshgrid(np.radians(np.arange(0.0, 181.0, 15.0)), np.radians(np.arange(-60.0, 61.0, 15.0)))
    phi = (theta + delta).ravel() + np.array([[0.0], [np.pi]])
    F = force_vector(P, phi.ravel(), np.tile(theta.ravel(), 2))
    s = F @ term.coefficients[:, :3].T
    off = (s + term.value * _square(s, odd)) @ C.T - F
    along = F[:, [0, 2]] / P
    radial = np.einsum("ij,ij->i", off[:, [0, 2]], along)
    across = off[:, 0] * along[:, 1] - off[:, 2] * along[:, 0]
    return float(max(np.sqrt(np.mean(radial**2)), np.sqrt(np.mean(across**2)))) / P


CHANCE = 0.005
"""That a gain which does not depend on temperature is corrected for it."""


def reference_temperature_degC(temperature_degC: FloatArray) -> float:
    """Return the temperature that coefficients are counted from: the mean of the rows, to a hundredth of a degree."""
    return round(float(np.mean(temperature_degC)), 2)


def per_kelvin(
    problem: Problem, solution: Solution, change_K: FloatArray, columns: FloatArray, unit: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return (coefficients per kelvin beyond the fit's of ``columns``, (m or 1, n, k), times ``unit``; their standard
    uncertainties), (k,) each; zeros and NaN where no row shows them."""
    span = float(np.abs(change_K).max())
    try:
        term = extra(problem, solution, columns * (change_K / max(span, 1e-300))[:, np.newaxis, np.newaxis])
    except np.linalg.LinAlgError:
        k = columns.shape[2]
        return np.zeros(k), np.full(k, np.nan)
    return term.value * unit / span, np.sqrt(np.diagonal(term.covariance)) * unit / span


def gain_of(problem: Problem, solution: Solution, change_K: FloatArray) -> tuple[float, float]:
    """Return (gain per kelvin beyond that of the problem, its standard uncertainty); NaN where no row shows it."""
    strain = problem.g[:, :3] @ solution.coefficients[:, :3].T
    gain, u = per_kelvin(problem, solution, change_K, strain[:, :, np.newaxis])
    return float(gain[0]), float(u[0])


def offsets_of(problem: Problem, solution: Solution, change_K: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (offset per kelvin, standard uncertainty), (n,) each, strain: of the fit, or as a further column."""
    span_K, strain = problem.basis.temperature_span_K, problem.strain
    if not span_K:
        return per_kelvin(problem, solution, change_K, np.eye(problem.V.shape[1])[np.newaxis], strain)
    variance = np.einsum("kpkp->kp", solution.covariance)[:, -1]
    return solution.coefficients[:, -1] * strain / span_K, np.sqrt(variance) * strain / span_K


FALSE_ALARM_RATE = 1e-6
"""Of the redundancy check, per sample."""


def redundancy_limit(
    A: FloatArray, Sigma: FloatArray, parameter_covariance: FloatArray, dof: float, largest_newtons: float
) -> float:
    """Return the limit of chi-square (2116h) for one false alarm in a million samples; 0 for three gauges. A (n, 3),
    strain per newton; Sigma (n, n), known with ``dof`` (Hotelling); parameter_covariance (n, 4, n, 4), at the worst
    load. Raises InputError for a Sigma that is not positive definite, or dof of n - 2 or less."""
    n = len(A)
    if n == 3:
        return 0.0
    spare = n - 3
    wider = variance_factors(dof, spare)[0]
    try:
        lower = np.linalg.cholesky(Sigma)
    except np.linalg.LinAlgError:
        raise InputError("the gauges' noise covariance is not positive definite") from None
    outside = np.linalg.qr(np.linalg.solve(lower, A), mode="complete")[0][:, 3:]
    parity = np.linalg.solve(lower.T, outside)  # (n, spare): readings to independent contradictions of variance 1
    theta, delta = np.meshgrid(np.radians(np.arange(0.0, 181.0, 15.0)), np.radians(np.arange(-75.0, 76.0, 15.0)))
    F = force_vector(largest_newtons, theta + delta, theta).reshape(-1, 3)
    G = np.concatenate((np.concatenate((F, -F)), np.ones((2 * len(F), 1))), axis=1)
    kernel = np.einsum("ka,kilj,lb->abij", parity, parameter_covariance, parity)
    added = np.einsum("gi,abij,gj->gab", G, kernel, G)
    widest = float(np.linalg.eigvalsh(0.5 * (added + added.transpose(0, 2, 1)))[:, -1].max())
    dof = min(dof, 1e6)
    chance = f_quantile(1.0 - FALSE_ALARM_RATE, spare, dof - spare + 1.0)
    limit = spare * dof / (dof - spare + 1.0) * chance * (1.0 + max(widest, 0.0))
    return limit / wider


def overload_newtons(geometry: Geometry, yield_pascals: float | None = None) -> float:
    """Return the smallest load, over all contacts and directions, that closes the slit or reaches the yield stress."""
    slit = PAPER_SLIT_M / slit_closure(geometry, 1.0)
    return slit if yield_pascals is None else min(slit, yield_pascals / worst_stress(geometry, 1.0))
