"""The held step: one mode against 60-digit arithmetic; whole loads, the node's plain floats, linearity, energy."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import Hold, State, at_rest, energy, hold, node_coefficients, respond
from tipforce.sensor.dynamics.model import Modes, modes
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sources.dynamic_load import DynamicLoad
from tipforce_lab.dynamics import integrators

DAMPING = [0.0, 0.01, 0.3, 0.999999, 1.0, 1.0000001, 1.4, 1.5000001, 2.0, 50.0]
damping = st.one_of(st.sampled_from(DAMPING), st.floats(0.0, 50.0))
exponents = st.floats(-9.0, 9.0)


def series(x: float, zeta: float) -> Hold:
    """The same integrals by their power series with 60 digits or more: s = sum of c_n x^n / n!."""
    with localcontext() as context:
        context.prec = 80 + int(3.0 * x * (zeta + 1.0))
        X, Z = Decimal(x), Decimal(zeta)
        before, c, power = Decimal(0), Decimal(1), X
        s, step, J = Decimal(0), Decimal(0), Decimal(0)
        n = 1
        while True:
            term = c * power
            s, step, J = s + term, step + term * X / (n + 1), J + term * X * X / ((n + 1) * (n + 2))
            # Without damping every second coefficient is 0.
            if n > 8 and abs(power) * (abs(c) + abs(before)) < Decimal(10) ** -70 * X:
                break
            before, c = c, -2 * Z * c - before
            n += 1
            power = power * X / n
        ramp, mean = J / X, step / X
        values = (1 - step, s, -s, 1 - step - 2 * Z * s, step - ramp, ramp, s - mean, mean)
        return Hold(*(float(value) for value in values))


@pytest.mark.parametrize("zeta", DAMPING)
@pytest.mark.parametrize("x", [1e-12, 1e-9, 1e-4, 0.009, 0.011, 0.3, 0.99, 1.01, 2.5, 7.0, 40.0])
def test_it_equals_the_series_in_long_arithmetic(x: float, zeta: float) -> None:
    x = min(x, 40.0 / (1.0 + zeta))  # the series needs as many digits as terms cancel
    found, wanted = hold(x, zeta), series(x, zeta)
    # What multiplies a position and a velocity of size 1: relative to the row, for the largest entry is the response.
    for name in ("p12", "b11", "b21"):
        a, b = getattr(found, name), getattr(wanted, name)
        assert abs(a - b) <= 4e-14 * max(abs(b), math.exp(-x) * 1e-3 if zeta < 1 else 0.0), name
    for a, b in zip(found, wanted, strict=True):
        assert abs(a - b) <= 2e-15 * max(1.0, x / 8)
    if x <= 1e-4 and zeta <= 2.0:  # short steps keep all digits of the input
        assert found[4:] == pytest.approx(wanted[4:], rel=1e-14)


@settings(max_examples=300, deadline=None)
@given(exponents, damping, st.tuples(*[st.floats(-1.0, 1.0)] * 4))
def test_one_step_is_two_half_steps(exponent: float, zeta: float, start: tuple[float, float, float, float]) -> None:
    x = 10.0**exponent
    z, w, g0, g1 = start
    middle = 0.5 * (g0 + g1)
    once = advance(hold(x, zeta), (z, w), g0, g1)
    half = hold(0.5 * x, zeta)
    twice = advance(half, advance(half, (z, w), g0, middle), middle, g1)
    assert once == pytest.approx(twice, rel=0.0, abs=5e-14)


@settings(max_examples=200, deadline=None)
@given(exponents, damping, st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_a_load_that_stands_or_rises_evenly_has_its_known_solution(
    exponent: float, zeta: float, g: float, slope: float
) -> None:
    x = 10.0**exponent
    held = hold(x, zeta)
    assert advance(held, (g, 0.0), g, g) == pytest.approx((g, 0.0), rel=1e-14, abs=1e-14 * abs(g) + 1e-300)
    # z = g + slope (tau - 2 zeta), w = slope solves the equation for g + slope tau.
    end = advance(held, (g - 2.0 * zeta * slope, slope), g, g + slope * x)
    wanted = g + slope * x - 2.0 * zeta * slope, slope
    size = abs(g) + abs(slope) * (1.0 + x + 2.0 * zeta)
    assert end == pytest.approx(wanted, rel=0.0, abs=4e-14 * size)


@settings(max_examples=200, deadline=None)
@given(st.floats(-140.0, 299.0), st.floats(0.0, 1e6))
def test_a_mode_never_gains_energy_by_itself_and_every_weight_is_finite(exponent: float, zeta: float) -> None:
    held = hold(10.0**exponent, zeta)
    assert all(math.isfinite(value) for value in held)
    for start in ((1.0, 0.0), (0.0, 1.0), (0.6, -0.8)):
        assert math.hypot(*advance(held, start, 0.0, 0.0)) <= 1.0 + 1e-13
    assert -1e-13 <= held.b11 <= 1.5


def test_no_time_changes_nothing() -> None:
    assert advance(hold(0.0, 0.3), (0.2, 0.4), 5.0, 6.0) == (0.2, 0.4)


def advance(held: Hold, state: tuple[float, float], g0: float, g1: float) -> tuple[float, float]:
    z, w = state
    return (
        held.p11 * z + held.p12 * w + held.b10 * g0 + held.b11 * g1,
        held.p21 * z + held.p22 * w + held.b20 * g0 + held.b21 * g1,
    )


BODY = modes(FABRICATED)
STIFF = modes(FABRICATED, beam_density_kg_m3=7850.0)
F = np.array([1.0, 0.5, -0.3])
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
