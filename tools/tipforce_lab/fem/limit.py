"""Convergence of a number with mesh refinement: observed order, Richardson's limit, and its error.

Also the theoretical exponent of the singularity at a corner.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from tipforce.arrays import FloatArray
from tipforce.errors import InputError

LEAST_ORDER, MOST_ORDER = 0.3, 3.0
SAFETY = 1.25
MODES = {"opening": 1.0, "sliding": -1.0}
"""Williams' two families at a corner with free faces: symmetric and antisymmetric about its bisector."""


class Limit(NamedTuple):
    """The limit of a sequence on meshes of n, 2 n, 4 n."""

    value: float
    error: float
    """An estimate: 1.25 times the finest value's distance from its limit (Roache's grid convergence index), with the
    order limited to 3, that of P2; without an observable order, the larger of the last two changes."""
    order: float
    """NaN: the differences do not decrease with one sign, and the value is the finest one."""


def extrapolate(values: Sequence[float]) -> Limit:
    """Return the limit of the last three values, each on a mesh twice as fine as the one before.

    Raises InputError for fewer than three or values that are not finite.
    """
    if len(values) < 3 or not all(math.isfinite(value) for value in values):
        raise InputError(f"values {list(values)!r}: allowed are three or more finite numbers, n, 2 n, 4 n")
    coarse, middle, fine = (float(value) for value in values[-3:])
    first, second = middle - coarse, fine - middle
    ratio = first / second if second != 0.0 else math.inf
    if not ratio > 2.0**LEAST_ORDER or math.isinf(ratio):
        return Limit(fine, max(abs(first), abs(second)), math.nan)
    # fine + second (1 / ratio + 1 / ratio^2 + ...)
    change = second / (min(ratio, 2.0**MOST_ORDER) - 1.0)
    return Limit(fine + change, SAFETY * abs(change), math.log2(ratio))


def extrapolate_matrix(values: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """Return the limit of the last three matrices, n, 2 n, 4 n, and its error, relative in the Frobenius norm.

    One ratio for all entries: entry by entry it would divide by differences that are only rounding. Raises
    InputError for fewer than three.
    """
    if len(values) < 3:
        raise InputError(f"{len(values)} matrices: allowed are three or more, n, 2 n, 4 n")
    coarse, middle, fine = values[-3:]
    ratio = float(np.linalg.norm(middle - coarse) / np.linalg.norm(fine - middle))
    change = (fine - middle) / max(min(ratio, 2.0**MOST_ORDER) - 1.0, 1.0)
    return fine + change, SAFETY * float(np.linalg.norm(change) / np.linalg.norm(fine))


def corner_exponent(material_angle_rad: float, mode: str) -> float:
    """Return lambda, displacement ~ r^lambda, of a corner with free faces: Williams (1952).

    It is the smallest root above 1/2 of sin(lambda w) + s lambda sin(w) = 0 with s = 1 (opening) or -1 (sliding)
    and w the angle of material. 270 degrees: 0.5445 and 0.9085. Raises InputError for an unknown mode, an angle
    that is not above 180 and below 360 degrees, or one at which this mode is not singular.
    """
    if mode not in MODES:
        raise InputError(f"mode {mode!r}: allowed are {', '.join(MODES)}")
    w, sign = float(material_angle_rad), MODES[mode]
    if not math.pi < w < 2.0 * math.pi:
        raise InputError(f"material angle {math.degrees(w):g} degrees: allowed is above 180 and below 360")

    def mismatch(exponent: float) -> float:
        return math.sin(exponent * w) + sign * exponent * math.sin(w)

    # lambda = 1 is a root of the sliding family, but only a rotation; singular roots are below it.
    low, high = 0.5, 1.0 - 1e-9
    if mismatch(low) * mismatch(high) > 0.0:
        raise InputError(f"material angle {math.degrees(w):g} degrees: the {mode} mode is not singular there")
    return float(brentq(mismatch, low, high, xtol=1e-15))
