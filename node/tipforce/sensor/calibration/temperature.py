"""What temperature does to offsets and gain, as far as the rows of a calibration show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.calibration.distributions import t_quantile
from tipforce.sensor.calibration.problem import Problem, Solution
from tipforce.sensor.calibration.solve import extra

CHANCE = 0.005
"""That a gain which does not depend on temperature is corrected for it."""


@dataclass(frozen=True, slots=True, eq=False)
class Temperature:
    """Coefficients against the mean temperature of the rows: V = (1 + gain dT) A F + offset + offset_per_K dT."""

    reference_degC: float
    lowest_degC: float
    highest_degC: float
    offset_strain_per_K: FloatArray
    """(n,): estimates; they count in the fit where ``offset_fitted``."""
    offset_half_width: FloatArray
    """Half of the 95 % intervals, (n,); NaN where the rows show nothing of it."""
    offset_fitted: bool
    gain_per_K: float
    gain_half_width: float
    gain_fitted: bool


def reference_temperature_degC(temperature_degC: FloatArray) -> float:
    """Return the temperature that coefficients are counted from: the mean of the rows, to a hundredth of a degree."""
    return round(float(np.mean(temperature_degC)), 2)


def gain_of(problem: Problem, found: Solution, change_K: FloatArray) -> tuple[float, float]:
    """Return (gain per kelvin beyond that of the problem, its standard uncertainty); NaN where no row shows it."""
    span = float(np.abs(change_K).max())
    strain = problem.g[:, :3] @ found.coefficients[:, :3].T
    try:
        term = extra(problem, found, (strain * (change_K / max(span, 1e-300))[:, np.newaxis])[:, :, np.newaxis])
    except np.linalg.LinAlgError:
        return 0.0, float("nan")
    return float(term.value[0]) / span, float(np.sqrt(term.covariance[0, 0])) / span


def offsets_of(
    problem: Problem, found: Solution, change_K: FloatArray, fitted_span_K: float, strain: float
) -> tuple[FloatArray, FloatArray]:
    """Return (offset per kelvin, standard uncertainty), (n,) each, strain: of the fit, or as a further column.

    fitted_span_K: kelvins per unit of the fit's last column; 0 where it has no column of temperature.
    """
    n, p = problem.V.shape[1], problem.g.shape[1]
    if fitted_span_K:
        last = np.arange(n) * p + p - 1
        variance = np.diagonal(found.covariance.reshape(n * p, n * p))[last]
        return found.coefficients[:, -1] * strain / fitted_span_K, np.sqrt(variance) * strain / fitted_span_K
    span = float(np.abs(change_K).max())
    try:
        term = extra(problem, found, (change_K / max(span, 1e-300))[:, np.newaxis, np.newaxis] * np.eye(n))
    except np.linalg.LinAlgError:
        return np.zeros(n), np.full(n, np.nan)
    return term.value * strain / span, np.sqrt(np.diagonal(term.covariance)) * strain / span


def factor(dof: float, chance: float = 0.05) -> float:
    """Return how many standard uncertainties are beyond chance, to both sides."""
    return t_quantile(1.0 - 0.5 * chance, max(dof, 1.0))
