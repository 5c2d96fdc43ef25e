"""Stepping whole loads: exact solutions, bulk against one by one, the node's plain floats, linearity, energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import State, at_rest, energy, node_coefficients, respond
from tipforce.sensor.dynamics.model import Modes, modes
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sources.dynamic_load import DynamicLoad
from tipforce_lab.dynamics import integrators

BODY = modes(FABRICATED)
STIFF = modes(FABRICATED, beam_density_kg_m3=7850.0)
F = np.array([1.0, 0.5, -0.3])
damping = st.one_of(st.sampled_from([0.0, 0.01, 1.0, 50.0]), st.floats(0.0, 50.0))
steps = st.floats(-9.0, 0.0).map(lambda e: 10.0**e)


@pytest.mark.parametrize("body", [BODY, STIFF])
@pytest.mark.parametrize("zeta", [0.0, 0.01, 1.0, 5.0])
@pytest.mark.parametrize("step_s", [1e-9, 1e-6, 1e-3, 1.0])
def test_a_ramp_has_its_known_solution_at_any_step(body: Modes, zeta: float, step_s: float) -> None:
    found = respond(body.with_damping(zeta), np.outer(np.arange(101), F), step_s).elastic_newtons
    # One step of the closed form from rest to each time: F t less the free motion that a ramp starts.
    slope = body.load_shape @ F / (body.omega_rad_s * step_s)
    lag = 2.0 * zeta * slope
    t = np.arange(101) * step_s
    z, _ = integrators.free(body.with_damping(zeta), State(lag, -slope), t)
    with_lag = np.outer(np.arange(101), body.load_shape @ F) - lag + z
    wanted = with_lag @ body.force_shape.T
    # The reference itself is a difference of lag and free motion; for short steps both are far larger than the rest.
    noise = 4e-16 * (np.abs(lag).max() + np.abs(slope).max())
    assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max() + 20.0 * noise


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), damping, steps)
def test_any_broken_line_is_the_same_at_half_the_step(seed: int, zeta: float, step_s: float) -> None:
    rng, body = np.random.default_rng(seed), STIFF.with_damping(zeta)
    coarse = rng.uniform(-1.0, 1.0, (40, 3))
    fine = np.empty((79, 3))
    fine[::2], fine[1::2] = coarse, 0.5 * (coarse[1:] + coarse[:-1])
    a, b = respond(body, coarse, step_s), respond(body, fine, 0.5 * step_s)
    scale = max(np.abs(b.elastic_newtons).max(), 1e-300)
    # The phase of a fast undamped mode after many turns is only as good as its rounded frequency.
    turns = 40.0 * step_s * body.omega_rad_s[-1] if zeta < 1e-3 else 0.0
    assert np.abs(a.elastic_newtons - b.elastic_newtons[::2]).max() <= (1e-12 + 1e-15 * turns) * scale


def test_the_node_settled_stays() -> None:
    node = DynamicLoad(node_coefficients(STIFF.with_damping(0.01), 5e-4))
    node.settle((3.0, -1.0, 2.0))
    for _ in range(100):
        assert node.step((3.0, -1.0, 2.0), (3.0, -1.0, 2.0)) == pytest.approx((3.0, -1.0, 2.0), rel=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), damping, steps, st.floats(-1e3, 1e3))
def test_it_is_linear(seed: int, zeta: float, step_s: float, factor: float) -> None:
    rng, body = np.random.default_rng(seed), BODY.with_damping(zeta)
    a, b = rng.uniform(-1.0, 1.0, (2, 30, 3))
    together = respond(body, a + factor * b, step_s).elastic_newtons
    apart = respond(body, a, step_s).elastic_newtons + factor * respond(body, b, step_s).elastic_newtons
    assert np.abs(together - apart).max() <= 1e-12 * (1.0 + abs(factor))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), steps, st.floats(0.0, 50.0))
def test_energy_stays_without_damping_and_only_falls_with_it(seed: int, step_s: float, zeta: float) -> None:
    rng = np.random.default_rng(seed)
    start = State(rng.uniform(-1.0, 1.0, 6), rng.uniform(-1.0, 1.0, 6))
    quiet = np.zeros((50, 3))
    first = energy(STIFF, start)
    assert energy(STIFF, respond(STIFF, quiet, step_s, start).end) == pytest.approx(first, rel=1e-12)
    damped = STIFF.with_damping(zeta)
    assert energy(damped, respond(damped, quiet, step_s, start).end) <= first * (1.0 + 1e-12)


def test_smooth_loads_converge_with_order_2_to_the_closed_solution() -> None:
    body = BODY.with_damping(0.01)
    errors = []
    for n in (200, 400, 800):
        t = np.linspace(0.0, 0.04, n + 1)
        loads = np.outer(0.5 - 0.5 * np.cos(2.0 * math.pi * t / 0.04), F)
        wanted = integrators.closed_form(body, integrators.Wave(F, 0.5, -0.5, 0.0, 25.0), t)
        errors.append(np.abs(respond(body, loads, 0.04 / n).elastic_newtons - wanted).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([2.0, 2.0], abs=0.02)


def test_a_jump_of_the_load_is_a_step_of_no_time() -> None:
    body = BODY.with_damping(0.02)
    jump = respond(body, np.outer([0.0, 1.0], F), 0.0)
    assert (jump.elastic_newtons == 0.0).all()
    found = respond(body, np.outer([1.0, 1.0], F), 1e-3, jump.end).elastic_newtons[1]
    wanted = integrators.closed_form(body, integrators.Wave(F, 1.0, 0.0, 0.0, 0.0), [1e-3])[0]
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-14)


def test_one_sample_and_bad_input() -> None:
    assert respond(BODY, [[1.0, 2.0, 3.0]], 1e-3).elastic_newtons.tolist() == [[0.0, 0.0, 0.0]]
    assert at_rest(STIFF).position.shape == (6,)
    with pytest.raises(InputError, match="loads of shape"):
        respond(BODY, np.zeros((2, 2)), 1e-3)
