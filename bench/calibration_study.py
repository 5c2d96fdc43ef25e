"""Simulated calibrations judged: beside a fit that knows the truth, beside the paper's fit, and by their intervals."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from math import sqrt

import numpy as np
import numpy.typing as npt

from tipforce.sensor.calibration.fit import Fit, Model, Readings, fit_calibration, linear_fit
from tipforce.sensor.calibration.problem import Problem, Scatter
from tipforce.sensor.calibration.regressors import direction_scatter, grooves
from tipforce.sensor.calibration.simulation import Faults, Simulated, simulate, unseen_forces
from tipforce.sensor.calibration.solve import solve
from tipforce.sensor.calibration.statistics import left_inverse
from tipforce.sensor.contact.force import force_vector

FloatArray = npt.NDArray[np.float64]

CASES = ("I", "II", "III")
SEEDS = 20
UNSEEN = 2000
FULL_SIMULATIONS, QUICK_SIMULATIONS = 2000, 60
DIRECTIONS = np.array([[0.0, 0.0, 2.0], [1.0, 1.0, -2.0], [-3.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
"""Forces, newtons, at which the covariance of an estimate is judged; the third is a push, never calibrated."""

STATED_SCATTER_RAD = float(np.radians(0.5))
"""What the fit is told of load directions."""
_CLEAN = Faults(drift_strain=0.0, groove_scatter_rad=0.0, hang_scatter_rad=0.0, outlier_share=0.0, saturation=None)
CONDITIONS: dict[str, tuple[Faults, str]] = {
    "offset and noise": (_CLEAN, "none"),
    "linear drift": (replace(_CLEAN, drift_strain=15e-6, warm_up=0.0), "linear"),
    "angles of grooves": (replace(_CLEAN, groove_scatter_rad=STATED_SCATTER_RAD), "none"),
    "angles of rows": (replace(_CLEAN, hang_scatter_rad=STATED_SCATTER_RAD), "none"),
    "outliers": (replace(_CLEAN, outlier_share=0.02), "none"),
    "saturation": (replace(_CLEAN, saturation=0.93), "none"),
    "everything": (Faults(), "tare"),
}
"""What goes wrong -> (faults, the drift that the fit is told)."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Root mean square errors of force on unseen loads, newtons, of one simulated calibration."""

    seed: int
    case: str
    fit: float
    """Readings with noise, the fit's offsets of the last row."""
    oracle: float
    linear: float
    fit_matrix: float
    """Without noise, offsets known: what the matrix alone is off."""
    oracle_matrix: float
    linear_matrix: float
    outliers: int
    found: int
    """Of the outliers, how many the fit named."""
    falsely: int
    """Good rows that it named."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often nominal 95 % intervals held the truth, per cent."""

    condition: str
    simulations: int
    matrix: float
    """Mean over the nine entries of C."""
    matrix_worst: float
    """The entry furthest from 95."""
    force: float
    """Mean over F1, F2, F3 at DIRECTIONS: what the calibration contributes to an estimate."""
    false_alarm: float
    """Simulations in which a good row was named an outlier."""


def simulated(seed: int, faults: Faults) -> tuple[str, Simulated]:
    """The calibration of a seed; the case goes round with it."""
    case = CASES[seed % 3]
    return case, simulate(case, np.random.default_rng(seed), faults)


def fitted(sim: Simulated, drift: str, loss: str = "huber") -> Fit:
    """The product's fit: it is told a scatter (where there is any) and the converter's limit, and nothing else."""
    scatter = STATED_SCATTER_RAD if sim.faults.groove_scatter_rad or sim.faults.hang_scatter_rad else 0.0
    model = Model(
        drift=drift,  # type: ignore[arg-type]
        loss=loss,  # type: ignore[arg-type]
        phi_scatter_rad=scatter,
        theta_scatter_rad=scatter,
        saturation_strain=np.inf if sim.saturation_strain is None else sim.saturation_strain,
    )
    return fit_calibration(Readings(sim.strain, sim.P_newtons, sim.phi_rad, sim.theta_rad, sim.t_s), model)


