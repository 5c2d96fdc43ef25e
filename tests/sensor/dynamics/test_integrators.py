"""Every comparison integrator: its order, its limits, the same answer as the exact one in the end."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import respond
from tipforce.sensor.dynamics.model import Modes, modes
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce_lab.dynamics.impact import Striker, impact
from tipforce_lab.dynamics.integrators import (
    SCIPY_METHODS,
    Load,
    Problem,
    Wave,
    closed_form,
    generalised_alpha,
    newmark,
    no_load,
    rk4_stability_limit,
    runge_kutta_4,
    scipy_method,
)

FloatArray = npt.NDArray[np.float64]
Fixed = Callable[[Problem, Load, FloatArray], FloatArray]

BODY = modes(FABRICATED, 0.01)
F = np.array([1.0, 0.5, -0.3])
FIXED: list[tuple[str, Fixed, float]] = [
    ("newmark", newmark, 2.0),
    ("alpha 0", lambda problem, load, t: generalised_alpha(problem, load, t, 0.0), 2.0),
    ("alpha 0.8", generalised_alpha, 2.0),
    ("rk4", runge_kutta_4, 4.0),
]


BELL = Wave(F, 0.5, -0.5, 0.0, 25.0)


@pytest.mark.parametrize(("name", "method", "order"), FIXED, ids=[row[0] for row in FIXED])
def test_each_has_its_order(name: str, method: Fixed, order: float) -> None:
    errors = []
    for n in (800, 1600, 3200):
        t = np.linspace(0.0, 0.04, n + 1)
        errors.append(np.abs(method(Problem(BODY), BELL, t) - closed_form(BODY, BELL, t)).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([order, order], abs=0.15), name


@pytest.mark.parametrize("method", SCIPY_METHODS)
def test_scipy_methods_come_as_near_as_they_are_told(method: str) -> None:
    t = np.linspace(0.0, 0.04, 41)
    wanted = closed_form(BODY, BELL, t)
    rough, fine = (scipy_method(Problem(BODY), BELL, t, method, rtol) for rtol in (1e-5, 1e-9))
    errors = [np.abs(run - wanted).max() for run in (rough, fine)]
    assert errors[1] < 1e-5
    assert errors[1] < 1e-2 * errors[0]


@pytest.mark.parametrize("zeta", [0.0, 0.05, 0.3, 0.9, 1.0, 3.0])
def test_the_stability_limit_found_by_running_is_the_theorys(zeta: float) -> None:
    """One mode, kicked: bisection on the step between runs that die out or stay, and runs that grow."""
    one = Modes(
        np.ones(1), np.array([zeta]), np.array([[1.0, 0.0, 0.0]]), np.array([[1.0], [0], [0]]), np.zeros((3, 1))
    )

    def grows(x: float) -> bool:
        # A constant load excites every mode; over a growing number of steps only what is unstable doubles again.
        run = runge_kutta_4(Problem(one), lambda _: np.array([1.0, 0.0, 0.0]), np.arange(801) * x)
        off = np.abs(run[:, 0] - 1.0)
        early, late = off[300:400].max(), off[700:801].max()
        return not late <= 1.0000001 * max(early, 1e-9)

    low, high = 0.3, 4.0
    assert not grows(low)
    assert grows(high)
    while high - low > 2e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    assert rk4_stability_limit(zeta) == pytest.approx(high, rel=2e-3)


def test_the_known_limits_of_rk4() -> None:
    assert rk4_stability_limit(0.0) == pytest.approx(2.0 * math.sqrt(2.0), rel=1e-12)
    assert rk4_stability_limit(1.0) == pytest.approx(2.785293563405282, rel=1e-9)
    fast = 3.0 + math.sqrt(8.0)
    assert rk4_stability_limit(3.0) == pytest.approx(2.785293563405282 / fast, rel=1e-9)


def test_newmark_keeps_the_energy_and_alpha_removes_fast_modes() -> None:
    stiff = modes(FABRICATED, beam_density_kg_m3=7850.0)
    t = np.arange(2001) * 1e-3

    def jump(time_s: float) -> FloatArray:
        return F * min(time_s / 1e-3, 1.0)

    kept = newmark(Problem(stiff), jump, t)
    removed = generalised_alpha(Problem(stiff), jump, t, 0.5)
    assert np.abs(np.diff(kept[-200:], axis=0)).max() > 5.0 * np.abs(np.diff(removed[-200:], axis=0)).max()


@pytest.mark.parametrize(("name", "method", "order"), FIXED, ids=[row[0] for row in FIXED])
def test_all_come_to_the_exact_impact(name: str, method: Fixed, order: float) -> None:
    striker = Striker(0.01, 0.3, 1e6)
    t = np.linspace(0.0, 5e-3, 20001)
    wanted = impact(BODY, striker, 5e-3, t[::400]).elastic_newtons
    found = method(Problem(BODY, striker), no_load, t)[::400]
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max(), (name, order)


@pytest.mark.parametrize("method", SCIPY_METHODS)
def test_scipy_comes_to_the_exact_impact(method: str) -> None:
    striker = Striker(0.01, 0.3, 1e6)
    t = np.linspace(0.0, 5e-3, 51)
    wanted = impact(BODY, striker, 5e-3, t).elastic_newtons
    found = scipy_method(Problem(BODY, striker), no_load, t, method, 1e-8)
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()


def test_the_closed_solutions_agree_with_each_other() -> None:
    t = np.linspace(0.0, 0.05, 5001)
    pulse = np.outer(np.where(t <= 0.01, np.sin(math.pi * t / 0.01), 0.0), F)
    found = closed_form(BODY, Wave(F, 0.0, 0.0, 1.0, 50.0, 0.01), t)
    np.testing.assert_allclose(respond(BODY, pulse, 1e-5).elastic_newtons, found, rtol=0.0, atol=5e-6)


def test_what_is_refused() -> None:
    problem = Problem(BODY)
    with pytest.raises(InputError, match="equally spaced"):
        newmark(problem, no_load, [0.0, 1.0, 3.0])
    with pytest.raises(InputError, match="rho_inf"):
        generalised_alpha(problem, no_load, [0.0, 1.0], 2.0)
    with pytest.raises(InputError, match="method"):
        scipy_method(problem, no_load, [0.0, 1.0], "Euler", 1e-3)
    with pytest.raises(InputError, match="linear contact"):
        Problem(BODY, Striker(0.01, 1.0, 1e6, 1.5))
    with pytest.raises(InputError, match="finite mass"):
        newmark(Problem(BODY, Striker(math.inf, 1.0, 1e6)), no_load, [0.0, 1.0])
