"""Masses, modes and the static limit; thin, thick and heavy bodies; what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import Modes, RigidBody, compliances, half_cylinder, jacobi, modes
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, Frame
from tipforce_lab.dynamics.integrators import frequency_of_error, quasi_static_error

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


def static_gain(found: Modes) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    return [found.force_shape @ found.load_shape, found.vertical_force_shape @ found.load_shape]


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(st.floats(-9.0, -2.0), st.floats(-9.0, -2.0)),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.floats(0.0, 50.0),
    st.sampled_from([0.0, 7850.0]),
)
def test_the_static_limit_returns_the_applied_force(
    thickness: tuple[float, float], lengths: tuple[float, float, float], zeta: float, beam_density: float
) -> None:
    a, d, r = (15e-3 * 10.0**x for x in lengths)
    body = Geometry(a, d, r, 10.0 ** thickness[0], 10.0 ** thickness[1], 10e-3, 205e9)
    try:
        found = modes(body, zeta, beam_density_kg_m3=beam_density)
    except InputError:
        # Refused only where a very thin beam meets a thick one, or the axial modes of the mass of a thin one: of 24000
        # random bodies of these lengths the thickest one was 0.15 mm.
        thin, thick = sorted((body.h1_m, body.h2_m))
        assert thin < 2e-4 if beam_density > 0.0 else (thick / thin) ** 3 > 1e13
        return
    for gain in static_gain(found):
        np.testing.assert_allclose(gain, np.eye(3), rtol=0.0, atol=1e-12)
    assert (np.diff(found.omega_rad_s) >= 0.0).all()
    # The motion of the tip under a static force is the frame's.
    arms, vertical = compliances(Frame(body))
    np.testing.assert_allclose(
        (found.load_shape.T / found.omega_rad_s**2) @ found.load_shape,
        arms + vertical,
        rtol=0.0,
        atol=1e-7 * (arms + vertical).max(),
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 12.0))
def test_jacobi_is_exact_for_graded_matrices(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    scale = 10.0 ** (0.5 * decades * rng.uniform(-1.0, 1.0, n))
    root = np.eye(n) + 0.3 * rng.uniform(-1.0, 1.0, (n, n)) / n
    A = scale[:, np.newaxis] * (root @ root.T) * scale
    values, Q = jacobi(0.5 * (A + A.T))
    np.testing.assert_allclose(Q.T @ Q, np.eye(n), atol=1e-14)
    assert (values > 0.0).all()
    # The inverse has the inverse eigenvalues: small ones are as good as large ones.
    inverse = np.linalg.inv(root @ root.T) / scale / scale[:, np.newaxis]
    np.testing.assert_allclose(jacobi(0.5 * (inverse + inverse.T))[0][::-1], 1.0 / values, rtol=1e-12)


def test_what_the_gauges_miss_by_frequency() -> None:
    undamped = modes(FABRICATED)
    assert frequency_of_error(undamped, 0.01) == pytest.approx(8.71, abs=0.01)
    # In the lowest mode's own shape: f0 sqrt(0.01 / 1.01).
    f = undamped.frequency_hz[0] * math.sqrt(0.01 / 1.01)
    assert f == pytest.approx(9.23, abs=0.01)
    damped, ratio = undamped.with_damping(0.05), 30.0 / undamped.frequency_hz
    gain = 1.0 / (1.0 - ratio**2 + 2j * damped.damping_ratio * ratio)
    error = (damped.force_shape * gain) @ damped.load_shape - np.eye(3)
    assert quasi_static_error(damped, 30.0) == pytest.approx(np.linalg.norm(error, 2), rel=1e-12)
    # Damping turns the phase: the error is then of first order in the frequency.
    assert frequency_of_error(damped, 0.01) < frequency_of_error(undamped, 0.01)


def test_another_frame_model_moves_the_frequencies() -> None:
    softer = modes(FABRICATED, model=ELASTIC_ROOTS).frequency_hz / modes(FABRICATED).frequency_hz
    assert (softer < 1.0).all()
    assert (softer > 0.9).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"damping_ratio": -0.1}, "damping_ratio"),
        ({"damping_ratio": math.nan}, "damping_ratio"),
        ({"damping_ratio": [0.1, 0.2]}, "3 modes"),
        ({"beam_density_kg_m3": math.inf}, "beam_density_kg_m3"),
    ],
)
def test_what_is_refused(change: dict[str, float], says: str) -> None:
    with pytest.raises(InputError, match=says):
        modes(FABRICATED, **change)  # type: ignore[arg-type]


def test_bodies_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="mass_kg"):
        RigidBody(0.0, 0.0, 1.0)
    with pytest.raises(InputError, match="about the origin"):
        RigidBody(1.0, 1.0, 0.5)
    with pytest.raises(InputError, match="too thin"):
        modes(replace(FABRICATED, h1_m=1e-130))
    with pytest.raises(InputError, match="allowed is above 0"):
        frequency_of_error(modes(FABRICATED), 0.0)
