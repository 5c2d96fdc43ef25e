"""One step of high order for a smooth equation y' = f(y): Gragg's midpoint rule, extrapolated (Bulirsch and Stoer)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Rate = Callable[[FloatArray], FloatArray]

_SUBSTEPS = (2, 4, 6, 8, 10, 12, 14)
ORDER = 2 * len(_SUBSTEPS)


def step(f: Rate, y: FloatArray, h: float) -> tuple[FloatArray, float]:
    """Return (y after h, estimate of the error: the largest entry of the last correction)."""
    first = f(y)
    row: list[FloatArray] = []
    correction = first
    for k, n in enumerate(_SUBSTEPS):
        new = [_midpoint(f, y, first, h, n)]
        for j in range(k):
            ratio = (n / _SUBSTEPS[k - 1 - j]) ** 2
            correction = (new[j] - row[j]) / (ratio - 1.0)
            new.append(new[j] + correction)
        row = new
    return y + row[-1], float(np.abs(correction).max())


def adapted(h: float, error: float, tolerance: float) -> float:
    """Return the next length of step after one of length h with that error; a fifth after NaN."""
    if not math.isfinite(error):
        return 0.2 * h
    factor = 0.8 * math.pow(tolerance / max(error, 1e-300), 1.0 / (ORDER - 1))
    return h * min(3.0, max(0.2, factor))


def _midpoint(f: Rate, y: FloatArray, first: FloatArray, h: float, n: int) -> FloatArray:
    """The change of y, kept apart from y for the sake of its last digits."""
    sub = h / n
    before, now = np.zeros_like(y), sub * first
    for _ in range(1, n):
        before, now = now, before + 2.0 * sub * f(y + now)
    return now
