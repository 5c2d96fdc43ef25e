"""Generalised least squares for V = A F + b with noise that differs from row to row, its variances estimated (REML)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError

NOISE_FLOOR = 1e-7
"""Smallest standard deviation of the gauges, as a fraction of the readings: keeps exact data invertible."""
START_RESTLESS, SMALLEST_RESTLESS = 0.05, 1e-5
"""Standard deviation of a drift's kinks, as a fraction of the readings: to begin with, and at least."""
MAX_STEPS = 300
TOLERANCE = 1e-5
"""Relative change of A at which the steps end; 1e-3 of the noise, of which a few per cent do not matter."""


class Problem(NamedTuple):
    """Rows of one calibration, scaled so that readings and loads are near one; m rows, n gauges, p unknowns each."""

    V: FloatArray
    """(m, n)."""
    g: FloatArray
    """(m, p): F1, F2, F3, then the columns of the offset."""
    D: FloatArray
    """(m, 3, 2): D D^T is the covariance of F from uncertain load directions."""
    weight: FloatArray
    """(m,): the gauge noise of a row is Sigma / weight."""
    observed: BoolArray
    """(m, n): False where a reading is left out (saturated, or its row an outlier)."""
    Sigma: FloatArray | None
    """Gauge noise (n, n) where it is stated; None to estimate it."""
    prior_mean: FloatArray
    """(n, 3)."""
    prior_information: FloatArray
    """(n,): one over the variance of each entry of a row of A; zero without a prior."""
    kinks: BoolArray
    """(p,): coefficients around zero, of a variance that is estimated for each gauge: the restlessness of its drift."""


class Solution(NamedTuple):
    """What solve() found."""

    coefficients: FloatArray
    """(n, p)."""
    covariance: FloatArray
    """(n, p, n, p)."""
    Sigma: FloatArray
    """Gauge noise, (n, n), for a row of weight one."""
    kink_variance: FloatArray
    """(n,)."""
    residual: FloatArray
    """(m, n), of every row, used or not."""
    R: FloatArray
    """(m, n, n): the covariance of each row's noise."""
    H: FloatArray
    """(m, n, n): the covariance of each row's fitted value."""
    distance: FloatArray
    """(m,): squared Mahalanobis distance of each row, by the fit without that row."""
    leverage: FloatArray
    """(m,): share of a row in its own fitted value, 0 to 1; 0 for a row that is not used."""
    dof: float
    """Rows less unknowns, per gauge; fractional with a prior or with readings left out."""


def solve(problem: Problem, loss: str, cut: float, start: Solution | None = None) -> Solution:
    """Return the fit. loss: "huber", "soft_l1" or "none", with its corner at the distance ``cut``.

    start: a solution of nearly the same problem, to begin from. Raises InputError where the noise is to be
    estimated and nothing is left to estimate it from.
    """
    A, Sigma = _start(problem) if start is None else (start.coefficients[:, :3], start.Sigma)
    restless = np.full(len(A), START_RESTLESS**2) if start is None else start.kink_variance
    u = np.ones(len(problem.V))
    for _ in range(MAX_STEPS):
        found = _step(problem, A, Sigma, restless, u)
        change = np.abs(found.coefficients[:, :3] - A).max() / max(np.abs(A).max(), 1e-300)
        A = found.coefficients[:, :3]
        weights = _loss_weights(found.distance, loss, cut)
        change = max(change, 0.01 * float(np.abs(weights - u).max()))
        u = weights
        restless = _kink_variance(problem, found)
        if problem.Sigma is None:
            if found.dof < 0.5:
                raise InputError(
                    f"{int(problem.observed.any(axis=1).sum())} rows for {problem.g.shape[1]} unknowns of each gauge "
                    "leave no residuals to estimate the noise from: add rows, or state the gauge noise"
                )
            Sigma, moved = _longer(Sigma, _noise(problem, found)), Sigma
            change = max(change, 0.01 * float(np.abs(Sigma - moved).max() / np.abs(Sigma).max()))
        if change < TOLERANCE:
            break
    return found


def pick(problem: Problem, rows: BoolArray) -> Problem:
    """Return the problem with the readings of the other rows left out."""
    return problem._replace(observed=problem.observed & rows[:, np.newaxis])


