"""Integrators of the structure: error against run time for a smooth load, a step, a tap and a stiff impact."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tipforce_lab.report.study import Effort, Need, Point, Series, Study, Timing, timed_together

if TYPE_CHECKING:
    from tipforce.arrays import FloatArray
    from tipforce.sensor.dynamics.model import Modes
    from tipforce_lab.dynamics.integrators import Load, Problem


STEPS = 4
"""One for each study."""

_SAMPLES = 40
_FORCE = (1.0, 0.5, -0.3)
_FIXED = ("RK4", "Newmark", "generalised-alpha 0.8")
_ADAPTIVE = ("Radau", "BDF", "LSODA", "DOP853")


@dataclass(frozen=True, slots=True)
class _Task:
    """One load on one structure."""

    key: str
    title: str
    problem: Problem
    load: Load
    duration_s: float
    times_s: FloatArray
    wanted: FloatArray
    reference: str
    reference_error: float
    held: Callable[[int], FloatArray] | None
    """Substeps between samples -> elastic forces at the samples by the held step; None if it does not apply."""
    exact: Callable[[], FloatArray] | None
    """A method without a setting."""
    need: str
    check: Callable[[], FloatArray]
    """The reference, computed independently."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return all four studies; errors are the largest error of the elastic force over its largest value."""
    found = []
    for task in (_smooth, _step, _tap, _impact):
        found.append(_study(task(), effort))
        advance()
    return found


_ENOUGH = 1e-3
"""Of the largest force: below what calibrated gauges resolve."""
_DAMPING = 0.01


def _checked(name: str, beams_with_mass: bool, *words: object) -> FloatArray:
    """Return a reference of integrator_check for the fabricated body. Raises ImportError without scipy."""
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce_lab.report.studies import integrator_check

    body = integrator_check.body(FABRICATED, _DAMPING, beams_with_mass)
    computed: FloatArray = getattr(integrator_check, name)(body, *words)
    return computed


def _smooth() -> _Task:
    duration = 0.04
    return _loaded(
        "integrators-smooth", "Smooth load: one raised cosine of 40 ms, damping 1 %", duration,
        lambda time_s: 0.5 - 0.5 * math.cos(2.0 * math.pi * time_s / duration),
        "raised_cosine", (duration,), "steady state and free motion in closed form",
        "simulate a slowly changing load", "smooth", (),
    )  # fmt: skip


def _step() -> _Task:
    return _loaded(
        "integrators-step", "A step of the load, beams with mass (modes from 92 Hz to 77 kHz), damping 1 %", 0.02,
        lambda _time_s: 1.0, "step", (), "free motion in closed form, from 0 to each time",
        "simulate a sudden load on a stiff structure", "step", (), beams_with_mass=True,
    )  # fmt: skip


def _tap() -> _Task:
    tap = 1e-3
    return _loaded(
        "integrators-tap", "A tap: half a sine of 1 ms, then 19 ms of ringing, damping 1 %", 0.02,
        lambda time_s: math.sin(math.pi * time_s / tap) if time_s < tap else 0.0,
        "half_sine", (tap,), "harmonic and free motion in closed form", "simulate a tap", "half_sine", (tap,),
    )  # fmt: skip


def _loaded(
    key: str, title: str, duration_s: float, factor: Callable[[float], float], closed_form: str,
    sizes: tuple[float, ...], reference: str, need: str, check: str, check_sizes: tuple[float, ...],
    beams_with_mass: bool = False,
) -> _Task:  # fmt: skip
    """Return the task of a load that is a factor times one force; its reference is a closed form of integrators.py."""
    import numpy as np

    from tipforce.sensor.dynamics.model import STEEL_DENSITY, modes
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce_lab.dynamics import integrators

    # The mass of the beams adds modes to 77 kHz: stiff.
    body = modes(FABRICATED, _DAMPING, beam_density_kg_m3=STEEL_DENSITY if beams_with_mass else 0.0)
    F, t = np.array(_FORCE), np.linspace(0.0, duration_s, _SAMPLES + 1)

    def load(time_s: float) -> FloatArray:
        force: FloatArray = F * factor(time_s)
        return force

    return _Task(
        key, title, integrators.Problem(body), load, duration_s, t,
        getattr(integrators, closed_form)(body, F, *sizes, t), reference, 1e-14, _held(body, load, duration_s), None,
        need, lambda: _checked(check, beams_with_mass, F, *check_sizes, t),
    )  # fmt: skip


