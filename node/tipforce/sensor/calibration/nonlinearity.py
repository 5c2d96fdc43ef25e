"""Is a gauge, or the structure, straight? A quadratic term of each gauge beside the linear fit, with its interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.calibration.distributions import f_quantile, t_quantile
from tipforce.sensor.calibration.problem import Problem, Solution
from tipforce.sensor.calibration.solve import Extra, extra
from tipforce.sensor.contact.force import force_vector

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
    problem: Problem,
    found: Solution,
    C: FloatArray,
    sigma0: float,
    scale_strain: float,
    scale_newtons: float,
    largest_newtons: float,
) -> Nonlinearity | None:
    """Return the test of a quadratic term; None where the rows do not determine one.

    C: (3, n) newtons per unit strain; the scales are those of the problem. Residuals larger than the model expects
    (sigma0 above 1) widen the intervals.
    """
    n, A = problem.V.shape[1], found.coefficients[:, :3]
    strain = problem.g[:, :3] @ A.T
    trials: list[tuple[float, bool, Extra]] = []
    for odd in (False, True):
        try:
            term = extra(problem, found, _square(strain, odd)[:, :, np.newaxis] * np.eye(n))
            term = term._replace(covariance=term.covariance * max(1.0, sigma0 if np.isfinite(sigma0) else 1.0) ** 2)
            size = float(term.value @ np.linalg.solve(term.covariance, term.value))
        except np.linalg.LinAlgError:
            continue
        trials.append((size, odd, term))
    dof = found.dof - 1.0
    if not trials or dof < 1.0:
        return None
    size, odd, term = max(trials, key=lambda trial: trial[0])
    stated = problem.Sigma is not None
    significant = size > n * f_quantile(1.0 - 0.5 * FALSE_ALARM, n, 1e6 if stated else dof)
    u = np.sqrt(np.diagonal(term.covariance))
    factor = t_quantile(0.975, np.inf if stated else dof)
    relative = 0.0
    if significant:
        scaled_C = C * scale_strain / scale_newtons
        relative = _relative_error(term, scaled_C, odd, largest_newtons / scale_newtons)
    return Nonlinearity(term.value / scale_strain, factor * u / scale_strain, odd, bool(significant), relative)


def _square(strain: FloatArray, odd: bool) -> FloatArray:
    return strain * np.abs(strain) if odd else strain * strain


def _relative_error(term: Extra, C: FloatArray, odd: bool, P: float) -> float:
    """What the linear matrix makes of a sensor with the quadratic term: RMS of the force error over the force."""
    theta, delta = np.meshgrid(np.radians(np.arange(0.0, 181.0, 15.0)), np.radians(np.arange(-60.0, 61.0, 15.0)))
    turn = np.array([0.0, np.pi])[:, np.newaxis]
    phi = (theta + delta).ravel() + turn
    F = force_vector(np.full(phi.size, P), phi.ravel(), np.tile(theta.ravel(), 2))
    s = F @ term.coefficients[:, :3].T
    off = (s + term.value * _square(s, odd)) @ C.T - F
    along = F[:, [0, 2]] / P
    radial = np.einsum("ij,ij->i", off[:, [0, 2]], along)
    across = off[:, 0] * along[:, 1] - off[:, 2] * along[:, 0]
    return float(max(np.sqrt(np.mean(radial**2)), np.sqrt(np.mean(across**2)))) / P
