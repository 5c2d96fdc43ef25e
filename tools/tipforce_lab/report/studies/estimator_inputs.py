"""Random contacts as counts of a 24-bit converter, and the exact P, phi and theta of these counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np

from tipforce.arrays import FloatArray, IntArray
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix

CASE = "III"
COUNT_BITS = 24
RANGE_MICROSTRAIN = 1024.0
LSB_MICROSTRAIN = RANGE_MICROSTRAIN / 2 ** (COUNT_BITS - 1)  # 2^-13: a count is an exact binary fraction
_FILLED = 0.98  # of the converter's range, at most
DIGITS = 50
REFERENCE_ERROR = 1e-42
"""Error of the reference, in newtons and in degrees: the root near tangency and the degrees lose some of 50 digits."""


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Counts and their exact result, rounded once to a float64 and a remainder."""

    C: FloatArray
    """(3, 3), newtons per unit strain: these floats are taken as exact."""
    counts: IntArray
    """(k, 3)."""
    P_newtons: list[Decimal]
    theta_deg: list[Decimal]
    full_scale_newtons: float
    """The smallest load that uses the converter's full range."""


def near(rng: np.random.Generator, k: int) -> FloatArray:
    """Return |cos(delta)| of k contacts: anywhere on the tip, at least 0.1 from tangency."""
    return rng.uniform(0.1, 1.0, k)


def tangent(rng: np.random.Generator, k: int) -> FloatArray:
    """Return |cos(delta)| of k contacts with nearly tangential force: 0.001 to 0.1, log-uniform."""
    cosine: FloatArray = 10.0 ** rng.uniform(-3.0, -1.0, k)
    return cosine


def contacts(
    rng: np.random.Generator,
    k: int,
    cosines: Callable[[np.random.Generator, int], FloatArray] = near,
    corners: bool = False,
) -> Contacts:
    """Return k pushes in any direction: half from a hundredth of the converter's range to all of it, half above 50 %.

    corners: also those with every gauge at an end of the converter's range.
    """
    C, A = calibration_matrix(FABRICATED, CASE), strain_matrix(FABRICATED, CASE)
    phi = rng.uniform(-np.pi, np.pi, k)
    delta = np.pi - np.arccos(cosines(rng, k)) * rng.choice([-1.0, 1.0], k)  # a push: cos(delta) < 0
    microstrain = 1e6 * force_vector(1.0, phi, phi - delta) @ A.T
    share = np.where(np.arange(k) % 2, rng.uniform(0.5, 1.0, k), 10.0 ** rng.uniform(-2.0, 0.0, k))
    P = share * _FILLED * RANGE_MICROSTRAIN / np.abs(microstrain).max(axis=1)
    counts = np.rint(P[:, np.newaxis] * microstrain / LSB_MICROSTRAIN).astype(np.int64)
    if corners:
        counts = np.concatenate((counts, _corners(C)))
    exact = [_exact(C, row) for row in counts.tolist()]
    return Contacts(C, counts, [contact[0] for contact in exact], [contact[1] for contact in exact], _full_scale(A))


def _corners(C: FloatArray) -> IntArray:
    """Return the counts (c, 3) with every gauge at a limit of its range that a contact can cause: |F2| < P."""
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    F = signs @ C.T
    possible = np.abs(F[:, 1]) < 0.99 * np.hypot(F[:, 0], F[:, 2])
    corners: IntArray = signs[possible] * round(_FILLED * 2 ** (COUNT_BITS - 1))
    return corners


def _full_scale(A: FloatArray) -> float:
    """Search the largest strain of a gauge per newton: that for F2 = P or F2 = -P at the best phi."""
    phi, sine = np.meshgrid(np.linspace(-np.pi, np.pi, 721), np.linspace(-1.0, 1.0, 3))
    F = np.stack((np.sin(phi), sine, np.cos(phi)), axis=-1)
    return float(RANGE_MICROSTRAIN * 1e-6 / np.abs(F @ A.T).max())


def _exact(C: FloatArray, counts: list[int]) -> tuple[Decimal, Decimal]:
    """Return P in newtons and theta in degrees: the paper's equation (16) inverted with 50 digits."""
    with localcontext() as context:
        context.prec = DIGITS
        lsb = Decimal(LSB_MICROSTRAIN) * Decimal("1e-6")
        F1, F2, F3 = (sum((Decimal(c) * n for c, n in zip(row, counts, strict=True)), Decimal(0)) * lsb
                      for row in C.tolist())  # fmt: skip
        squared = F1 * F1 + F3 * F3
        hypotenuse = squared.sqrt()
        cosine_squared = squared - F2 * F2
        P = hypotenuse if cosine_squared >= 0 else (hypotenuse + abs(F2)) / 2
        delta = arctan2(F2, -max(cosine_squared, Decimal(0)).sqrt())
        theta = (arctan2(F1, F3) - delta) * 180 / pi()
        if theta > 180:
            theta -= 360
        elif theta <= -180:
            theta += 360
        return P, theta


def arctan2(y: Decimal, x: Decimal) -> Decimal:
    """Return the angle of (x, y) in radians, in the precision of the context."""
    if abs(y) > abs(x):
        return (pi() / 2).copy_sign(y) - _arctan(x / y)
    if x > 0:
        return _arctan(y / x)
    return pi().copy_sign(y) + _arctan(y / x) if x else Decimal(0)


def _arctan(t: Decimal) -> Decimal:
    """Compute atan(t) = 2 atan(t / (1 + sqrt(1 + t^2))), five times; then the series."""
    for _ in range(5):
        t = t / (1 + (1 + t * t).sqrt())
    term, total, k = t, t, 1
    while abs(term) > abs(t) * Decimal(10) ** (-DIGITS - 2):
        term *= -t * t
        k += 2
        total += term / k
    return total * 32


_PI: list[Decimal] = []


def pi() -> Decimal:
    """Return pi by Machin's formula, computed once."""
    if not _PI:
        with localcontext() as context:
            context.prec = DIGITS + 10
            _PI.append(4 * (4 * _inverse_arctan(5) - _inverse_arctan(239)))
    return _PI[0]


def _inverse_arctan(n: int) -> Decimal:
    """Return atan(1 / n)."""
    term = Decimal(1) / n
    total, k = term, 1
    while abs(term) > Decimal(10) ** (-DIGITS - 12):
        term /= -n * n
        k += 2
        total += term / k
    return total


def errors(estimated: FloatArray, exact: list[Decimal], period: float = 0.0) -> FloatArray:
    """Return found - exact, (k,), as the difference of exact numbers; angles wrapped to half a period."""
    difference = np.array([float(Decimal(f) - e) for f, e in zip(estimated.tolist(), exact, strict=True)])
    return difference - period * np.rint(difference / period) if period else difference