def _start(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Ordinary least squares per gauge, and a first noise covariance (diagonal)."""
    n = problem.V.shape[1]
    A, variance = np.zeros((n, 3)), np.zeros(n)
    root = np.sqrt(problem.weight)
    for k in range(n):
        rows = problem.observed[:, k]
        g, V = problem.g[rows] * root[rows, np.newaxis], problem.V[rows, k] * root[rows]
        pull = np.sqrt(problem.prior_information[k]) * np.eye(3, g.shape[1])
        beta = np.linalg.lstsq(np.vstack((g, pull)), np.concatenate((V, pull[:, :3] @ problem.prior_mean[k])))[0]
        A[k], variance[k] = beta[:3], np.mean((V - g @ beta) ** 2) if rows.any() else 0.0
    if problem.Sigma is not None:
        return A, problem.Sigma
    return A, np.diag(np.maximum(variance, NOISE_FLOOR**2))


def _step(problem: Problem, A: FloatArray, Sigma: FloatArray, restless: FloatArray, u: FloatArray) -> Solution:
    m, n = problem.V.shape
    p = problem.g.shape[1]
    AD = A @ problem.D
    R = Sigma / problem.weight[:, np.newaxis, np.newaxis] + AD @ AD.transpose(0, 2, 1)
    inverse = observed_inverse(R, problem.observed)
    gg = (problem.g[:, :, np.newaxis] * problem.g[:, np.newaxis, :]).reshape(m, p * p)
    W = (u[:, np.newaxis, np.newaxis] * inverse).reshape(m, n * n)
    information = _ordered(W.T @ gg, n, p)
    right = np.einsum("ikl,il,ip->kp", W.reshape(m, n, n), problem.V, problem.g)
    prior = np.zeros((n, p))
    prior[:, :3] = problem.prior_information[:, np.newaxis]
    prior[:, problem.kinks] = 1.0 / restless[:, np.newaxis]
    information += np.diag(prior.ravel())
    right[:, :3] += prior[:, :3] * problem.prior_mean
    inner: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
    beta = (inner @ right.ravel()).reshape(n, p)
    covariance = inner
    if (u < 1.0).any():
        spread = _ordered((u[:, np.newaxis] * W).T @ gg, n, p) + np.diag(prior.ravel())
        covariance = inner @ spread @ inner
    blocks: FloatArray = covariance.reshape(n, p, n, p)
    H = (gg @ blocks.transpose(1, 3, 0, 2).reshape(p * p, n * n)).reshape(m, n, n)
    residual = problem.V - problem.g @ beta.T
    distance, leverage, dof = _judged(residual, problem.observed, R, inverse, H)
    return Solution(beta, blocks, Sigma, restless, residual, R, H, distance, leverage, dof)


def _ordered(products: FloatArray, n: int, p: int) -> FloatArray:
    """(n n, p p) to (n p, n p)."""
    return products.reshape(n, n, p, p).transpose(0, 2, 1, 3).reshape(n * p, n * p)


def observed_inverse(R: FloatArray, observed: BoolArray) -> FloatArray:
    """Return the inverse of each row's covariance (m, n, n) over the readings that count, zero elsewhere."""
    both = observed[:, :, np.newaxis] & observed[:, np.newaxis, :]
    inverse: FloatArray = np.linalg.inv(np.where(both, R, np.eye(R.shape[1])))
    return np.where(both, inverse, 0.0)


def _judged(
    residual: FloatArray, observed: BoolArray, R: FloatArray, inverse: FloatArray, H: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Squared distances by the fit without the row, leverages, degrees of freedom per gauge."""
    counts = observed.sum(axis=1)
    used = counts > 0
    share = np.einsum("ikl,ilk->i", inverse, H)
    leverage = np.clip(share / np.maximum(counts, 1), 0.0, 1.0)
    # The residual of a row that was fitted has the covariance R - H, direction by direction; one that was not, R + H.
    # In units of R, so that a direction in which the row alone decides (R = H) gives 0 / tiny, not 0 / 0.
    root = np.linalg.cholesky(np.where(np.eye(R.shape[1], dtype=np.bool_), inverse + (inverse == 0.0), inverse))
    e = np.where(observed | ~used[:, np.newaxis], residual, 0.0)
    taken = root.transpose(0, 2, 1) @ H @ root
    left = (1.0 + 1e-9) * np.eye(R.shape[1]) - taken
    whitened = (root.transpose(0, 2, 1) @ e[..., np.newaxis])[..., 0]
    inside = np.einsum("ik,ik->i", whitened, np.linalg.solve(left, whitened[..., np.newaxis])[..., 0])
    outside = np.einsum("ik,ik->i", residual, np.linalg.solve(R + H, residual[..., np.newaxis])[..., 0])
    dof = float((counts.sum() - share.sum()) / residual.shape[1])
    return np.where(used, np.maximum(inside, 0.0), outside), leverage, dof


def _kink_variance(problem: Problem, found: Solution) -> FloatArray:
    """The variance of each gauge's kinks: their squares over the number of them that the data decide (MacKay)."""
    if not problem.kinks.any():
        return found.kink_variance
    kinks = found.coefficients[:, problem.kinks]
    own = np.einsum("kpkp->kp", found.covariance)[:, problem.kinks]
    decided = np.maximum((1.0 - own / found.kink_variance[:, np.newaxis]).sum(axis=1), 0.01)
    variance: FloatArray = np.clip(np.square(kinks).sum(axis=1) / decided, SMALLEST_RESTLESS**2, 1e6)
    return variance


def _noise(problem: Problem, found: Solution) -> FloatArray:
    """One step of expectation-maximisation for the gauge noise, restricted likelihood, readings left out imputed.

    The load-direction part of a residual is taken off by its expectation; e e^T + H undoes what the fit has
    absorbed. Without direction scatter its fixed point is the sum of e e^T over (rows - unknowns).
    """
    inverse = observed_inverse(found.R, problem.observed)
    used = problem.observed.any(axis=1)
    row_noise = found.Sigma / problem.weight[:, np.newaxis, np.newaxis]
    gain = row_noise @ inverse
    e = np.where(problem.observed, found.residual, 0.0)
    spread = e[:, :, np.newaxis] * e[:, np.newaxis, :] + found.H
    expected = gain @ spread @ gain.transpose(0, 2, 1) + row_noise - gain @ row_noise
    total: FloatArray = (problem.weight[:, np.newaxis, np.newaxis] * expected)[used].mean(axis=0)
    return 0.5 * (total + total.T) + NOISE_FLOOR**2 * np.eye(total.shape[0])


def _longer(before: FloatArray, after: FloatArray) -> FloatArray:
    """Expectation-maximisation creeps, but never turns: go nearly twice as far while the result stays a covariance."""
    far = after + 0.9 * (after - before)
    return far if np.linalg.eigvalsh(far)[0] > 0.3 * np.linalg.eigvalsh(after)[0] else after


def _loss_weights(distance: FloatArray, loss: str, cut: float) -> FloatArray:
    d = np.sqrt(np.maximum(distance, 0.0)) / cut
    if loss == "huber":
        return 1.0 / np.maximum(d, 1.0)
    if loss == "soft_l1":
        return 1.0 / np.sqrt(1.0 + d * d)
    return np.ones_like(d)
