"""Generalised least squares for V = A F + b with noise that differs from row to row: its variances, and those of a
load's direction by groove and by row, are estimated (REML). Whitened rows are solved by QR."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.errors import InputError
from tipforce.sensor.calibration.regressors import OffsetBasis

NOISE_FLOOR = 1e-7
"""Smallest standard deviation of the gauges, as a fraction of the readings: keeps exact data invertible."""


class Scatter(NamedTuple):
    """Variances of load directions, in units of the stated ones."""

    groove: float
    hang: float


class Problem(NamedTuple):
    """Rows of one calibration, scaled so that readings and loads are near one; m rows, n gauges, p unknowns each."""

    V: FloatArray
    """(m, n)."""
    g: FloatArray
    """(m, p): F1, F2, F3, then the columns of the basis."""
    basis: OffsetBasis
    D: FloatArray
    """(m, 3, 2): D D^T is the covariance of F from the stated scatter of load directions."""
    groove: IntArray
    """(m,): which rows share one error of direction, counted from 0."""
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
    scatter: Scatter | None = None
    """Where it is known; None to estimate it."""
    strain: float = 1.0
    """The unit of V."""
    newtons: float = 1.0
    """The unit of F: any size of load then fits equally well."""

    @property
    def kinks(self) -> BoolArray:
        """(p,): coefficients around zero, their variance, the restlessness of the drift, estimated for each gauge."""
        return np.concatenate((np.zeros(3, dtype=np.bool_), self.basis.kinks))


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
    scatter: Scatter
    residual: FloatArray
    """(m, n), of every row, used or not; what the groove's own angle explains is taken off."""
    R: FloatArray
    """(m, n, n): the covariance of each row's own noise."""
    R_inverse: FloatArray
    """(m, n, n): its inverse over the readings that count, zero elsewhere."""
    H: FloatArray
    """(m, n, n): the covariance of each row's fitted value, with the groove's angle."""
    distance: FloatArray
    """(m,): squared Mahalanobis distance of each row, by the fit without that row."""
    leverage: FloatArray
    """(m,): share of a row in its own fitted value, 0 to 1; 0 for a row that is not used."""
    angle: FloatArray
    """(grooves, 2): expected error of direction of each groove, in its standard deviations."""
    angle_decided: FloatArray
    """(grooves,): how many of its two angles the data decide."""
    absorbed: FloatArray
    """(m,): readings' worth of a row that the fit and the groove's angle have taken up."""
    dof: float
    """Rows less unknowns, per gauge; fractional with a prior or with readings left out."""
    converged: bool


def pick(problem: Problem, rows: BoolArray) -> Problem:
    """Return the problem with the readings of the other rows left out."""
    return problem._replace(observed=problem.observed & rows[:, np.newaxis])


START_RESTLESS, SMALLEST_RESTLESS = 0.05, 1e-5
"""Standard deviation of a drift's kinks, as a fraction of the readings: to begin with, and at least."""
STATED_WORTH = 6.0
"""The stated scatter of a groove counts as so many observed angles: a few grooves show little of their own."""
START_HANG, HANG_WORTH = 0.1, 1.0
"""Variance of a row's own angle, in units of the stated one, before any data; it counts as so many angles."""
LARGEST_SCATTER = 100.0
"""Of both variances: ten times the stated angle is a fault and no scatter."""


def _scatter_of(problem: Problem, solution: Solution, u: FloatArray) -> Scatter:
    """The variances of load directions: squares of the angles over how many of them the data decide (MacKay)."""
    groove = STATED_WORTH + solution.scatter.groove * float(np.square(solution.angle).sum())
    groove /= STATED_WORTH + float(solution.angle_decided.sum())
    pull = (solution.coefficients[:, :3] @ problem.D).transpose(0, 2, 1) @ solution.R_inverse
    e = np.where(problem.observed, solution.residual, 0.0)
    # A row that disagrees must not pass for one whose direction strays: it counts by the square of its weight.
    share = np.square(u)
    angle = solution.scatter.hang * (pull @ e[..., np.newaxis])[..., 0]
    decided = solution.scatter.hang * np.einsum("i,ijk,ikl,ijl->", share, pull, solution.R - solution.H, pull)
    hang = HANG_WORTH * START_HANG + float((share * np.square(angle).sum(axis=1)).sum())
    hang /= HANG_WORTH + max(float(decided), 0.0)
    return Scatter(min(groove, LARGEST_SCATTER), min(hang, LARGEST_SCATTER))


