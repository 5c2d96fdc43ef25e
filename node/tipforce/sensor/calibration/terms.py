"""Terms beside the linear fit, each with its interval: a quadratic one of each gauge, and what temperature does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.calibration.distributions import f_quantile, t_quantile
from tipforce.sensor.calibration.solve import Extra, Problem, Solution, extra
from tipforce.sensor.contact.estimate import force_vector

FALSE_ALARM = 0.005
"""Chance that a straight sensor is called nonlinear."""


@dataclass(frozen=True, slots=True, eq=False)
class Nonlinearity:
    """V = s + q s^2, or s + q s |s|, with s the elastic strain: whichever of the two the rows prefer."""

    per_strain: FloatArray
    """q of each gauge, (n,), 1 per unit strain: 100 is 10 % per 1000 microstrain."""
    half_width: FloatArray
    """Half of its 95 % interval, (n,)."""
    odd: bool
    """True: s |s|, equal in tension and compression; False: s^2."""
    significant: bool
    model_uncertainty: float
    """Relative standard uncertainty of the force that it makes at the largest load, pulls and pushes; 0 where not
    significant."""


def nonlinearity(
    problem: Problem, solution: Solution, C: FloatArray, sigma0: float, largest_newtons: float
) -> Nonlinearity | None:
    """Return the test of a quadratic term; None where the rows do not determine one.

    C: (3, n) newtons per unit strain. Residuals larger than the model expects (sigma0 above 1) widen the intervals.
    """
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
    relative, strain = 0.0, problem.strain
    if significant:
        scaled_C = C * strain / problem.newtons
        relative = _relative_error(term, scaled_C, odd, largest_newtons / problem.newtons)
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


def per_kelvin(
    problem: Problem, solution: Solution, change_K: FloatArray, columns: FloatArray, unit: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return (coefficients per kelvin beyond the fit's of ``columns``, (m or 1, n, k), times ``unit``; their standard
    uncertainties), (k,) each; zeros and NaN where no row shows them.
    """
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


def factor(dof: float, chance: float = 0.05) -> float:
    """Return how many standard uncertainties are beyond chance, to both sides."""
    return t_quantile(1.0 - 0.5 * chance, max(dof, 1.0))
