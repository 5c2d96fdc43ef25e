"""Quantiles of Student's t and Fisher's F, from the incomplete beta function: no scipy is needed for an interval."""

from functools import lru_cache
from math import exp, inf, isinf, lgamma, log, log1p, sqrt
from statistics import NormalDist

from tipforce.errors import InputError

_TINY = 1e-300


def variance_factors(dof: float, spare: int) -> tuple[float, float]:
    """Return (of gauge noise, of parameters): factors with which 1.96 standard uncertainties hold 95 %: Student t over
    the normal, squared, with ``spare`` = n - 3 gauges by Rao (1967). Raises InputError unless dof > spare + 1."""
    if isinf(dof):
        return 1.0, 1.0
    left = dof - spare
    if spare and not left > 1.0:
        raise InputError(
            f"{dof:.3g} degrees of freedom for {spare + 3} gauges do not show their noise: add rows or state it"
        )
    student = (t_quantile(0.975, left) / NormalDist().inv_cdf(0.975)) ** 2
    return (student * dof / left * (dof - 1.0) / (left - 1.0) if spare else student), student


def t_quantile(probability: float, dof: float) -> float:
    """Return t with P(T < t) = probability, 0.5 <= probability < 1; dof > 0 may be fractional or infinite."""
    return NormalDist().inv_cdf(probability) if isinf(dof) else sqrt(f_quantile(2.0 * probability - 1.0, 1.0, dof))


@lru_cache(maxsize=256)  # one fit asks for the same few again and again
def f_quantile(probability: float, dof_1: float, dof_2: float) -> float:
    """Return x with P(F < x) = probability, 0 < probability < 1, for finite degrees of freedom above 0."""

    def is_below(exponent: float) -> bool:
        return _beta(dof_2 / (dof_2 + dof_1 * exp(exponent)), 0.5 * dof_2, 0.5 * dof_1) - (1.0 - probability) > 0.0

    low, high = log(1e-12), log(1e12)
    if is_below(high):
        return inf
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_below(middle) else (low, middle)
    return exp(0.5 * (low + high))


def _beta(x: float, a: float, b: float) -> float:
    """Regularised incomplete beta function I_x(a, b) for 0 < x <= 1 (NIST DLMF 8.17.22, modified Lentz)."""
    if x >= 1.0:
        return 1.0
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _beta(1.0 - x, b, a)
    front = exp(a * log(x) + b * log1p(-x) - log(a) - lgamma(a) - lgamma(b) + lgamma(a + b))
    c, d = 1.0, 1.0 / _off_zero(1.0 - (a + b) * x / (a + 1.0))
    value = d
    for m in range(1, 300):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            d = 1.0 / _off_zero(1.0 + term * d)
            c = _off_zero(1.0 + term / c)
            value *= c * d
        if abs(c * d - 1.0) < 1e-14:
            break
    return front * value


def _off_zero(value: float) -> float:
    return value if abs(value) > _TINY else _TINY
