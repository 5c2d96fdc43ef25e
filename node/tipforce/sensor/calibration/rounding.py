"""A fit without the digits that say nothing, so that equal data give equal calibrations on every machine.

The last bits of a solution come from the library that solved it. Nine digits are finer than the node's REAL32 (seven)
and a ten-thousandth of what a good calibration knows (three to four). A value that lies on the border of two roundings
may still fall to either side: for bits that differ by 1e-15, once in a million values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.sensor.calibration.result import Fit

DIGITS = 9
# The parameter covariance is computed from the inverse of N, which enlarges what rounding takes away.
NORMAL_DIGITS = 12


def to_digits(values: npt.ArrayLike, digits: int = DIGITS, scale: float = 0.0) -> FloatArray:
    """Return ``values`` rounded to ``digits`` of the largest of them, or of ``scale`` if that is larger.

    All to the same place: an entry that is small beside the others is as uncertain as they are.
    """
    array = np.asarray(values, dtype=np.float64)
    largest = max(float(np.max(np.abs(array), initial=0.0)), scale)
    if not 0.0 < largest < np.inf:
        return array
    rounded: FloatArray = np.round(array, digits - 1 - int(np.floor(np.log10(largest))))
    return rounded


def matrix_to_digits(C: npt.ArrayLike) -> FloatArray:
    """Return a calibration matrix (3, n), each row (a force) rounded by itself."""
    return np.stack([to_digits(row) for row in np.asarray(C, dtype=np.float64)])


def rounded(fit: Fit) -> Fit:
    """Return the fit with all that goes into a calibration file rounded; residuals and diagnoses as they are."""
    per_newton = float(np.max(np.abs(fit.A), initial=0.0))
    return replace(
        fit,
        C=matrix_to_digits(fit.C),
        offset_strain=to_digits(fit.offset_strain, scale=per_newton),  # an offset near 0 is as uncertain as others
        C_uncertainty=matrix_to_digits(fit.C_uncertainty),
        noise_covariance_strain2=to_digits(fit.noise_covariance_strain2),
        residual_covariance_strain2=to_digits(fit.residual_covariance_strain2),
        N=to_digits(fit.N, NORMAL_DIGITS),
        parameter_covariance=to_digits(fit.parameter_covariance),
        coverage_factor=float(to_digits(fit.coverage_factor)),
        sigma0=float(to_digits(fit.sigma0)),
        dof=float(to_digits(fit.dof)),
        noise_dof=float(to_digits(fit.noise_dof)),
        condition_number=float(to_digits(fit.condition_number)),
        row_equilibrated_condition_number=float(to_digits(fit.row_equilibrated_condition_number)),
    )
