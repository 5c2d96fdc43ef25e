"""Rows that a fit leaves out: suspects before it, outliers of it, and when it is the model that is wrong."""

from math import comb

import numpy as np

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.sensor.calibration.data import Readings
from tipforce.sensor.calibration.distributions import f_quantile
from tipforce.sensor.calibration.regressors import grooves
from tipforce.sensor.calibration.result import Fit
from tipforce.sensor.calibration.solve import NOISE_FLOOR, Problem, Solution

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
        beta, squares = _fitted(g, V, chosen)
        chosen = np.argsort(squares, axis=1)[:, :kept]
        if step == FIRST_STEPS:
            objective = np.take_along_axis(squares, chosen, axis=1).sum(axis=1)
            chosen = chosen[np.argsort(objective)[:BEST]]
    beta, squares = _fitted(g, V, chosen)
    objective = np.sort(squares, axis=1)[:, :kept].sum(axis=1)
    best: FloatArray = beta[int(np.argmin(objective))]
    return best


def _fitted(g: FloatArray, V: FloatArray, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
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
    groove = grooves(readings.phi_rad, readings.theta_rad)
    for number in np.unique(groove[loaded]):
        rows = loaded & (groove == number)
        first = int(np.argmax(rows))
        phi, theta = np.degrees(readings.phi_rad[first]), np.degrees(readings.theta_rad[first])
        places.append((f"at phi {phi:g}, theta {theta:g} degrees", np.asarray(rows)))
    for phi in np.unique(np.round(readings.phi_rad[loaded], 6)):
        rows = loaded & (np.abs(readings.phi_rad - phi) < 1e-6)
        places.append((f"of loads along phi {np.degrees(phi):g} degrees", np.asarray(rows)))
    return [(words, rows) for words, rows in places if 0 < rows.sum() < 0.7 * len(P)]
