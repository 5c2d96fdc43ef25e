"""Integrators of the structure: error against run time for a smooth load, a step, a tap and a stiff impact."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor import FABRICATED, Geometry, respond
from tipforce.sensor.dynamics.model import STEEL_DENSITY, beam_mass_matrix, compliances, half_cylinder, modes
from tipforce.sensor.structure.plane_frame import Frame
from tipforce_lab.dynamics import integrators
from tipforce_lab.dynamics.impact import Striker, impact
from tipforce_lab.dynamics.integrators import Load, Problem, Wave, no_load
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, series_of, timed_together

_SAMPLES = 40
_FORCE = np.array([1.0, 0.5, -0.3])
_DAMPING = 0.01
_STRIKER = Striker(0.01, 0.3, 1e7)
_ENOUGH = 1e-3
"""Of the largest force: below what calibrated gauges resolve."""
_FIXED: dict[str, Callable[[Problem, Load, FloatArray], FloatArray]] = {
    "RK4": integrators.runge_kutta_4,
    "Newmark": integrators.newmark,
    "generalised-alpha 0.8": integrators.generalised_alpha,
}
_SUBSTEPS: dict[bool, tuple[int, ...]] = {True: (1, 4, 16), False: (1, 2, 4, 8, 16, 32, 64, 128)}
_TOLERANCES: dict[bool, tuple[float, ...]] = {True: (1e-4, 1e-7), False: (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)}
"""By ``Effort.quick``."""
Run = Callable[[], FloatArray]


@dataclass(frozen=True, slots=True)
class Task:
    """One load, or one impact, on one structure."""

    key: str
    title: str
    need: str
    duration_s: float
    problem: Problem
    load: Load
    wanted: FloatArray
    reference: str
    reference_error: float

    def times(self, substeps: int = 1) -> FloatArray:
        """Return the ends of the steps of a fixed step, (_SAMPLES substeps + 1,)."""
        return np.linspace(0.0, self.duration_s, _SAMPLES * substeps + 1)


def _waved(
    key: str, title: str, need: str, duration_s: float, wave: Wave, reference: str, beam_density: float = 0.0
) -> Task:
    body = modes(FABRICATED, _DAMPING, beam_density_kg_m3=beam_density)
    wanted = integrators.closed_form(body, wave, np.linspace(0.0, duration_s, _SAMPLES + 1))
    return Task(f"integrators-{key}", title, need, duration_s, Problem(body), wave, wanted, reference, 1e-14)


def struck() -> Task:
    """Return the task of the impact; its reference's error is that of the same run with other steps."""
    body, duration_s = modes(FABRICATED, _DAMPING), 4e-3
    t = np.linspace(0.0, duration_s, _SAMPLES + 1)
    wanted = impact(body, _STRIKER, duration_s, t).elastic_newtons
    # Only the start and end times are shared.
    other = impact(body, _STRIKER, duration_s, np.sort(np.append(t, t[1:] - 0.3 * t[1]))).elastic_newtons
    error = max(relative(other[[0, *range(2, 81, 2)]], wanted), 1e-15)
    return Task(
        "integrators-impact", "A stiff impact: 10 g at 0.3 m/s, contact 1e7 N/m, damping 1 %", "simulate an impact",
        duration_s, Problem(body, _STRIKER), no_load, wanted,
        "matrix exponentials between events, the events found to rounding; its error: other steps", error,
    )  # fmt: skip


TASKS: dict[str, Callable[[], Task]] = {
    "smooth": lambda: _waved(
        "smooth", "Smooth load: one raised cosine of 40 ms, damping 1 %", "simulate a slowly changing load", 0.04,
        Wave(_FORCE, 0.5, -0.5, 0.0, 25.0), "steady state and free motion in closed form",
    ),
    "step": lambda: _waved(  # the mass of the beams makes it stiff
        "step", "A step of the load, beams with mass (modes from 92 Hz to 77 kHz), damping 1 %",
        "simulate a sudden load on a stiff structure", 0.02,
        Wave(_FORCE, 1.0, 0.0, 0.0, 0.0), "free motion in closed form, from 0 to each time", STEEL_DENSITY,
    ),
    "tap": lambda: _waved(
        "tap", "A tap: half a sine of 1 ms, then 19 ms of ringing, damping 1 %", "simulate a tap", 0.02,
        Wave(_FORCE, 0.0, 0.0, 1.0, 500.0, 1e-3), "harmonic and free motion in closed form",
    ),
    "impact": struck,
}  # fmt: skip
STEPS = len(TASKS)


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return all four studies; errors are the largest error of the elastic force over its largest value."""
    results = []
    for make in TASKS.values():
        results.append(_study(make(), effort))
        advance()
    return results


def checked(task: Task, striker: Striker | None = None) -> FloatArray:
    """Return the reference of a task, computed independently. Raises ImportError without scipy."""
    body = checked_body(FABRICATED, _DAMPING, beams_with_mass=len(task.problem.modes.omega_rad_s) > 3)
    if isinstance(task.load, Wave):
        return checked_motion(body, task.load, task.times())
    return checked_impact(body, striker or _STRIKER, task.times())


def relative(computed: FloatArray, wanted: FloatArray) -> float:
    """Return the largest error over the largest value; of a run that grew a thousandfold it is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(computed - wanted).max() / np.abs(wanted).max())
    return error if error < 1e3 else math.inf


