"""Stepping whole loads: exact solutions, bulk against one by one, the node's plain floats, linearity, energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import (
    State,
    at_rest,
    energy,
    node_coefficients,
    respond,
    respond_at,
    settled,
)
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


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), damping, steps)
def test_bulk_one_by_one_and_the_node_agree(seed: int, zeta: float, step_s: float) -> None:
    rng, body = np.random.default_rng(seed), BODY.with_damping(zeta)
    loads = rng.uniform(-1.0, 1.0, (150, 3))
    start = State(rng.uniform(-1.0, 1.0, 3), rng.uniform(-1.0, 1.0, 3))
    bulk = respond(body, loads, step_s, start)
    # Times by addition differ from the step by rounding: the phase of an undamped mode shows it.
    slack = 1e-12 + 4e-16 * 150.0 * 150.0 * step_s * float(body.omega_rad_s[-1])
    scale = np.abs(bulk.elastic_newtons).max()
    single = respond_at(body, np.arange(150) * step_s, loads, start)
    assert np.abs(single.elastic_newtons - bulk.elastic_newtons).max() <= slack * scale
    node = DynamicLoad(node_coefficients(body, step_s))
    from_rest = respond(body, loads, step_s).elastic_newtons
    stepped = np.array([node.step(a, b) for a, b in zip(loads[:-1].tolist(), loads[1:].tolist(), strict=True)])
    assert np.abs(stepped - from_rest[1:]).max() <= 1e-12 * scale


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


@pytest.mark.parametrize("step_s", [1e-9, 1e-3, 1.0])
@pytest.mark.parametrize("zeta", [0.0, 0.5, 50.0])
def test_a_force_that_stands_is_returned(step_s: float, zeta: float) -> None:
    body = STIFF.with_damping(zeta)
    found = respond(body, np.tile(F, (200, 1)), step_s, settled(body, F)).elastic_newtons
    # Without damping rounding stays in the fast modes: 200 steps of 1 s are 1e8 radians.
    atol = 1e-11 if step_s == 1.0 and zeta == 0.0 else 1e-12
    np.testing.assert_allclose(found, np.tile(F, (200, 1)), rtol=0.0, atol=atol)


def test_smooth_loads_converge_with_order_2_to_the_closed_solution() -> None:
    body = BODY.with_damping(0.01)
    errors = []
    for n in (200, 400, 800):
        t = np.linspace(0.0, 0.04, n + 1)
        loads = np.outer(0.5 - 0.5 * np.cos(2.0 * math.pi * t / 0.04), F)
        wanted = integrators.raised_cosine(body, F, 0.04, t)
        errors.append(np.abs(respond(body, loads, 0.04 / n).elastic_newtons - wanted).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([2.0, 2.0], abs=0.02)


def test_a_step_overshoots_to_nearly_twice() -> None:
    t = np.linspace(0.0, 0.2, 4001)
    wanted = integrators.step(BODY, [0.0, 0.0, 1.0], t)
    found = respond(BODY, np.tile([0.0, 0.0, 1.0], (4001, 1)), 5e-5).elastic_newtons
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12)
    assert 1.95 < found[:, 2].max() <= 2.0 + 1e-12


def test_a_jump_of_the_load_is_two_samples_at_one_time() -> None:
    body = BODY.with_damping(0.02)
    found = respond_at(body, [0.0, 1e-3, 1e-3, 2e-3], np.outer([0.0, 0.0, 1.0, 1.0], F)).elastic_newtons
    np.testing.assert_allclose(found[3], integrators.step(body, F, [1e-3])[0], rtol=0.0, atol=1e-14)
    assert (found[:3] == 0.0).all()


def test_one_sample_and_bad_input() -> None:
    assert respond(BODY, [[1.0, 2.0, 3.0]], 1e-3).elastic_newtons.tolist() == [[0.0, 0.0, 0.0]]
    assert at_rest(STIFF).position.shape == (6,)
    for step_s in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="step_s"):
            respond(BODY, np.zeros((2, 3)), step_s)
    with pytest.raises(InputError, match="loads of shape"):
        respond(BODY, np.zeros((2, 2)), 1e-3)
    with pytest.raises(InputError, match="do not fall"):
        respond_at(BODY, [0.0, -1.0], np.zeros((2, 3)))
    spoiled = respond(BODY, [[0.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [0.0, 0.0, 0.0]], 1e-3).elastic_newtons
    assert not np.isfinite(spoiled[1:, 0]).any()
