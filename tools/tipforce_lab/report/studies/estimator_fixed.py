"""The estimator in integers, as on a microcontroller without a floating-point unit, vectorised over samples.

int64 arrays represent the registers; the sum in a narrower register wraps as in hardware. Angles are binary: 2^32 per
turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray, IntArray
from tipforce_lab.report.studies.estimator_inputs import COUNT_BITS, LSB_MICROSTRAIN

Arctangent = Callable[[IntArray, IntArray], IntArray]
Estimate = tuple[FloatArray, FloatArray]

TURN = 1 << 32
_RATIO_BITS = 30


@dataclass(frozen=True, slots=True)
class Format:
    """Widths in bits of the coefficients, the readings and the accumulator, and the arctangent."""

    coefficient_bits: int
    reading_bits: int
    accumulator_bits: int
    arctangent: Arctangent


def prepared(C: FloatArray, form: Format) -> tuple[IntArray, float]:
    """Return (coefficients, newtons per unit of their sum with readings): the largest coefficient fills the format."""
    per_count = C * (LSB_MICROSTRAIN * 1e-6 * 2.0 ** (COUNT_BITS - form.reading_bits))
    unit = float(np.abs(per_count).max()) / ((1 << form.coefficient_bits - 1) - 1)
    return np.rint(per_count / unit).astype(np.int64), unit


def estimate(coefficients: IntArray, unit_newtons: float, counts: IntArray, form: Format) -> Estimate:
    """Return P in newtons and theta in degrees of counts (k, 3) of the 24-bit converter, for a push."""
    readings = _shifted(counts, COUNT_BITS - form.reading_bits)
    sums = readings @ coefficients.T
    if form.accumulator_bits == 32:
        sums = sums.astype(np.int32).astype(np.int64)  # wraps, as the register does
    # Sums of three products, cut to 30 bits: then the sum of two squares stays in 63.
    shift = max(0, form.coefficient_bits + form.reading_bits - 30)
    F1, F2, F3 = np.moveaxis(_shifted(sums, shift), -1, 0)
    a1, a2, a3 = np.abs(F1), np.abs(F2), np.abs(F3)
    large, small = np.maximum(a1, a3), np.minimum(a1, a3)
    hypotenuse = square_root(large * large + small * small)
    cosine_squared = (large - a2) * (large + a2) + small * small
    P = np.where(cosine_squared >= 0, hypotenuse, (hypotenuse + a2) >> 1)
    cosine = square_root(np.maximum(cosine_squared, 0))
    theta = form.arctangent(F1, F3) - form.arctangent(F2, -cosine)
    theta = (theta + TURN // 2) % TURN - TURN // 2
    P_newtons: FloatArray = P.astype(np.float64) * (unit_newtons * 2.0**shift)
    theta_deg: FloatArray = theta.astype(np.float64) * (360.0 / TURN)
    return P_newtons, theta_deg


def square_root(value: IntArray) -> IntArray:
    """Return the integer square root of (k,) numbers from 0 to 2^62, rounded down."""
    root: IntArray = np.sqrt(value.astype(np.float64)).astype(np.int64)
    root -= root * root > value
    root += (root + 1) * (root + 1) <= value
    return root


def cordic(iterations: int) -> Arctangent:
    """Compute atan2 by shifts and additions only: each iteration rotates by atan(2^-k) towards the x-axis."""
    angles = [round(np.arctan(2.0**-k) * TURN / (2.0 * np.pi)) for k in range(iterations)]

    def arctangent(y: IntArray, x: IntArray) -> IntArray:
        x, y = _normalised(x, y)
        angle = np.where(x < 0, TURN // 2, 0)
        x, y = np.abs(x), np.where(x < 0, -y, y)
        for k, step in enumerate(angles):
            down = y > 0
            turn = np.where(down, 1, -1)
            x, y = x + turn * (y >> k), y - turn * (x >> k)
            angle = angle + turn * step
        return angle

    return arctangent


def table(size: int) -> Arctangent:
    """Compute atan2 from a table of size + 1 angles over one octant, with linear interpolation."""
    entries = np.rint(np.arctan(np.arange(size + 1) / size) * TURN / (2.0 * np.pi)).astype(np.int64)
    step_bits = _RATIO_BITS - (size.bit_length() - 1)  # size is a power of two

    def arctangent(y: IntArray, x: IntArray) -> IntArray:
        x, y = _normalised(x, y)
        ax, ay = np.abs(x), np.abs(y)
        large, small = np.maximum(ax, ay), np.minimum(ax, ay)
        ratio = (small << _RATIO_BITS) // np.maximum(large, 1)
        entry = np.minimum(ratio >> step_bits, size - 1)
        past = ratio - (entry << step_bits)
        angle = entries[entry] + ((entries[entry + 1] - entries[entry]) * past >> step_bits)
        angle = np.where(ay > ax, TURN // 4 - angle, angle)
        angle = np.where(x < 0, TURN // 2 - angle, angle)
        signed: IntArray = np.where(y < 0, -angle, angle)
        return signed

    return arctangent


def _normalised(x: IntArray, y: IntArray) -> tuple[IntArray, IntArray]:
    """Shift both left until the larger fills 29 bits: CORDIC lengthens its vector by 1.65, and a register has 32."""
    exponent = np.frexp(np.maximum(np.abs(x), np.abs(y)).astype(np.float64))[1]
    shift = np.maximum(0, 29 - exponent)
    return x << shift, y << shift


def _shifted(value: IntArray, bits: int) -> IntArray:
    """Return value / 2^bits, rounded to the nearest."""
    return (value + (1 << bits - 1)) >> bits if bits else value
