"""The least-squares problem of a calibration, and the solution of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray, IntArray

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
    """(m, p): F1, F2, F3, then the columns of the offset."""
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
    kinks: BoolArray
    """(p,): coefficients around zero, of a variance that is estimated for each gauge: the restlessness of its drift."""
    scatter: Scatter | None = None
    """Where it is known; None to estimate it."""


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
    unexplained: FloatArray
    """(m, n): reading less fit, the groove's angle left in."""
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