def _impact() -> _Task:
    import numpy as np

    from tipforce.sensor.dynamics.model import modes
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce_lab.dynamics.impact import Striker, impact
    from tipforce_lab.dynamics.integrators import Problem, no_load

    body, striker, duration = modes(FABRICATED, _DAMPING), Striker(0.01, 0.3, 1e7), 4e-3
    t = np.linspace(0.0, duration, _SAMPLES + 1)
    wanted = impact(body, striker, duration, t).elastic_newtons
    # The same run with other time steps: only the start and end times are shared.
    other = impact(body, striker, duration, np.sort(np.append(t, t[1:] - 0.3 * t[1]))).elastic_newtons[
        [0, *range(2, 81, 2)]
    ]
    error = max(float(np.abs(other - wanted).max() / np.abs(wanted).max()), 1e-15)
    return _Task(
        "integrators-impact", "A stiff impact: 10 g at 0.3 m/s, contact 1e7 N/m, damping 1 %",
        Problem(body, striker), no_load, duration, t, wanted,
        "matrix exponentials between events, the events found to rounding; its error: other steps",
        error, None,
        lambda: impact(body, striker, duration, t).elastic_newtons, "simulate an impact",
        lambda: _checked("struck", False, striker, t),
    )  # fmt: skip


def _held(body: Modes, load: Load, duration_s: float) -> Callable[[int], FloatArray]:
    """Run the held step with the sampling of the load, which its user needs, too: that is part of the time."""
    import numpy as np

    from tipforce.sensor.dynamics.first_order_hold import respond

    def run(substeps: int) -> FloatArray:
        steps = _SAMPLES * substeps
        loads = np.array([load(duration_s * k / steps) for k in range(steps + 1)])
        return respond(body, loads, duration_s / steps).elastic_newtons[::substeps]

    return run


@dataclass(frozen=True, slots=True)
class _Job:
    """One setting of one method."""

    method: str
    setting: str
    run: Callable[[], FloatArray]
    error: float


def _study(task: _Task, effort: Effort) -> Study:
    jobs = [_job(task, *run) for run in _exact_runs(task, effort)]
    for name in _FIXED:
        jobs += [_job(task, name, _setting(task, n), _fixed(task, name, n)) for n in _substeps(effort)]
    left_out, check, difference = {}, "", None
    try:
        from tipforce_lab.report.studies import integrator_check
    except ImportError:
        left_out = dict.fromkeys(_ADAPTIVE, "scipy is not installed: pip install 'tipforce[science]'")
    else:
        check = integrator_check.METHOD_OF_IMPACT if task.problem.push is not None else integrator_check.METHOD
        difference = _relative(task.check(), task.wanted)
        for name in _ADAPTIVE:
            jobs += _adaptive(task, effort, name)
    series = _timed(task, effort, jobs)
    return Study(
        task.key, task.title, "largest error of the elastic force over its largest value", "s per simulated second",
        task.reference, task.reference_error, tuple(series), left_out, tuple(_remarks(task, series)),
        (Need(f"{task.need}, to {100.0 * _ENOUGH:g} %", _ENOUGH),), check, difference,
    )  # fmt: skip


def _exact_runs(task: _Task, effort: Effort) -> list[tuple[str, str, Callable[[], FloatArray]]]:
    if task.held is not None:
        held = task.held
        return [("held step (exact)", _setting(task, n), lambda n=n: held(n)) for n in _substeps(effort)]  # type: ignore[misc]
    assert task.exact is not None
    return [("events (exact)", "the reference", task.exact)]


def _job(task: _Task, method: str, setting: str, run: Callable[[], FloatArray]) -> _Job:
    """Run once: for the error, and so that the timed runs are warm."""
    return _Job(method, setting, run, _relative(run(), task.wanted))


