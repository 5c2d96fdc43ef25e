"""The variances of a calibration fit, one step of their estimation (REML), and the weights of its rows."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.calibration.problem import NOISE_FLOOR, Problem, Scatter, Solution

START_RESTLESS, SMALLEST_RESTLESS = 0.05, 1e-5
"""Standard deviation of a drift's kinks, as a fraction of the readings: to begin with, and at least."""
STATED_WORTH = 6.0
"""The stated scatter of a groove counts as so many observed angles: a few grooves show little of their own."""
START_HANG, HANG_WORTH = 0.1, 1.0
"""Variance of the angle that is new in every row, in units of the stated one, before any data; it counts as so many
observed angles."""
LARGEST_SCATTER = 100.0
"""Of both variances: ten times the stated angle is a fault and no scatter."""


def scatter(problem: Problem, found: Solution, u: FloatArray) -> Scatter:
    """The variances of load directions: squares of the angles over how many of them the data decide (MacKay)."""
    groove = STATED_WORTH + found.scatter.groove * float(np.square(found.angle).sum())
    groove /= STATED_WORTH + float(found.angle_decided.sum())
    pull = (found.coefficients[:, :3] @ problem.D).transpose(0, 2, 1) @ found.R_inverse
    e = np.where(problem.observed, found.residual, 0.0)
    # A row that disagrees must not pass for one whose direction strays: it counts by the square of its weight.
    share = np.square(u)
    angle = found.scatter.hang * (pull @ e[..., np.newaxis])[..., 0]
    decided = found.scatter.hang * np.einsum("i,ijk,ikl,ijl->", share, pull, found.R - found.H, pull)
    hang = HANG_WORTH * START_HANG + float((share * np.square(angle).sum(axis=1)).sum())
    hang /= HANG_WORTH + max(float(decided), 0.0)
    return Scatter(min(groove, LARGEST_SCATTER), min(hang, LARGEST_SCATTER))


def kink_variance(problem: Problem, found: Solution) -> FloatArray:
    """The variance of each gauge's kinks: their squares over the number of them that the data decide (MacKay)."""
    if not problem.kinks.any():
        return found.kink_variance
    kinks = found.coefficients[:, problem.kinks]
    own = np.einsum("kpkp->kp", found.covariance)[:, problem.kinks]
    decided = np.maximum((1.0 - own / found.kink_variance[:, np.newaxis]).sum(axis=1), 0.01)
    variance: FloatArray = np.clip(np.square(kinks).sum(axis=1) / decided, SMALLEST_RESTLESS**2, 1e6)
    return variance


def noise(problem: Problem, found: Solution) -> FloatArray:
    """One step of expectation-maximisation for the gauge noise, restricted likelihood, readings left out imputed.

    The load-direction part of a residual is taken off by its expectation; e e^T + H undoes what the fit has
    absorbed. Without direction scatter its fixed point is the sum of e e^T over (rows - unknowns).
    """
    used = problem.observed.any(axis=1)
    row_noise = found.Sigma / problem.weight[:, np.newaxis, np.newaxis]
    gain = row_noise @ found.R_inverse
    e = np.where(problem.observed, found.residual, 0.0)
    spread = e[:, :, np.newaxis] * e[:, np.newaxis, :] + found.H
    expected = gain @ spread @ gain.transpose(0, 2, 1) + row_noise - gain @ row_noise
    total: FloatArray = (problem.weight[:, np.newaxis, np.newaxis] * expected)[used].mean(axis=0)
    return 0.5 * (total + total.T) + NOISE_FLOOR**2 * np.eye(total.shape[0])


def longer(before: FloatArray, after: FloatArray) -> FloatArray:
    """Expectation-maximisation creeps, but never turns: go nearly twice as far while the result stays a covariance."""
    far = after + 0.9 * (after - before)
    return far if np.linalg.eigvalsh(far)[0] > 0.3 * np.linalg.eigvalsh(after)[0] else after


def loss_weights(distance: FloatArray, loss: str, cut: float) -> FloatArray:
    """Return the weight of each row, (m,), from its squared distance in standard deviations: 1 near 0."""
    d = np.sqrt(np.maximum(distance, 0.0)) / cut
    if loss == "huber":
        return 1.0 / np.maximum(d, 1.0)
    if loss == "soft_l1":
        return 1.0 / np.sqrt(1.0 + d * d)
    return np.ones_like(d)