def _kink_variance_of(problem: Problem, solution: Solution) -> FloatArray:
    """The variance of each gauge's kinks: their squares over the number of them that the data decide (MacKay)."""
    if not problem.kinks.any():
        return solution.kink_variance
    kinks = solution.coefficients[:, problem.kinks]
    own = np.einsum("kpkp->kp", solution.covariance)[:, problem.kinks]
    decided = np.maximum((1.0 - own / solution.kink_variance[:, np.newaxis]).sum(axis=1), 0.01)
    variance: FloatArray = np.clip(np.square(kinks).sum(axis=1) / decided, SMALLEST_RESTLESS**2, 1e6)
    return variance


def _noise_of(problem: Problem, solution: Solution) -> FloatArray:
    """One step of expectation-maximisation for the gauge noise (REML): e e^T + H undoes what the fit has absorbed."""
    used = problem.observed.any(axis=1)
    row_noise = solution.Sigma / problem.weight[:, np.newaxis, np.newaxis]
    gain = row_noise @ solution.R_inverse
    e = np.where(problem.observed, solution.residual, 0.0)
    spread = e[:, :, np.newaxis] * e[:, np.newaxis, :] + solution.H
    expected = gain @ spread @ gain.transpose(0, 2, 1) + row_noise - gain @ row_noise
    total: FloatArray = (problem.weight[:, np.newaxis, np.newaxis] * expected)[used].mean(axis=0)
    return 0.5 * (total + total.T) + NOISE_FLOOR**2 * np.eye(total.shape[0])


def _longer(before: FloatArray, after: FloatArray) -> FloatArray:
    """Expectation-maximisation creeps, but never turns: go nearly twice as far while the result stays a covariance."""
    far = after + 0.9 * (after - before)
    return far if np.linalg.eigvalsh(far)[0] > 0.3 * np.linalg.eigvalsh(after)[0] else after


def _loss_weights(distance: FloatArray, loss: str, cut: float) -> FloatArray:
    """Return the weight of each row, (m,), from its squared distance in standard deviations: 1 near 0."""
    d = np.sqrt(np.maximum(distance, 0.0)) / cut
    if loss == "none":
        return np.ones_like(d)
    return 1.0 / (np.maximum(d, 1.0) if loss == "huber" else np.sqrt(1.0 + d * d))


MAX_STEPS, BOLD_STEPS = 300, 25
"""After the bold steps the weights of rows stay, and each step goes half as far: a row whose weight moves the groove's
angle that it is judged by would go round in a circle."""
TOLERANCE = 1e-5
"""Relative change of A at which the steps end; 1e-3 of the noise, of which a few per cent do not matter."""