class _Job(NamedTuple):
    """One setting of one method. It has run once: for the error, and so that the timed runs are warm."""

    method: str
    setting: str
    run: Run
    error: float


def _study(task: Task, effort: Effort) -> Study:
    jobs, steps = _exact(task, effort), _SUBSTEPS[effort.quick]
    for name, method in _FIXED.items():
        jobs += [_job(task, name, _setting(task, n), partial(_fixed, task, method, n)) for n in steps]
    left_out, check, difference = {}, "", None
    try:
        difference = relative(checked(task), task.wanted)
    except ImportError:
        left_out = dict.fromkeys(integrators.SCIPY_METHODS, "scipy is not installed: pip install 'tipforce[science]'")
    else:
        check = _CHECK if isinstance(task.load, Wave) else _CHECK_OF_IMPACT
        for name in integrators.SCIPY_METHODS:
            jobs += _adaptive(task, effort, name)
    at_least_s = 0.004 if effort.quick else 0.02
    timings = timed_together([job.run for job in jobs], effort, task.duration_s, at_least_s, warm=True)
    points = [Point(job.setting, job.error, timing) for job, timing in zip(jobs, timings, strict=True)]
    series = series_of(zip((job.method for job in jobs), points, strict=True))
    return Study(
        task.key, task.title, "largest error of the elastic force over its largest value", "s per simulated second",
        task.reference, task.reference_error, series, left_out, tuple(_remarks(task, series)),
        (Need(f"{task.need}, to {100.0 * _ENOUGH:g} %", _ENOUGH),), check, difference,
    )  # fmt: skip


def _exact(task: Task, effort: Effort) -> list[_Job]:
    """Return the jobs of the product's own method. The events are the reference: their error is that of it."""
    if isinstance(task.load, Wave):
        return [
            _job(task, "held step (exact)", _setting(task, n), partial(_held, task, n)) for n in _SUBSTEPS[effort.quick]
        ]
    run = partial(impact, task.problem.modes, _STRIKER, task.duration_s, task.times())
    job = _job(task, "events (exact)", "the reference", lambda: run().elastic_newtons)
    return [job._replace(error=max(job.error, task.reference_error))]


def _job(task: Task, method: str, setting: str, run: Run) -> _Job:
    return _Job(method, setting, run, relative(run(), task.wanted))


def _held(task: Task, substeps: int) -> FloatArray:
    """Run the held step with the sampling of the load, which its user needs, too: that is part of the time."""
    loads = np.array([task.load(time_s) for time_s in task.times(substeps).tolist()])
    return respond(task.problem.modes, loads, task.duration_s / (_SAMPLES * substeps)).elastic_newtons[::substeps]


def _fixed(task: Task, method: Callable[[Problem, Load, FloatArray], FloatArray], substeps: int) -> FloatArray:
    return method(task.problem, task.load, task.times(substeps))[::substeps]


def _adaptive(task: Task, effort: Effort, name: str) -> list[_Job]:
    """Return the jobs of a method by tolerance, up to the first one that takes long."""
    jobs = []
    for rtol in _TOLERANCES[effort.quick]:
        started = time.process_time()
        run = partial(integrators.scipy_method, task.problem, task.load, task.times(), name, rtol)
        jobs.append(_job(task, name, f"rtol {rtol:g}", run))
        if time.process_time() - started > (0.05 if effort.quick else 0.5):
            break  # the next tolerance takes several times as long
    return jobs


def _setting(task: Task, substeps: int) -> str:
    return f"step {1e6 * task.duration_s / _SAMPLES / substeps:.4g} us"


def _remarks(task: Task, series: Sequence[Series]) -> list[str]:
    problem = task.problem
    contact = 0.0 if problem.push is None else problem.stiffness * np.outer(problem.push, problem.closure)
    poles = np.linalg.eigvals(problem.A + contact)
    fastest = complex(poles[np.abs(poles).argmax()])
    limit_us = 1e6 * integrators.rk4_stability_limit(max(-fastest.real, 0.0) / abs(fastest)) / abs(fastest)
    when = "" if problem.push is None else " while in contact"
    remarks = [f"RK4's stability limit by theory, for the fastest mode{when}, is a step of {limit_us:.4g} us."]
    for method in series:
        unstable = [point.setting for point in method.points if math.isinf(point.error)]
        if unstable:
            remarks.append(
                f"{method.method} is unstable at {', '.join(unstable)}: the error grows a thousandfold or more."
            )
    if task.key == "integrators-step" and all(point.error < 1e-9 for point in series[0].points):
        remarks.append("The held step is exact at every step: a constant load is a straight line.")
    return remarks


