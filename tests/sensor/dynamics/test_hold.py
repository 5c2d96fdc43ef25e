"""One exact step of one mode: against 60-digit arithmetic, composition, invariants, from 1e-9 to 1e9 radians."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.sensor.dynamics.first_order_hold import Hold, hold

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
