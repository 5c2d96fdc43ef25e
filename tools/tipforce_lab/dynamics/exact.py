"""Closed solutions as references for integrators: a load that rises and falls as a cosine, a step, a half sine."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.sensor.dynamics.first_order_hold import State
from tipforce.sensor.dynamics.mode_step import hold
from tipforce.sensor.dynamics.model import Modes


def free(modes: Modes, start: State, times_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return modal positions and velocities (m, n) at times (m,) after a start, without load."""
    rows = []
    for time_s in np.asarray(times_s, dtype=np.float64):
        c = np.array(
            [hold(float(w * time_s), float(d)) for w, d in zip(modes.omega_rad_s, modes.damping_ratio, strict=True)]
        )
        rows.append((c[:, 0] * start.position + c[:, 1] * start.velocity,
                     c[:, 2] * start.position + c[:, 3] * start.velocity))  # fmt: skip
    both = np.array(rows).reshape(-1, 2, len(modes.omega_rad_s))
    return both[:, 0], both[:, 1]


def harmonic(
    modes: Modes, mean: npt.ArrayLike, cosine: npt.ArrayLike, sine: npt.ArrayLike, frequency_hz: float,
    times_s: npt.ArrayLike,
) -> tuple[FloatArray, State]:  # fmt: skip
    """Return (elastic force (m, 3), state at the last time) from rest under mean + cosine cos(2 pi f t) + sine sin.

    The three are forces (3,). Steady state in closed form, plus the free motion that matches the start. No mode
    may be undamped at exactly that frequency.
    """
    t = np.asarray(times_s, dtype=np.float64)
    angle = 2.0 * math.pi * frequency_hz * t[:, np.newaxis]
    amplitude = modes.load_shape @ (np.asarray(cosine, dtype=np.float64) - 1j * np.asarray(sine, dtype=np.float64))
    ratio = frequency_hz / modes.frequency_hz
    amplitude = amplitude / ((1.0 - ratio) * (1.0 + ratio) + 2j * modes.damping_ratio * ratio)
    static = modes.load_shape @ np.asarray(mean, dtype=np.float64)
    turning = amplitude * np.exp(1j * angle)
    steady, steady_rate = static + turning.real, (1j * ratio * turning).real
    missing_rate: FloatArray = (ratio * amplitude).imag
    missing = State(-static - amplitude.real, missing_rate)
    z, w = free(modes, missing, t)
    z, w = steady + z, steady_rate + w
    return z @ modes.force_shape.T, State(z[-1], w[-1])


def raised_cosine(modes: Modes, force: npt.ArrayLike, period_s: float, times_s: npt.ArrayLike) -> FloatArray:
    """Return the elastic force (m, 3) from rest under force (1 - cos(2 pi t / period)) / 2, without end."""
    F = np.asarray(force, dtype=np.float64)
    return harmonic(modes, 0.5 * F, -0.5 * F, 0.0 * F, 1.0 / period_s, times_s)[0]


def step(modes: Modes, force: npt.ArrayLike, times_s: npt.ArrayLike) -> FloatArray:
    """Return the elastic force (m, 3) after a step of the force at time 0."""
    g = modes.load_shape @ np.asarray(force, dtype=np.float64)
    z, _ = free(modes, State(-g, np.zeros_like(g)), times_s)
    found: FloatArray = (g + z) @ modes.force_shape.T
    return found


def half_sine(modes: Modes, force: npt.ArrayLike, duration_s: float, times_s: npt.ArrayLike) -> FloatArray:
    """Return the elastic force (m, 3) from rest under force sin(pi t / duration) up to ``duration``, then none."""
    t, F = np.asarray(times_s, dtype=np.float64), np.asarray(force, dtype=np.float64)
    during = t <= duration_s
    zero = np.zeros(3)
    found, _ = harmonic(modes, zero, zero, F, 0.5 / duration_s, t[during]) if during.any() else (np.empty((0, 3)), None)
    _, end = harmonic(modes, zero, zero, F, 0.5 / duration_s, [duration_s])
    after, _ = free(modes, end, t[~during] - duration_s)
    return np.vstack((found, after @ modes.force_shape.T))
