"""Integrators of the structure: error against run time for a smooth load, a step, a tap and a stiff impact."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tipforce_tools.report.study import Effort, Point, Series, Study, Timing, timed

if TYPE_CHECKING:
    from tipforce.arrays import FloatArray
    from tipforce.sensor.dynamics.integrators import Load, Problem


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
    """Substeps between samples -> elastic forces at the samples by the held step; None where it does not apply."""
    exact: Callable[[], FloatArray] | None
    """A method without a setting."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Run all four; errors are the largest error of the elastic force over its largest value."""
    found = []
    for task in (_smooth, _step, _tap, _impact):
        found.append(_study(task(), effort))
        advance()
    return found


def _smooth() -> _Task:
    import numpy as np

    from tipforce.sensor.dynamics import exact
    from tipforce.sensor.dynamics.integrators import Problem
    from tipforce.sensor.dynamics.model import modes
    from tipforce.sensor.structure.geometry import FABRICATED

    body, F, duration = modes(FABRICATED, 0.01), np.array(_FORCE), 0.04
    t = np.linspace(0.0, duration, _SAMPLES + 1)

    def load(time_s: float) -> FloatArray:
        bell: FloatArray = F * (0.5 - 0.5 * math.cos(2.0 * math.pi * time_s / duration))
        return bell

    return _Task(
        "integrators-smooth", "Smooth load: one raised cosine of 40 ms, damping 1 %", Problem(body), load, duration, t,
        exact.raised_cosine(body, F, duration, t), "steady state and free motion in closed form", 1e-14,
        _held(body, load, duration), None,
    )  # fmt: skip


def _step() -> _Task:
    import numpy as np

    from tipforce.sensor.dynamics import exact
    from tipforce.sensor.dynamics.integrators import Problem
    from tipforce.sensor.dynamics.model import STEEL_DENSITY, modes
    from tipforce.sensor.structure.geometry import FABRICATED

    # The mass of the beams adds modes to 77 kHz: stiff.
    body, F, duration = modes(FABRICATED, 0.01, beam_density_kg_m3=STEEL_DENSITY), np.array(_FORCE), 0.02
    t = np.linspace(0.0, duration, _SAMPLES + 1)

    def load(time_s: float) -> FloatArray:
        del time_s
        return F

    return _Task(
        "integrators-step", "A step of the load, beams with mass (modes from 92 Hz to 77 kHz), damping 1 %",
        Problem(body), load, duration, t, exact.step(body, F, t), "free motion in closed form, from 0 to each time",
        1e-14, _held(body, load, duration), None,
    )  # fmt: skip


def _tap() -> _Task:
    import numpy as np

    from tipforce.sensor.dynamics import exact
    from tipforce.sensor.dynamics.integrators import Problem
    from tipforce.sensor.dynamics.model import modes
    from tipforce.sensor.structure.geometry import FABRICATED

    body, F, duration, tap = modes(FABRICATED, 0.01), np.array(_FORCE), 0.02, 1e-3
    t = np.linspace(0.0, duration, _SAMPLES + 1)

    def load(time_s: float) -> FloatArray:
        pulse: FloatArray = F * (math.sin(math.pi * time_s / tap) if time_s < tap else 0.0)
        return pulse

    return _Task(
        "integrators-tap", "A tap: half a sine of 1 ms, then 19 ms of ringing, damping 1 %", Problem(body), load,
        duration, t, exact.half_sine(body, F, tap, t), "harmonic and free motion in closed form", 1e-14,
        _held(body, load, duration), None,
    )  # fmt: skip


def _impact() -> _Task:
    import numpy as np

    from tipforce.sensor.dynamics.assembly import Striker
    from tipforce.sensor.dynamics.impact import impact
    from tipforce.sensor.dynamics.integrators import Problem, no_load
    from tipforce.sensor.dynamics.model import modes
    from tipforce.sensor.structure.geometry import FABRICATED

    body, striker, duration = modes(FABRICATED, 0.01), Striker(0.01, 0.3, 1e7), 4e-3
    t = np.linspace(0.0, duration, _SAMPLES + 1)
    wanted = impact(body, striker, duration, t).elastic_newtons
    # The same run by another way through time: only the times of begin and end are shared.
    other = impact(body, striker, duration, np.sort(np.append(t, t[1:] - 0.3 * t[1]))).elastic_newtons[
        [0, *range(2, 81, 2)]
    ]
    error = max(float(np.abs(other - wanted).max() / np.abs(wanted).max()), 1e-15)
    return _Task(
        "integrators-impact", "A stiff impact: 10 g at 0.3 m/s, contact 1e7 N/m, damping 1 %",
        Problem(body, striker), no_load, duration, t, wanted,
        "matrix exponentials between events, the events found to rounding; its error: other steps",
        error, None,
        lambda: impact(body, striker, duration, t).elastic_newtons,
    )  # fmt: skip


def _held(body: object, load: Load, duration_s: float) -> Callable[[int], FloatArray]:
    """The held step, sampling the load itself as its user must: that is part of the time."""
    import numpy as np

    from tipforce.sensor.dynamics.first_order_hold import respond
    from tipforce.sensor.dynamics.model import Modes

    assert isinstance(body, Modes)

    def run(substeps: int) -> FloatArray:
        steps = _SAMPLES * substeps
        loads = np.array([load(duration_s * k / steps) for k in range(steps + 1)])
        return respond(body, loads, duration_s / steps).elastic_newtons[::substeps]

    return run