def oracle(sim: Simulated) -> FloatArray:
    """C of the fit that knows the offset at each row, the outliers, the noise, and the true A in its weights."""
    unit, n = 1e-6, sim.strain.shape[1]
    load = sim.P_newtons, sim.phi_rad, sim.theta_rad
    limit = np.inf if sim.saturation_strain is None else sim.saturation_strain
    Sigma = (sim.faults.noise_strain / unit) ** 2 * np.eye(n)
    known = Problem(
        V=(sim.strain - sim.true_offset_strain) / unit,
        g=force_vector(*load),
        D=direction_scatter(*load, 1.0, 1.0),
        groove=grooves(sim.phi_rad, sim.theta_rad),
        weight=np.ones(len(sim.strain)),
        observed=(np.abs(sim.strain) < limit) & ~sim.true_outlier[:, np.newaxis],
        Sigma=Sigma,
        prior_mean=np.zeros((n, 3)),
        prior_information=np.zeros(n),
        kinks=np.zeros(3, dtype=np.bool_),
        scatter=Scatter(sim.faults.groove_scatter_rad**2, sim.faults.hang_scatter_rad**2),
    )
    A = solve(known, "none", 1.0).coefficients * unit
    return left_inverse(A, np.eye(n))


def compare(seed: int, faults: Faults, drift: str, loss: str = "huber") -> Comparison:
    """One calibration and its three fits on the same unseen loads."""
    case, sim = simulated(seed, faults)
    fit = fitted(sim, drift, loss)
    rng = np.random.default_rng([seed, 1])
    F = unseen_forces(rng, UNSEEN)
    clean, end = F @ sim.true_A.T, sim.true_offset_strain[-1]
    V = clean + end + faults.noise_strain * rng.normal(size=clean.shape)
    C_oracle = oracle(sim)
    C_linear = linear_fit(sim.strain, force_vector(sim.P_newtons, sim.phi_rad, sim.theta_rad))
    true, named = set(np.flatnonzero(sim.true_outlier)), set(fit.outliers)
    return Comparison(
        seed, case,
        _rms((V - fit.offset_strain) @ fit.C.T - F), _rms((V - end) @ C_oracle.T - F), _rms(V @ C_linear.T - F),
        _rms(clean @ fit.C.T - F), _rms(clean @ C_oracle.T - F), _rms(clean @ C_linear.T - F),
        len(true), len(true & named), len(named - true),
    )  # fmt: skip


def pooled(comparisons: list[Comparison], name: str) -> float:
    """Root mean square of one error over all calibrations, newtons."""
    return sqrt(float(np.mean([getattr(one, name) ** 2 for one in comparisons])))


def coverage(condition: str, simulations: int, workers: int = 1) -> Coverage:
    """How often the intervals of a condition hold the truth."""
    task = partial(_covered, condition)
    seeds = range(1000, 1000 + simulations)
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            found = list(pool.map(task, seeds, chunksize=20))
    else:
        found = [task(seed) for seed in seeds]
    matrix = 100.0 * np.mean([one[0] for one in found], axis=0)
    worst = matrix[int(np.argmax(np.abs(matrix - 95.0)))]
    force = 100.0 * float(np.mean([one[1] for one in found]))
    alarms = 100.0 * float(np.mean([one[2] for one in found]))
    return Coverage(condition, simulations, float(matrix.mean()), float(worst), force, alarms)


def _covered(condition: str, seed: int) -> tuple[FloatArray, FloatArray, bool]:
    """Which entries of C and which forces the intervals hold; whether a good row was named."""
    faults, drift = CONDITIONS[condition]
    _, sim = simulated(seed, faults)
    fit = fitted(sim, drift)
    lower, upper = fit.C_interval
    truth = np.linalg.inv(sim.true_A)
    V = DIRECTIONS @ sim.true_A.T + sim.true_offset_strain[-1]
    error = (V - fit.offset_strain) @ fit.C.T - DIRECTIONS
    spread = np.sqrt(np.diagonal(fit.covariance_F(DIRECTIONS, noise=False), axis1=1, axis2=2))
    falsely = bool(set(fit.outliers) - set(np.flatnonzero(sim.true_outlier)))
    held = (lower <= truth) & (truth <= upper)
    return held.ravel(), np.abs(error).ravel() <= fit.coverage_factor * spread.ravel(), falsely


def _rms(error: FloatArray) -> float:
    """Root mean square length of the force error, newtons."""
    return float(np.sqrt(np.mean(np.square(error).sum(axis=1))))
