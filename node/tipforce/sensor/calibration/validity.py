"""Where a calibration is valid, as far as its data and the structure say."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.calibration.distributions import f_quantile, variance_factors
from tipforce.sensor.contact.force import force_vector
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.limits import PAPER_SLIT_M, slit_closure, worst_stress

FALSE_ALARM_RATE = 1e-6
"""Of the redundancy check, per sample."""
_THETA_DEG = np.arange(0.0, 181.0, 15.0)
_DELTA_DEG = np.arange(-75.0, 76.0, 15.0)


def redundancy_limit(
    A: FloatArray, Sigma: FloatArray, parameter_covariance: FloatArray, dof: float, largest_newtons: float
) -> float:
    """Return the limit of chi-square (2116h) for one false alarm in a million samples; 0 for three gauges.

    Of chi-square by the record's noise, which is wider than Sigma by variance_factors().

    A: (n, 3), strain per newton; Sigma: (n, n), of one reading, known with ``dof`` degrees of freedom;
    parameter_covariance: (n, 4, n, 4). Chi-square is weighed by Sigma alone: what the calibration itself may
    contradict, at the worst load up to ``largest_newtons``, and that Sigma is an estimate (Hotelling) widen it.
    Raises InputError for a covariance that is not positive definite, or with no more than n - 2 degrees of freedom.
    """
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
    theta, delta = (grid.ravel() for grid in np.meshgrid(np.radians(_THETA_DEG), np.radians(_DELTA_DEG)))
    F = force_vector(largest_newtons, theta + delta, theta)
    G = np.concatenate((np.concatenate((F, -F)), np.ones((2 * len(F), 1))), axis=1)
    kernel = np.einsum("ka,kilj,lb->abij", parity, parameter_covariance, parity)
    added = np.einsum("gi,abij,gj->gab", G, kernel, G)
    widest = float(np.linalg.eigvalsh(0.5 * (added + added.transpose(0, 2, 1)))[:, -1].max())
    if np.isinf(dof) or dof > 1e6:
        dof = 1e6
    chance = f_quantile(1.0 - FALSE_ALARM_RATE, spare, dof - spare + 1.0)
    limit = spare * dof / (dof - spare + 1.0) * chance * (1.0 + max(widest, 0.0))
    return limit / wider


def overload_newtons(geometry: Geometry, yield_pascals: float | None = None, gap_m: float = PAPER_SLIT_M) -> float:
    """Return the smallest load, over all contacts and directions, that closes the slit or reaches the yield stress."""
    slit = gap_m / slit_closure(geometry, 1.0)
    return slit if yield_pascals is None else min(slit, yield_pascals / worst_stress(geometry, 1.0))
