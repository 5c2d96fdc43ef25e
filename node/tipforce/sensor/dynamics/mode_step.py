"""Step one mode exactly in closed form, with its load linear during the step.

A mode in its own time tau = omega t and in units of its static response z:

    z'' + 2 zeta z' + z = g(tau),  state (z, w = z'),  x = omega h

    z1 = p11 z + p12 w + b10 g0 + b11 g1,    w1 = p21 z + p22 w + b20 g0 + b21 g1

With s the impulse response, I0 its integral (the step response) and J the integral of that: p11 = 1 - I0, p12 = s,
p21 = -s, p22 = 1 - I0 - 2 zeta s; b11 = J / x, b10 = I0 - J / x, b21 = I0 / x, b20 = s - I0 / x. If the textbook's
differences of nearly equal numbers would lose digits, another form of the same functions is used: a power series for
short steps, two decaying exponentials for strong damping.
"""

from __future__ import annotations

import math
from typing import NamedTuple

SHORT_STEP = 1.0
"""The power series is used while x and the fast decay rate times x are below this."""
_STRONG_DAMPING = 1.5
_SERIES_TERMS = 40


class Hold(NamedTuple):
    """Coefficients of one step of one mode, dimensionless."""

    p11: float
    p12: float
    p21: float
    p22: float
    b10: float
    b11: float
    b20: float
    b21: float


def hold(x: float, zeta: float) -> Hold:
    """Return the coefficients for x = omega h >= 0 and the damping ratio zeta >= 0, both finite.

    Relative error of the response about 1e-15, from x = 1e-150 to 1e300. For large x the phase of an undamped mode is
    that of the rounded x, as with any formula.
    """
    if x == 0.0:
        return Hold(1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    s, step, ramp, p22 = _responses(x, zeta)
    mean = step / x
    return Hold(1.0 - step, s, -s, p22, step - ramp, ramp, s - mean, mean)


def _responses(x: float, zeta: float) -> tuple[float, float, float, float]:
    """Return s, I0, J / x and p22."""
    fast = zeta + math.sqrt((zeta - 1.0) * (zeta + 1.0)) if zeta > 1.0 else 1.0
    if x * max(fast, 1.0) < SHORT_STEP:
        return _series(x, zeta)
    if zeta > _STRONG_DAMPING:
        return _two_exponentials(x, fast, zeta)
    s, c = _near_critical(x, zeta)
    step = 1.0 - (c + zeta * s)
    return s, step, 1.0 - (s + 2.0 * zeta * step) / x, c - zeta * s


def _series(x: float, zeta: float) -> tuple[float, float, float, float]:
    """Return s = sum c_n x^n / n! with c_1 = 1, c_2 = -2 zeta, c_n+2 = -2 zeta c_n+1 - c_n (Taylor)."""
    s = step = ramp = 0.0
    before, term = 0.0, x  # c_n x^n / n! for n = 0 and 1
    for n in range(1, _SERIES_TERMS):
        s += term
        step += term * x / (n + 1)
        ramp += term * x / ((n + 1) * (n + 2))
        before, term = term, (-2.0 * zeta * term - before * x / n) * x / (n + 1)
        if abs(term) + abs(before) <= 1e-18 * x:
            break
    return s, step, ramp, 1.0 - step - 2.0 * zeta * s


def _near_critical(x: float, zeta: float) -> tuple[float, float]:
    """Return exp(-zeta x) times sin(beta x) / beta and cos(beta x), beta = sqrt(1 - zeta^2); hyperbolic above 1."""
    if zeta <= 1.0:
        beta = math.sqrt((1.0 - zeta) * (1.0 + zeta))
        decay = math.exp(-zeta * x)
        return decay * (math.sin(beta * x) / beta if beta else x), decay * math.cos(beta * x)
    gamma = math.sqrt((zeta - 1.0) * (zeta + 1.0))
    slow = math.exp(-x / (zeta + gamma))
    return slow * -math.expm1(-2.0 * gamma * x) / (2.0 * gamma), 0.5 * slow * (1.0 + math.exp(-2.0 * gamma * x))


def _two_exponentials(x: float, fast: float, zeta: float) -> tuple[float, float, float, float]:
    """Use decay rates ``fast`` and 1 / fast: every function is a difference of two terms of different size."""
    slow = 1.0 / fast
    spread = 2.0 * math.sqrt((zeta - 1.0) * (zeta + 1.0))
    e_slow, e_fast = math.exp(-slow * x), math.exp(-fast * x)
    s = (e_slow - e_fast) / spread
    step = (fast * -math.expm1(-slow * x) - slow * -math.expm1(-fast * x)) / spread
    ramp = (fast * _mean_rise(slow * x) - slow * _mean_rise(fast * x)) / spread
    return s, step, ramp, (fast * e_fast - slow * e_slow) / spread


def _mean_rise(y: float) -> float:
    """Return 1 - (1 - exp(-y)) / y, without loss of digits for small y."""
    if y > 0.5:
        return 1.0 + math.expm1(-y) / y
    total, term = 0.0, 1.0
    for n in range(2, 24):
        term *= (y if n == 2 else -y) / n
        total += term
    return total