def solve(problem: Problem, loss: str, cut: float, start: Solution | None = None) -> Solution:
    """Return the fit. loss: "huber", "soft_l1" or "none", its corner at the distance ``cut``; start: to begin from.
    Raises InputError where the noise is to be estimated and nothing is left to estimate it from."""
    A, Sigma = _start(problem) if start is None else (start.coefficients[:, :3], start.Sigma)
    restless = np.full(len(A), START_RESTLESS**2) if start is None else start.kink_variance
    scatter = (Scatter(1.0, START_HANG) if start is None else start.scatter) if problem.D.any() else Scatter(0.0, 0.0)
    scatter = scatter if problem.scatter is None else problem.scatter
    u = np.ones(len(problem.V))
    for count in range(MAX_STEPS):
        calm = count >= BOLD_STEPS
        solution = _step(problem, A, Sigma, restless, scatter, u)
        change = np.abs(solution.coefficients[:, :3] - A).max() / max(np.abs(A).max(), 1e-300)
        A = solution.coefficients[:, :3]
        weights = u if calm else _loss_weights(solution.distance, loss, cut)
        change = max(change, 0.01 * float(np.abs(weights - u).max()))
        u = weights
        restless = _kink_variance_of(problem, solution)
        if problem.D.any() and problem.scatter is None:
            scatter, before = _scatter_of(problem, solution, u), scatter
            scatter = Scatter(*(0.5 * (a + b) for a, b in zip(scatter, before, strict=True))) if calm else scatter
            change = max(change, 0.001 * max(abs(a - b) / (a + 0.01) for a, b in zip(scatter, before, strict=True)))
        if problem.Sigma is None:
            if solution.dof < 0.5:
                raise InputError(
                    f"{int(problem.observed.any(axis=1).sum())} rows for {problem.g.shape[1]} unknowns of each gauge "
                    "leave no residuals to estimate the noise from: add rows, or state the gauge noise"
                )
            after = _noise_of(problem, solution)
            Sigma, moved = after if calm else _longer(Sigma, after), Sigma
            change = max(change, 0.01 * float(np.abs(Sigma - moved).max() / np.abs(Sigma).max()))
        if change < TOLERANCE:
            break
    return solution._replace(converged=bool(change < TOLERANCE))


class Extra(NamedTuple):
    """Coefficients that a fit has not, and what they would change in it."""

    value: FloatArray
    """(k,)."""
    covariance: FloatArray
    """(k, k)."""
    coefficients: FloatArray
    """(n, p): those of the fit beside them."""


def extra(problem: Problem, solution: Solution, columns: FloatArray) -> Extra:
    """Return coefficients of further columns (m, n, k). Raises LinAlgError where the rows do not determine them."""
    n, p, k = problem.V.shape[1], problem.g.shape[1], columns.shape[2]
    AD = solution.coefficients[:, :3] @ problem.D
    whitener = _whitener(solution.R, problem.observed)
    X = (whitener[:, :, :, np.newaxis] * problem.g[:, np.newaxis, np.newaxis, :]).reshape(len(AD), n, n * p)
    rows = np.concatenate((X, whitener @ columns, whitener @ problem.V[..., np.newaxis]), axis=-1)
    effect = _Effect.of(whitener @ (np.sqrt(solution.scatter.groove) * AD), problem.groove)
    prior = np.insert(_prior_rows(problem, solution.kink_variance), [n * p] * k, 0.0, axis=1)
    beta, root = _solved(effect.marginal(rows).reshape(-1, n * p + k + 1), prior, n * p + k)
    added = root[n * p :]
    return Extra(beta[n * p :], added @ added.T, beta[: n * p].reshape(n, p))