def _timed(task: _Task, effort: Effort, jobs: Sequence[_Job]) -> list[Series]:
    """Time all settings of all methods together, and return a series per method."""
    timings = timed_together([job.run for job in jobs], effort, at_least_s=0.004 if effort.quick else 0.02, warm=True)
    found: dict[str, list[Point]] = {}
    for job, timing in zip(jobs, timings, strict=True):
        # The events are the reference: their error is that of the reference.
        error = max(job.error, task.reference_error) if job.run is task.exact else job.error
        point = Point(job.setting, error, _per_second(timing, task.duration_s))
        found.setdefault(job.method, []).append(point)
    return [Series(method, tuple(points)) for method, points in found.items()]


def _per_second(timing: Timing, duration_s: float) -> Timing:
    assert timing.cpu_seconds is not None
    return replace(
        timing, seconds=timing.seconds / duration_s, first_quartile_s=timing.first_quartile_s / duration_s,
        third_quartile_s=timing.third_quartile_s / duration_s, cpu_seconds=timing.cpu_seconds / duration_s,
    )  # fmt: skip


def _relative(computed: FloatArray, wanted: FloatArray) -> float:
    """Return the largest error over the largest value; of a run that grew a thousandfold it is infinite."""
    import numpy as np

    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(computed - wanted).max() / np.abs(wanted).max())
    return error if error < 1e3 else math.inf


def _substeps(effort: Effort) -> tuple[int, ...]:
    return (1, 4, 16) if effort.quick else (1, 2, 4, 8, 16, 32, 64, 128)


def _tolerances(effort: Effort) -> tuple[float, ...]:
    return (1e-4, 1e-7) if effort.quick else (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)


def _fixed(task: _Task, name: str, substeps: int) -> Callable[[], FloatArray]:
    import numpy as np

    from tipforce_lab.dynamics.integrators import generalised_alpha, newmark, runge_kutta_4

    method = {"RK4": runge_kutta_4, "Newmark": newmark}.get(name, generalised_alpha)
    t = np.linspace(0.0, task.duration_s, _SAMPLES * substeps + 1)
    return lambda: method(task.problem, task.load, t).elastic_newtons[::substeps]


def _adaptive(task: _Task, effort: Effort, name: str) -> list[_Job]:
    """Return the jobs of a method by tolerance, up to the first one that takes long."""
    from tipforce_lab.dynamics.integrators import scipy_method

    jobs = []
    for rtol in _tolerances(effort):
        started = time.process_time_ns()
        jobs.append(
            _job(task, name, f"rtol {rtol:g}",
                 lambda rtol=rtol: scipy_method(task.problem, task.load, task.times_s, name, rtol).elastic_newtons)  # type: ignore[misc]
        )  # fmt: skip
        if (time.process_time_ns() - started) * 1e-9 > (0.05 if effort.quick else 0.5):
            break  # the next tolerance takes several times as long
    return jobs


def _setting(task: _Task, substeps: int) -> str:
    return f"step {1e6 * task.duration_s / _SAMPLES / substeps:.4g} us"


def _remarks(task: _Task, series: list[Series]) -> list[str]:
    import numpy as np

    from tipforce_lab.dynamics.integrators import rk4_stability_limit

    problem = task.problem
    contact = 0.0 if problem.push is None else problem.stiffness * np.outer(problem.push, problem.closure)
    poles = np.linalg.eigvals(problem.A + contact)
    fastest = complex(poles[np.abs(poles).argmax()])
    limit_us = 1e6 * rk4_stability_limit(max(-fastest.real, 0.0) / abs(fastest)) / abs(fastest)
    when = "" if problem.push is None else " while in contact"
    remarks = [f"RK4's stability limit by theory, for the fastest mode{when}, is a step of {limit_us:.4g} us."]
    for method in series:
        unstable = [point.setting for point in method.points if math.isinf(point.error)]
        if unstable:
            remarks.append(
                f"{method.method} is unstable at {', '.join(unstable)}: the error grows a thousandfold or more."
            )
    if task.key == "integrators-step" and all(p.error < 1e-9 for p in series[0].points):
        remarks.append("The held step is exact at every step: a constant load is a straight line.")
    return remarks
