"""Calibration fits against the number of loads: the paper's, the plain affine one, and the product's."""

from collections.abc import Callable
from functools import partial

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor import Model, Readings, fit_calibration, force_vector, linear_fit
from tipforce.sensor.calibration.simulation import paper_grooves, true_matrix, unseen_forces
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, quartiles, series_of, timed

LOADS = (6, 12, 25, 50, 100, 200)
NOISE_STRAIN, OFFSET_STRAIN, OUTLIER_STRAIN = 1e-6, 30e-6, 200e-6
OUTLIER_SHARE = 0.04
UNSEEN = 500
LINEAR, AFFINE, FULL = "F on V, no offset (the paper's)", "V on F with offset, least squares", "tipforce, full fit"
STEPS = 2 * len(LOADS)
_MANY = 25


Fitted = tuple[FloatArray, FloatArray]
"""C (3, n) and the offsets (n,)."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return two studies: noise and offset only; and with outliers."""
    return [_study(effort, advance, 0.0), _study(effort, advance, OUTLIER_SHARE)]


def _study(effort: Effort, advance: Callable[[], None], share: float) -> Study:
    points: list[tuple[str, Point]] = []
    refused: dict[str, str] = {}
    repeats, unseen = effort.pick(8, 100), unseen_forces(np.random.default_rng(4), UNSEEN)
    for loads in LOADS:
        rigs = [_rig(np.random.default_rng([effort.seed, 3, loads, seed]), loads, share) for seed in range(repeats)]
        for method, fit in _METHODS.items():
            try:
                errors = []  # root mean square force error on unseen loads, newtons
                for readings, A, true_offset in rigs:
                    C, offset = fit(readings)
                    off = (unseen @ A.T + true_offset - offset) @ C.T - unseen
                    errors.append(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))))
            except InputError as error:
                refused[f"{method}, {loads} loads"] = f"refused: {error}"
                continue
            # Several sensors: the time of the full fit depends on the data.
            some = [rig[0] for rig in rigs[: effort.pick(2, 9)]]
            times = [timed(partial(fit, readings), effort, at_least_s=0.002) for readings in some]
            timing = quartiles([time.seconds for time in times], [time.work_seconds for time in times])
            rms = float(np.sqrt(np.mean(np.square(errors))))
            points.append((method, Point(f"{loads} loads", rms, timing)))
        advance()
    series = series_of(sorted(points, key=lambda point: list(_METHODS).index(point[0])))
    what = f"{share:.0%} of the readings off by {OUTLIER_STRAIN * 1e6:g} microstrain" if share else "no outliers"
    return Study(
        key="fits-outliers" if share else "fits",
        title=f"Calibration fits: {'noise, offset and outliers' if share else 'noise and offset'}",
        error_unit="root mean square force error (N)",
        work_unit="s per fit",
        reference=(
            f"the true matrix and offset of {repeats} simulated sensors, each fit judged by {UNSEEN} unseen loads of "
            f"0.3 to 4.4 N without noise; x- and y-grooves of the paper's rig in turn, weights at random, a tare for "
            f"every three loads, noise {NOISE_STRAIN * 1e6:g} and offset {OFFSET_STRAIN * 1e6:g} microstrain, {what}"
        ),
        reference_error=1e-15,
        series=series,
        left_out=refused,
        remarks=tuple(_remarks(series)),
        needs=(Need(f"calibrate, {'some readings wrong' if share else 'clean readings'}, to 0.02 N", 0.02, "N"),),
    )


def _rig(rng: np.random.Generator, loads: int, share: float) -> tuple[Readings, FloatArray, FloatArray]:
    """Return readings, true strain matrix, offset: ``loads`` grooves, x and y in turn, random weights, order, tares."""
    grooves = paper_grooves()
    along_x, along_y = (rng.permutation(np.flatnonzero(kind)) for kind in (grooves.along_x, ~grooves.along_x))
    groove = np.stack((np.resize(along_x, loads), np.resize(along_y, loads)), axis=-1).ravel()[:loads]
    m = loads + loads // 3
    P, phi, theta = np.zeros(m), np.zeros(m), np.zeros(m)
    P[:loads] = rng.choice([1.1, 2.2, 4.4], loads)
    phi[:loads], theta[:loads] = grooves.phi_rad[groove], grooves.theta_rad[groove]
    A = true_matrix("I", rng)
    offset = OFFSET_STRAIN * rng.normal(size=len(A))
    strain = force_vector(P, phi, theta) @ A.T + offset + NOISE_STRAIN * rng.normal(size=(m, len(A)))
    odd = rng.random(m) < share
    strain[odd, rng.integers(len(A), size=m)[odd]] += rng.choice([-1.0, 1.0], m)[odd] * OUTLIER_STRAIN
    order = rng.permutation(m)
    return Readings(strain[order], P[order], phi[order], theta[order]), A, offset


def _linear(readings: Readings) -> Fitted:
    F = force_vector(readings.P_newtons, readings.phi_rad, readings.theta_rad)
    return linear_fit(readings.strain, F), np.zeros(readings.strain.shape[1])


def _affine(readings: Readings) -> Fitted:
    F = force_vector(readings.P_newtons, readings.phi_rad, readings.theta_rad)
    coefficients, *_ = np.linalg.lstsq(np.column_stack((F, np.ones(len(F)))), readings.strain, rcond=None)
    return np.linalg.pinv(coefficients[:3].T), coefficients[3]


def _full(readings: Readings) -> Fitted:
    fit = fit_calibration(readings, Model())
    return fit.C, fit.offset_strain


_METHODS: dict[str, Callable[[Readings], Fitted]] = {LINEAR: _linear, AFFINE: _affine, FULL: _full}


def _remarks(series: tuple[Series, ...]) -> list[str]:
    remarks = []
    for fitted in series:
        error_by_loads = {int(point.setting.split()[0]): point.error for point in fitted.points}
        loads, errors = np.array([pair for pair in error_by_loads.items() if pair[0] >= _MANY]).reshape(-1, 2).T
        if len(loads) >= 2:
            order = np.polyfit(np.log(loads), np.log(errors), 1)[0]
            remarks.append(
                f"{fitted.method}: {errors[-1]:.2g} N with {loads[-1]:g} loads; from {_MANY} loads on the error goes "
                f"as N^{order:.2f}, where independent noise alone gives N^-0.5."
            )
    return remarks