def _start(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Ordinary least squares per gauge, and a first noise covariance (diagonal)."""
    n = problem.V.shape[1]
    A, variance = np.zeros((n, 3)), np.zeros(n)
    root = np.sqrt(problem.weight)
    for k in range(n):
        rows = problem.observed[:, k]
        g, V = problem.g[rows] * root[rows, np.newaxis], problem.V[rows, k] * root[rows]
        pull = np.sqrt(problem.prior_information[k]) * np.eye(3, g.shape[1])
        wanted = np.concatenate((V, pull[:, :3] @ problem.prior_mean[k]))
        beta = np.linalg.lstsq(np.vstack((g, pull)), wanted, rcond=None)[0]
        A[k], variance[k] = beta[:3], np.mean((V - g @ beta) ** 2) if rows.any() else 0.0
    if problem.Sigma is not None:
        return A, problem.Sigma
    return A, np.diag(np.maximum(variance, NOISE_FLOOR**2))


def _step(
    problem: Problem, A: FloatArray, Sigma: FloatArray, restless: FloatArray, scatter: Scatter, u: FloatArray
) -> Solution:
    n, p = problem.V.shape[1], problem.g.shape[1]
    AD = A @ problem.D
    R = Sigma / problem.weight[:, np.newaxis, np.newaxis] + scatter.hang * AD @ AD.transpose(0, 2, 1)
    unweighted = _whitener(R, problem.observed)
    inverse = unweighted.transpose(0, 2, 1) @ unweighted
    whitener = unweighted * np.sqrt(u)[:, np.newaxis, np.newaxis]
    common = np.sqrt(scatter.groove) * AD
    X = (whitener[:, :, :, np.newaxis] * problem.g[:, np.newaxis, np.newaxis, :]).reshape(len(u), n, n * p)
    y = whitener @ problem.V[..., np.newaxis]
    effect = _Effect.of(whitener @ common, problem.groove)
    rows = effect.marginal(np.concatenate((X, y), axis=-1)).reshape(-1, n * p + 1)
    beta, root = _solved(rows, _prior_rows(problem, restless), n * p)
    coefficients, blocks = beta.reshape(n, p), (root @ root.T).reshape(n, p, n, p)
    of_beta = effect.conditional(X)
    moved = effect.conditional(y - X @ beta[:, np.newaxis])
    residual = problem.V - problem.g @ coefficients.T - (common @ moved)[..., 0]
    # A fitted value is (g - B K T) beta + B z, z the part of the groove's angle that the readings leave open.
    design = np.einsum("kl,ip->iklp", np.eye(n), problem.g).reshape(len(u), n, n * p) - common @ of_beta
    share = design @ root
    H = share @ share.transpose(0, 2, 1) + common @ effect.open @ common.transpose(0, 2, 1)
    hat = X @ root @ (whitener @ share).transpose(0, 2, 1)
    leverage = np.clip(np.trace(hat, axis1=1, axis2=2) / np.maximum(problem.observed.sum(axis=1), 1), 0.0, 1.0)
    distance, absorbed, dof = _judged(residual, problem.observed, R, unweighted, inverse, H)
    first = np.unique(problem.groove, return_index=True)[1]
    left_open = effect.open + (of_beta @ root) @ (of_beta @ root).transpose(0, 2, 1)
    decided = 2.0 - np.trace(left_open[first], axis1=1, axis2=2)
    return Solution(
        coefficients, blocks, Sigma, restless, scatter, residual, R, inverse, H, distance, leverage,
        moved[first, :, 0], decided, absorbed, dof, converged=False,
    )  # fmt: skip


def _prior_rows(problem: Problem, restless: FloatArray) -> FloatArray:
    """Return the prior of the coefficients as whitened rows, (n p, n p + 1)."""
    information, mean = np.zeros((2, problem.V.shape[1], problem.g.shape[1]))
    information[:, :3] = problem.prior_information[:, np.newaxis]
    information[:, problem.kinks] = 1.0 / restless[:, np.newaxis]
    mean[:, :3] = problem.prior_mean
    root = np.sqrt(information.ravel())
    return np.concatenate((np.diag(root), (root * mean.ravel())[:, np.newaxis]), axis=1)[root > 0.0]


def _solved(rows: FloatArray, prior: FloatArray, unknowns: int) -> tuple[FloatArray, FloatArray]:
    """Least squares of whitened rows by QR: the coefficients, and T with T T^T their covariance."""
    padding = np.zeros((max(0, unknowns + 1 - len(rows) - len(prior)), unknowns + 1))
    upper = np.asarray(np.linalg.qr(np.concatenate((rows, prior, padding)), mode="r"), dtype=np.float64)
    R, z = upper[:unknowns, :unknowns], upper[:unknowns, unknowns]
    size = np.abs(np.diagonal(R))
    if not (size > 1e-13 * size.max()).all():
        raise np.linalg.LinAlgError("the unknowns depend on each other")
    root: FloatArray = np.asarray(np.linalg.solve(R, np.eye(unknowns)), dtype=np.float64)
    return root @ z, root


def _whitener(R: FloatArray, observed: BoolArray) -> FloatArray:
    """W (m, n, n) with W R W^T = 1 over the readings that count, zero elsewhere."""
    both = observed[:, :, np.newaxis] & observed[:, np.newaxis, :]
    lower = np.linalg.cholesky(np.where(both, R, np.eye(R.shape[1])))
    return np.where(both, np.linalg.solve(lower, np.broadcast_to(np.eye(R.shape[1]), R.shape)), 0.0)


def _judged(
    residual: FloatArray, observed: BoolArray, R: FloatArray, whitener: FloatArray, inverse: FloatArray, H: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Squared distances by the fit without the row, readings absorbed by the fit, degrees of freedom per gauge."""
    counts = observed.sum(axis=1)
    used = counts > 0
    share = np.einsum("ikl,ilk->i", inverse, H)
    # The residual of a row that was fitted has the covariance R - H, direction by direction; one that was not, R + H.
    # In units of R, so that a direction in which the row alone decides (R = H) gives 0 / tiny, not 0 / 0.
    e = np.where(observed | ~used[:, np.newaxis], residual, 0.0)
    taken = whitener @ H @ whitener.transpose(0, 2, 1)
    left = (1.0 + 1e-9) * np.eye(R.shape[1]) - taken
    whitened = (whitener @ e[..., np.newaxis])[..., 0]
    of_left = np.linalg.solve(left, whitened[..., np.newaxis])[..., 0]
    distance = np.maximum(np.einsum("ik,ik->i", whitened, of_left), 0.0)
    out = residual[~used]
    distance[~used] = np.einsum("ik,ik->i", out, np.linalg.solve((R + H)[~used], out[..., np.newaxis])[..., 0])
    dof = float((counts.sum() - share.sum()) / residual.shape[1])
    return distance, share, dof


class _Effect(NamedTuple):
    """The random angles of the grooves: b z_g in every whitened row of groove g, z_g standard normal, (2,)."""

    b: FloatArray
    """(m, n, 2)."""
    rows: IntArray
    """(m,): the groove of each row."""
    shrink: FloatArray
    """(grooves, 2, 2): 1 - b shrink b^T is the square root of the inverse of 1 + b b^T over a groove."""
    covariance: FloatArray
    """(grooves, 2, 2): of z_g, given its readings and the coefficients."""

    @classmethod
    def of(cls, b: FloatArray, groove: IntArray) -> _Effect:
        count = int(groove.max(initial=-1)) + 1
        size = np.zeros((count, 2, 2))
        np.add.at(size, groove, b.transpose(0, 2, 1) @ b)
        values, vectors = np.linalg.eigh(size)
        values = np.maximum(values, 0.0)
        root = np.sqrt(1.0 + values)
        # (1 - 1 / root) / values without the difference: it holds at zero, too.
        shrink = (vectors * (1.0 / (root * (root + 1.0)))[:, np.newaxis, :]) @ vectors.transpose(0, 2, 1)
        covariance = (vectors / (1.0 + values)[:, np.newaxis, :]) @ vectors.transpose(0, 2, 1)
        return cls(b, groove, shrink, covariance)

    @property
    def open(self) -> FloatArray:
        """(m, 2, 2): what the readings leave open of each row's angle."""
        return self.covariance[self.rows]

    def marginal(self, whitened: FloatArray) -> FloatArray:
        """Rows (m, n, k) times the square root of the inverse of their covariance."""
        return whitened - self.b @ (self.shrink[self.rows] @ self._sums(whitened))

    def conditional(self, whitened: FloatArray) -> FloatArray:
        """The expected z of each row's groove for whitened residuals (m, n, k): (m, 2, k)."""
        return self.covariance[self.rows] @ self._sums(whitened)

    def _sums(self, whitened: FloatArray) -> FloatArray:
        sums = np.zeros((len(self.shrink), 2, whitened.shape[2]))
        np.add.at(sums, self.rows, self.b.transpose(0, 2, 1) @ whitened)
        return sums[self.rows]