def _study(task: _Task, effort: Effort) -> Study:
    series, left_out = [], {}
    if task.held is not None:
        held = task.held
        series.append(
            Series("held step (exact)", tuple(
                _point(task, effort, _setting(task, n), lambda n=n: held(n)) for n in _substeps(effort)  # type: ignore[misc]
            ))
        )  # fmt: skip
    if task.exact is not None:
        # It is the reference: its error is what the reference's own is.
        itself = _point(task, effort, "the reference", task.exact)
        series.append(Series("events (exact)", (replace(itself, error=max(itself.error, task.reference_error)),)))
    series += [_fixed(task, effort, name) for name in _FIXED]
    try:
        import scipy.integrate  # noqa: F401
    except ImportError:
        left_out = dict.fromkeys(_ADAPTIVE, "scipy is not installed: pip install 'tipforce[science]'")
    else:
        series += [_adaptive(task, effort, name) for name in _ADAPTIVE]
    return Study(
        task.key, task.title, "largest error of the elastic force over its largest value", "s per simulated second",
        task.reference, task.reference_error, tuple(series), left_out, tuple(_remarks(task, series)),
    )  # fmt: skip


def _substeps(effort: Effort) -> tuple[int, ...]:
    return (1, 4, 16) if effort.quick else (1, 2, 4, 8, 16, 32, 64, 128)


def _tolerances(effort: Effort) -> tuple[float, ...]:
    return (1e-4, 1e-7) if effort.quick else (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)


def _fixed(task: _Task, effort: Effort, name: str) -> Series:
    import numpy as np

    from tipforce.sensor.dynamics.integrators import generalised_alpha, newmark, runge_kutta_4

    method = {"RK4": runge_kutta_4, "Newmark": newmark}.get(name, generalised_alpha)

    def run(n: int) -> FloatArray:
        t = np.linspace(0.0, task.duration_s, _SAMPLES * n + 1)
        return method(task.problem, task.load, t).elastic_newtons[::n]

    return Series(
        name, tuple(_point(task, effort, _setting(task, n), lambda n=n: run(n)) for n in _substeps(effort))  # type: ignore[misc]
    )  # fmt: skip


def _adaptive(task: _Task, effort: Effort, name: str) -> Series:
    from tipforce.sensor.dynamics.integrators import scipy_method

    def run(rtol: float) -> FloatArray:
        return scipy_method(task.problem, task.load, task.times_s, name, rtol).elastic_newtons

    points, spent_s = [], 0.0
    for rtol in _tolerances(effort):
        points.append(_point(task, effort, f"rtol {rtol:g}", lambda rtol=rtol: run(rtol)))  # type: ignore[misc]
        spent_s = points[-1].timing.seconds * task.duration_s
        if spent_s > (0.3 if effort.quick else 1.0):
            break  # the next tolerance takes several times as long
    return Series(name, tuple(points))


def _setting(task: _Task, substeps: int) -> str:
    return f"step {1e6 * task.duration_s / _SAMPLES / substeps:.4g} us"


def _point(task: _Task, effort: Effort, setting: str, run: Callable[[], FloatArray]) -> Point:
    import numpy as np

    started = time.perf_counter_ns()
    found = run()
    once_s = (time.perf_counter_ns() - started) * 1e-9
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(found - task.wanted).max() / np.abs(task.wanted).max())
    # A run that grew a thousandfold has no error worth a number; it is shown as infinite, not hidden.
    error = error if error < 1e3 else math.inf
    if once_s > (0.03 if effort.quick else 0.1):
        per_s = once_s / task.duration_s
        return Point(setting, error, Timing(per_s, per_s, per_s, 1))
    timing = timed(run, effort, at_least_s=0.004 if effort.quick else 0.02)
    scale = 1.0 / task.duration_s
    return Point(
        setting, error,
        Timing(timing.seconds * scale, timing.first_quartile_s * scale, timing.third_quartile_s * scale, timing.runs),
    )  # fmt: skip


def _remarks(task: _Task, series: list[Series]) -> list[str]:
    import numpy as np

    from tipforce.sensor.dynamics.integrators import rk4_stability_limit

    problem = task.problem
    contact = 0.0 if problem.push is None else problem.stiffness * np.outer(problem.push, problem.closure)
    poles = np.linalg.eigvals(problem.A + contact)
    fastest = complex(poles[np.abs(poles).argmax()])
    limit_us = 1e6 * rk4_stability_limit(max(-fastest.real, 0.0) / abs(fastest)) / abs(fastest)
    found = [f"RK4's stability limit by theory, for the fastest mode while in contact, is a step of {limit_us:.4g} us."]
    if problem.push is None:
        found = [f"RK4's stability limit by theory, for the fastest mode, is a step of {limit_us:.4g} us."]
    for one in series:
        unstable = [point.setting for point in one.points if math.isinf(point.error)]
        if unstable:
            found.append(f"{one.method} is unstable at {', '.join(unstable)}: the error grows a thousandfold or more.")
    good = [(p.timing.seconds, one.method, p) for one in series for p in one.points if p.error <= 1e-3]
    if good:
        seconds, method, point = min(good, key=lambda row: row[0])
        found.append(
            f"{method} ({point.setting}) reaches 1e-3 with the least time, {seconds:.2g} s per simulated second."
        )
    if task.key == "integrators-step" and all(p.error < 1e-9 for p in series[0].points):
        found.append("The held step is exact at every step: a load that stands is a straight line.")
    return found