# Independent references: mass and stiffness matrices with scipy, nothing of the project's dynamics. Shared with the
# studied code are the masses and the compliances of the structure alone, which other tests prove. Modes, damping,
# motion and contact are computed here again, by scipy.linalg and scipy.integrate.

_CHECK = "scipy: mass and stiffness matrices, eigh, expm of the motion together with its load"
_CHECK_OF_IMPACT = "scipy: mass and stiffness matrices, eigh, DOP853 (rtol 1e-13) from contact to contact"


class CheckedBody(NamedTuple):
    """M y'' + D y' + K y = load F; elastic force = output y."""

    rate: FloatArray
    """(2 n, 2 n): of (y, y')."""
    push: FloatArray
    """(2 n, 3): acceleration per newton of F."""
    output: FloatArray
    """(3, 2 n)."""


def checked_body(geometry: Geometry, damping_ratio: float, beams_with_mass: bool) -> CheckedBody:
    """Return the tip on its beams; with mass in the beams the joint's motion is a second set of unknowns."""
    from scipy import linalg

    arms, vertical = compliances(Frame(geometry))
    tip = half_cylinder(geometry).matrix(geometry.r_m)
    if beams_with_mass:
        M = np.kron(np.ones((2, 2)), tip) + beam_mass_matrix(geometry, STEEL_DENSITY)
        K = linalg.block_diag(linalg.inv(vertical), linalg.inv(arms))
        load, output = np.vstack([np.eye(3), np.eye(3)]), np.hstack([np.zeros((3, 3)), linalg.inv(arms)])
    else:
        M, K = tip, linalg.inv(arms + vertical)
        load, output = np.eye(3), K
    omega2, shapes = linalg.eigh(K, M)
    n, inverse = len(M), linalg.inv(M)
    D = M @ shapes @ np.diag(2.0 * damping_ratio * np.sqrt(omega2)) @ shapes.T @ M
    rate = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    push = np.vstack([np.zeros((n, 3)), inverse @ load])
    return CheckedBody(rate, push, np.hstack([output, np.zeros((3, n))]))


def checked_motion(driven_body: CheckedBody, wave: Wave, times_s: FloatArray) -> FloatArray:
    """Return the elastic force (m, 3) from rest under a wave, at equal steps from 0; its end is one of the times."""
    from scipy.linalg import expm

    n, w = len(driven_body.rate), 2.0 * math.pi * wave.frequency_hz
    shape = np.outer(wave.force, [wave.mean, wave.cosine, wave.sine])
    # The load is shape @ (1, c, s), the states of a generator that turns: c' = -w s, s' = w c.
    turning = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -w], [0.0, w, 0.0]])
    step_s, across = float(times_s[1] - times_s[0]), []
    for acting in (shape, 0.0 * shape):
        together = np.block([[driven_body.rate, driven_body.push @ acting], [np.zeros((3, n)), turning]])
        across.append(expm(together * step_s))
    X = np.append(np.zeros(n), [1.0, 1.0, 0.0])
    elastic = [driven_body.output @ X[:n]]
    for time_s in times_s[1:]:
        X = across[int(time_s > wave.until_s * (1.0 + 1e-9))] @ X
        elastic.append(driven_body.output @ X[:n])
    return np.array(elastic)


def checked_impact(struck_body: CheckedBody, striker: Striker, times_s: FloatArray) -> FloatArray:
    """Return the elastic force after a body with a linear contact meets the tip; states: (y, y', overlap, speed)."""
    from scipy.integrate import solve_ivp

    n = len(struck_body.rate)
    half = n // 2
    along = striker.direction
    pull = struck_body.push @ along  # of the structure, per newton of contact force

    def rate(_t: float, X: FloatArray) -> FloatArray:
        force = striker.stiffness * X[n] if closed else 0.0
        tip = along @ X[half:n]
        return np.concatenate([struck_body.rate @ X[:n] + pull * force, [X[n + 1] - tip, -force / striker.mass_kg]])

    def edge(_t: float, X: FloatArray) -> float:
        return float(X[n])

    edge.terminal = True  # type: ignore[attr-defined]
    X, t, closed, done = np.append(np.zeros(n), [0.0, striker.speed_m_s]), 0.0, True, 1
    elastic = np.zeros((len(times_s), 3))
    scale = striker.speed_m_s * math.sqrt(striker.mass_kg / striker.stiffness)
    while done < len(times_s):
        edge.direction = -1.0 if closed else 1.0  # type: ignore[attr-defined]
        run = solve_ivp(
            rate, (t, float(times_s[-1])), X, "DOP853", dense_output=True, events=edge, rtol=1e-13, atol=1e-13 * scale
        )
        reached = times_s <= run.t[-1] * (1.0 + 1e-15)
        for k in range(done, int(reached.sum())):
            elastic[k] = struck_body.output @ run.sol(times_s[k])[:n]
        done = max(done, int(reached.sum()))
        t, X, closed = float(run.t[-1]), run.y[:, -1], not closed
        X[n] = 0.0
    return elastic
