"""From a load to converter samples: structure, analogue anti-alias filter, one sample per period.

Structure and filter are one linear system, and the load is linear between its samples: the result is exact for any
steps. The filter input is the elastic force; a gauge is a fixed combination of F, so filtering F is equivalent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import checked_loads
from tipforce.sensor.dynamics.model import Modes
from tipforce_lab.dynamics.switched import exponential


def quasi_static_error(modes: Modes, frequency_hz: npt.ArrayLike) -> FloatArray:
    """Return the largest error of the elastic force relative to a sinusoidal load, (...).

    Largest over all directions of F: a 2-norm.
    """
    ratio = np.asarray(frequency_hz, dtype=np.float64)[..., np.newaxis] / modes.frequency_hz
    # gain - 1 without the difference of two numbers near 1.
    squared = ratio * ratio - 2j * modes.damping_ratio * ratio
    gain = squared / (1.0 - squared)
    error = (modes.force_shape * gain[..., np.newaxis, :]) @ modes.load_shape
    largest: FloatArray = np.linalg.norm(error, ord=2, axis=(-2, -1))
    return largest


def frequency_of_error(modes: Modes, error: float) -> float:
    """Return the lowest frequency in Hz at which quasi_static_error() reaches ``error``, by bisection.

    Raises InputError unless 0 < error <= 0.5: a larger one is near resonance.
    """
    if not 0.0 < error <= 0.5:
        raise InputError(f"error = {error!r}: allowed is above 0, at most 0.5")
    low, high = 0.0, 0.9 * float(modes.frequency_hz[0])
    while float(quasi_static_error(modes, high)) < error:
        high = 0.5 * (high + float(modes.frequency_hz[0]))
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if float(quasi_static_error(modes, middle)) < error else (low, middle)
    return high


@dataclass(frozen=True, slots=True)
class AntiAlias:
    """A low-pass filter of gain 1: RC (order 1) or Butterworth (order 2). Raises InputError for values out of range."""

    cutoff_hz: float
    """Frequency at which the gain is 1 / sqrt(2)."""
    order: int = 1

    def __post_init__(self) -> None:
        if not 0.0 < self.cutoff_hz < math.inf:
            raise InputError(f"cutoff_hz = {self.cutoff_hz!r}: allowed is a positive finite number")
        if self.order not in (1, 2):
            raise InputError(f"order = {self.order!r}: allowed is 1 (RC) or 2 (Butterworth)")

    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Return (A (order, order) in 1/s, b (order,)): x' = A x + b u, output x[0]."""
        w = 2.0 * math.pi * self.cutoff_hz
        if self.order == 1:
            return np.array([[-w]]), np.array([w])
        return np.array([[0.0, w], [-w, -math.sqrt(2.0) * w]]), np.array([0.0, w])


def sampled(
    modes: Modes | None,
    anti_alias: AntiAlias | None,
    loads_newtons: npt.ArrayLike,
    step_us: int,
    period_us: int,
    settled: bool = False,
) -> FloatArray:
    """Return F as sampled at 0, period, 2 period ... while the load lasts, (k, 3), newtons.

    loads_newtons: (m, 3), step_us apart. modes None: the load itself is filtered. anti_alias None: no filter.
    settled: True starts in equilibrium under the first load, False at rest without. Raises InputError for shapes that
    do not fit, loads that are not finite, or times that are not positive whole microseconds.
    """
    F = checked_loads(loads_newtons)
    if not np.isfinite(F).all():
        raise InputError("loads: allowed are finite numbers")
    for name, value in (("step_us", step_us), ("period_us", period_us)):
        if not (isinstance(value, int) and value > 0):
            raise InputError(f"{name} = {value!r}: allowed is a positive whole number")
    A, output = _system(modes, anti_alias)
    N = len(A) - 6
    X = np.zeros(len(A))
    if settled:
        X[N : N + 3] = F[0]
        X[:N] = np.linalg.solve(A[:N, :N], -A[:N, N : N + 3] @ F[0]) if N else X[:N]
    moves: dict[int, FloatArray] = {}
    end_us, now_us, readings = (len(F) - 1) * step_us, 0, []
    for time_us in range(0, end_us + 1, period_us):
        while now_us < time_us:
            k = now_us // step_us
            if now_us == k * step_us:
                X[N : N + 3], X[N + 3 :] = F[k], (F[k + 1] - F[k]) / (step_us * 1e-6)
            gap_us = min(time_us, (k + 1) * step_us) - now_us
            if gap_us not in moves:
                moves[gap_us] = exponential(A * (gap_us * 1e-6))
            X = moves[gap_us] @ X
            now_us += gap_us
        if now_us % step_us == 0:
            X[N : N + 3] = F[now_us // step_us]  # a jump by rounding, or the first load
        readings.append(output @ X)
    return np.array(readings)


def _system(modes: Modes | None, anti_alias: AntiAlias | None) -> tuple[FloatArray, FloatArray]:
    """States: z and z' / omega of the modes, the filters of F1, F2, F3, then F and its rate. Output (3, N)."""
    n = 0 if modes is None else len(modes.omega_rad_s)
    order = 0 if anti_alias is None else anti_alias.order
    N = 2 * n + 3 * order
    A = np.zeros((N + 6, N + 6))
    A[N : N + 3, N + 3 :] = np.eye(3)
    elastic = np.zeros((3, N + 6))
    if modes is None:
        elastic[:, N : N + 3] = np.eye(3)
    else:
        omega = modes.omega_rad_s
        A[:n, n : 2 * n], A[n : 2 * n, :n] = np.diag(omega), -np.diag(omega)
        A[n : 2 * n, n : 2 * n] = -2.0 * np.diag(modes.damping_ratio * omega)
        A[n : 2 * n, N : N + 3] = omega[:, np.newaxis] * modes.load_shape
        elastic[:, :n] = modes.force_shape
    if anti_alias is None:
        return A, elastic
    own, drive = anti_alias.matrices()
    output = np.zeros((3, N + 6))
    for channel in range(3):
        at = slice(2 * n + channel * order, 2 * n + (channel + 1) * order)
        A[at] += drive[:, np.newaxis] * elastic[channel]
        A[at, at] += own
        output[channel, at.start] = 1.0
    return A, output
