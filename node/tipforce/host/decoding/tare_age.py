"""What the age of a tare adds to the covariance of the force, where the calibration states how fast offsets drift."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.host.configuration.calibration import Calibration


def ages_s(t_s: FloatArray, tared_at_s: FloatArray | None) -> FloatArray:
    """Seconds of each row, (m,), to the nearest tare (k,); None: since the first row, the first that is known."""
    if tared_at_s is None:
        return t_s - t_s[:1]
    after = np.clip(np.searchsorted(tared_at_s, t_s), 0, len(tared_at_s) - 1)
    before = np.maximum(after - 1, 0)
    nearest: FloatArray = np.minimum(np.abs(t_s - tared_at_s[before]), np.abs(t_s - tared_at_s[after]))
    return nearest


def covariance_of_age(calibration: Calibration, matrix: FloatArray, age_s: FloatArray) -> FloatArray:
    """The covariance (m, 3, 3), N^2, of offsets that have drifted for ``age_s``, each gauge by itself.

    matrix: (m, 3, n), without the gauges left out. The drift rate is the standard deviation of a rate that stays.
    """
    drifted = np.square(calibration.tare_drift_strain_per_s * age_s)
    covariance: FloatArray = drifted[:, np.newaxis, np.newaxis] * (matrix @ matrix.transpose(0, 2, 1))
    return covariance
