"""Integrators for comparison beyond their range of validity: their failures must not look like results."""

from __future__ import annotations

import numpy as np

from stability.case import Case, Observed
from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import modes
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce_lab.dynamics import integrators


def cases() -> list[Case]:
    """Return the cases of this area."""
    return [
        Case("integrator.rk4_unstable", "RK4 with steps 1 % below and 1 % above its limit, undamped, 8000 steps",
             "flagged", "below the limit it decays, above it grows past 1e10 or becomes infinite: it cannot be taken "
             "for a result", _rk4),
        Case("integrator.implicit_long_steps", "Newmark and generalised-alpha with steps of 1000 periods", "bounded",
             "the response to a step load stays below twice the static one: stable, though not exact", _implicit),
        Case("integrator.times_impossible", "times that are equal, fall, or are NaN, or a single one", "refused",
             "InputError of every method says that times must rise strictly", _times),
    ]  # fmt: skip


def _rk4() -> Observed:
    found = modes(FABRICATED)
    problem = integrators.Problem(found)
    limit = integrators.rk4_stability_limit(0.0) / float(found.omega_rad_s[-1])
    sizes = []
    for factor in (0.99, 1.01, 100.0):
        t = np.arange(8001 if factor < 2 else 200) * limit * factor
        with np.errstate(over="ignore", invalid="ignore"):
            end = integrators.runge_kutta_4(problem, _impulse(limit), t).elastic_newtons[-1]
        sizes.append(float(np.abs(end).max()))
    held = sizes[0] < 10.0 and all(not size < 1e10 for size in sizes[1:])
    return Observed(held, f"end at 0.99, 1.01 and 100 times the limit: {', '.join(f'{size:.2g}' for size in sizes)} N")


def _impulse(until_s: float) -> integrators.Load:
    """Return 1 N along F1 and F3 until a time, then 0."""
    return lambda time_s: np.array([1.0, 0.0, 1.0]) * (time_s < until_s)


def _implicit() -> Observed:
    found, largest = modes(FABRICATED), []
    t = np.arange(2001) * 1000.0 / float(found.frequency_hz[0])
    for method in (integrators.newmark, integrators.generalised_alpha):
        elastic = method(integrators.Problem(found), lambda _time_s: np.array([1.0, 0.0, 1.0]), t).elastic_newtons
        largest.append(float(np.abs(elastic).max()))
    return Observed(
        max(largest) <= 2.0 + 1e-6, f"largest elastic force {largest[0]:.3f} and {largest[1]:.3f} N for 1 N"
    )


def _times() -> Observed:
    problem, refused = integrators.Problem(modes(FABRICATED)), 0
    wrong = ([0.0, 1e-4, 1e-4], [0.0, 2e-4, 1e-4], [0.0, float("nan"), 1.0], [0.0])
    methods = (integrators.runge_kutta_4, integrators.newmark, integrators.generalised_alpha)
    for t in wrong:
        for method in methods:
            try:
                method(problem, integrators.no_load, t)
            except InputError as error:
                refused += "rise strictly" in str(error)
    return Observed(refused == len(wrong) * len(methods), f"{refused} of {len(wrong) * len(methods)} refused")
