"""Masses, modes and the static limit; every comparison integrator: order, limits, the exact answer in the end."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import RigidBody, half_cylinder, modes
from tipforce.sensor.structure.strain import FABRICATED
from tipforce_lab.dynamics import integrators
from tipforce_lab.dynamics.impact import Striker, impact

JOINT = RigidBody(1e-9, 0.0, 1e-15)


def test_the_tip_is_a_half_cylinder() -> None:
    tip = half_cylinder(FABRICATED)
    # Sum over a grid of its cross-section, independent of the formulas.
    x, y = (np.arange(2000) + 0.5) / 1000.0 - 1.0, (np.arange(1000) + 0.5) / 1000.0
    X, Y = np.meshgrid(x, y)
    inside = X**2 + Y**2 < 1.0
    r = FABRICATED.r_m
    mass = 7850.0 * FABRICATED.width_m * r * r * inside.sum() * 1e-6
    assert tip.mass_kg == pytest.approx(mass, rel=1e-4)
    assert tip.centroid_m == pytest.approx(r * Y[inside].mean(), rel=1e-4)
    assert tip.inertia_kg_m2 == pytest.approx(mass * r * r * (X**2 + Y**2)[inside].mean(), rel=1e-4)


def test_lifting_the_tip_is_a_mode_of_its_own_with_a_known_frequency() -> None:
    g = FABRICATED
    bending = g.youngs_modulus_pascals * g.width_m * g.h1_m**3 / 12.0
    lift = g.a_m**3 / (24.0 * bending) + g.d_m / (g.youngs_modulus_pascals * g.width_m * g.h2_m)
    wanted = 1.0 / (2.0 * math.pi * math.sqrt(half_cylinder(g).mass_kg * lift))
    assert modes(g).frequency_hz[1] == pytest.approx(wanted, rel=1e-12)
    assert modes(g).frequency_hz == pytest.approx([92.73, 266.31, 470.31], abs=0.005)


def test_the_mass_of_the_beams_in_that_mode() -> None:
    # Guided beams carry 13/35 of their mass at the tip; the vertical beam, nearly unstretched, adds none.
    g = FABRICATED
    arms = 2.0 * 13.0 / 35.0 * 7850.0 * g.width_m * g.h1_m * g.a_m
    found = modes(g, beam_density_kg_m3=7850.0).frequency_hz[1] / modes(g).frequency_hz[1]
    assert found == pytest.approx(math.sqrt(1.0 / (1.0 + arms / half_cylinder(g).mass_kg)), rel=2e-4)


def test_a_joint_of_little_mass_changes_the_low_modes_little_and_adds_high_ones() -> None:
    with_joint, without = modes(FABRICATED, joint=JOINT), modes(FABRICATED)
    assert with_joint.frequency_hz[:3] == pytest.approx(without.frequency_hz, rel=1e-6)
    assert with_joint.frequency_hz[3] > 1e4 * without.frequency_hz[2]
    axial = math.sqrt(FABRICATED.youngs_modulus_pascals * FABRICATED.width_m * FABRICATED.h2_m / FABRICATED.d_m / 1e-9)
    assert np.abs(with_joint.omega_rad_s / axial - 1.0).min() < 0.05


def test_what_the_gauges_miss_by_frequency() -> None:
    undamped = modes(FABRICATED)
    assert integrators.frequency_of_error(undamped, 0.01) == pytest.approx(8.71, abs=0.01)
    # In the lowest mode's own shape: f0 sqrt(0.01 / 1.01).
    assert undamped.frequency_hz[0] * math.sqrt(0.01 / 1.01) == pytest.approx(9.23, abs=0.01)
    damped, ratio = undamped.with_damping(0.05), 30.0 / undamped.frequency_hz
    gain = 1.0 / (1.0 - ratio**2 + 2j * damped.damping_ratio * ratio)
    error = (damped.force_shape * gain) @ damped.load_shape - np.eye(3)
    assert integrators.quasi_static_error(damped, 30.0) == pytest.approx(np.linalg.norm(error, 2), rel=1e-12)
    # Damping turns the phase: the error is then of first order in the frequency.
    assert integrators.frequency_of_error(damped, 0.01) < integrators.frequency_of_error(undamped, 0.01)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (partial(modes, FABRICATED, [0.1, 0.2]), "3 modes"),
        (partial(modes, FABRICATED, beam_density_kg_m3=math.inf), "beam_density_kg_m3"),
        (partial(modes, replace(FABRICATED, h1_m=1e-130)), "too thin"),
        (partial(RigidBody, 0.0, 0.0, 1.0), "mass_kg"),
        (partial(RigidBody, 1.0, 1.0, 0.5), "about the origin"),
        (partial(integrators.frequency_of_error, modes(FABRICATED), 0.0), "allowed is above 0"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        make()


Fixed = Callable[[integrators.Problem, integrators.Load, FloatArray], FloatArray]

BODY = modes(FABRICATED, 0.01)
F = np.array([1.0, 0.5, -0.3])
FIXED: list[tuple[str, Fixed, float]] = [
    ("newmark", integrators.newmark, 2.0),
    ("alpha 0", lambda problem, load, t: integrators.generalised_alpha(problem, load, t, 0.0), 2.0),
    ("alpha 0.8", integrators.generalised_alpha, 2.0),
    ("rk4", integrators.runge_kutta_4, 4.0),
]


BELL = integrators.Wave(F, 0.5, -0.5, 0.0, 25.0)


@pytest.mark.parametrize(("name", "method", "order"), FIXED, ids=[row[0] for row in FIXED])
def test_each_has_its_order(name: str, method: Fixed, order: float) -> None:
    errors = []
    for n in (800, 1600, 3200):
        t = np.linspace(0.0, 0.04, n + 1)
        errors.append(np.abs(method(integrators.Problem(BODY), BELL, t) - integrators.closed_form(BODY, BELL, t)).max())
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([order, order], abs=0.15), name


def test_the_known_limits_of_rk4() -> None:
    assert integrators.rk4_stability_limit(0.0) == pytest.approx(2.0 * math.sqrt(2.0), rel=1e-12)
    assert integrators.rk4_stability_limit(1.0) == pytest.approx(2.785293563405282, rel=1e-9)
    fast = 3.0 + math.sqrt(8.0)
    assert integrators.rk4_stability_limit(3.0) == pytest.approx(2.785293563405282 / fast, rel=1e-9)


def test_newmark_keeps_the_energy_and_alpha_removes_fast_modes() -> None:
    stiff = modes(FABRICATED, beam_density_kg_m3=7850.0)
    t = np.arange(2001) * 1e-3

    def jump(time_s: float) -> FloatArray:
        return F * min(time_s / 1e-3, 1.0)

    kept = integrators.newmark(integrators.Problem(stiff), jump, t)
    removed = integrators.generalised_alpha(integrators.Problem(stiff), jump, t, 0.5)
    assert np.abs(np.diff(kept[-200:], axis=0)).max() > 5.0 * np.abs(np.diff(removed[-200:], axis=0)).max()


@pytest.mark.parametrize("name", [*(row[0] for row in FIXED), *integrators.SCIPY_METHODS])
def test_all_come_to_the_exact_impact(name: str) -> None:
    striker, fixed = Striker(0.01, 0.3, 1e6), {row[0]: row[1] for row in FIXED}
    t, problem = np.linspace(0.0, 5e-3, 20001), integrators.Problem(BODY, striker)
    wanted = impact(BODY, striker, 5e-3, t[::400]).elastic_newtons
    if name in fixed:
        found = fixed[name](problem, integrators.no_load, t)[::400]
    else:
        found = integrators.scipy_method(problem, integrators.no_load, t[::400], name, 1e-8)
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()
