"""Exact stepping of the structure under a load that is linear between its samples: first-order hold, the default.

Exact for such a load at any step: no stability limit, no phase error, no numerical damping. The only error for a
smooth load is that of its linear interpolation, step^2 / 8 times its curvature.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.dynamics.mode_step import Hold, hold
from tipforce.sensor.dynamics.model import Modes

Vector = tuple[float, float, float]
Coefficients = tuple[tuple[Vector, Hold, Vector], ...]
"""Per mode: load row, hold, force column; the node uses the named tuples as plain tuples."""

_LARGEST_X = 1e300


class State(NamedTuple):
    """Positions and velocities of the modes."""

    position: FloatArray
    """(n,): modal positions z, in units of the static response."""
    velocity: FloatArray
    """(n,): dz/dt / omega, in the same units."""


class Response(NamedTuple):
    """Response of the structure to a load."""

    elastic_newtons: FloatArray
    """(m, 3): F as measured by the gauges of the arms, at the times of the loads."""
    end: State


def at_rest(modes: Modes) -> State:
    """Return the state without load and motion."""
    return State(np.zeros(len(modes.omega_rad_s)), np.zeros(len(modes.omega_rad_s)))


def settled(modes: Modes, force_newtons: npt.ArrayLike) -> State:
    """Return the equilibrium under a force (3,)."""
    return State(modes.load_shape @ np.asarray(force_newtons, dtype=np.float64), np.zeros(len(modes.omega_rad_s)))


def energy(modes: Modes, state: State) -> float:
    """Return the energy of motion and of the bent beams in joules."""
    return 0.5 * float(np.sum((state.position / modes.omega_rad_s) ** 2 + (state.velocity / modes.omega_rad_s) ** 2))


def holds(modes: Modes, step_s: float) -> list[Hold]:
    """Return the coefficients of one step, one entry per mode. Raises InputError for a step out of range."""
    x = modes.omega_rad_s * step_s
    if not (step_s >= 0.0 and (x <= _LARGEST_X).all()):
        raise InputError(f"step_s = {step_s!r}: allowed is 0 or more, finite")
    return [hold(float(a), float(zeta)) for a, zeta in zip(x, modes.damping_ratio, strict=True)]


def node_coefficients(modes: Modes, step_s: float) -> Coefficients:
    """Return the arguments of ``tipforce.sources.dynamic_load.DynamicLoad`` for one step length: plain floats.

    Raises InputError for a step out of range.
    """
    return tuple(
        ((row[0], row[1], row[2]), held, (column[0], column[1], column[2]))
        for row, held, column in zip(
            modes.load_shape.tolist(), holds(modes, step_s), modes.force_shape.T.tolist(), strict=True
        )
    )


def respond(modes: Modes, loads_newtons: npt.ArrayLike, step_s: float, start: State | None = None) -> Response:
    """Return the elastic force at every sample of a load (m, 3), ``step_s`` apart, m at least 1.

    start: the state at the first sample, ``at_rest`` if None. A load that is not finite makes its modes not finite
    from there on. Raises InputError for shapes that do not fit, or a step out of range.
    """
    F = checked_loads(loads_newtons)
    held = np.array(holds(modes, step_s))
    g = F @ modes.load_shape.T
    state = start or at_rest(modes)
    drive = np.stack((held[:, 4] * g[:-1] + held[:, 5] * g[1:], held[:, 6] * g[:-1] + held[:, 7] * g[1:]))
    z, w = _scan(held, drive, state)
    return Response(z @ modes.force_shape.T, State(z[-1], w[-1]))


def respond_at(
    modes: Modes, times_s: npt.ArrayLike, loads_newtons: npt.ArrayLike, start: State | None = None
) -> Response:
    """Return the same for samples at any rising times (m,). Equal times are a jump of the load.

    Raises InputError for shapes that do not fit, or times that fall or are not finite.
    """
    t, F = floats("times_s", times_s), checked_loads(loads_newtons)
    if t.shape != (len(F),) or not np.isfinite(t).all() or (np.diff(t) < 0.0).any():
        raise InputError(f"times of shape {t.shape}: allowed are {len(F)} finite numbers that do not fall")
    g = F @ modes.load_shape.T
    z, w = start or at_rest(modes)
    positions = [z]
    for k in range(len(t) - 1):
        c = np.array(holds(modes, float(t[k + 1] - t[k]))).T
        z, w = (
            c[0] * z + c[1] * w + c[4] * g[k] + c[5] * g[k + 1],
            c[2] * z + c[3] * w + c[6] * g[k] + c[7] * g[k + 1],
        )
        positions.append(z)
    return Response(np.array(positions) @ modes.force_shape.T, State(z, w))


def checked_loads(loads_newtons: npt.ArrayLike) -> FloatArray:
    """Return loads as (m, 3), m at least 1. Raises InputError for another shape."""
    F = floats("loads", loads_newtons)
    if F.ndim != 2 or F.shape[1] != 3 or len(F) < 1:
        raise InputError(f"loads of shape {F.shape}: allowed is (m, 3), m at least 1")
    return F


def _scan(held: FloatArray, drive: FloatArray, start: State) -> tuple[FloatArray, FloatArray]:
    """Return all states (m, n) of the recurrence, in blocks: about 2 sqrt(m) passes through Python instead of m.

    Within a block all start from zero, all blocks at once; then the state at the end of each block is carried to the
    next, and its free motion is added by powers of the step's matrix. The closed form at multiples of the step is not
    used: multiples round, which thousands of radians per step would show.
    """
    steps, n = drive.shape[1:]
    if steps == 0:
        return start.position[np.newaxis], start.velocity[np.newaxis]
    block = max(1, math.isqrt(steps))
    blocks = -(-steps // block)
    padded = np.zeros((2, blocks * block, n))
    padded[:, :steps] = drive
    s = padded.reshape(2, blocks, block, n)
    p11, p12, p21, p22 = held[:, :4].T
    for k in range(1, block):
        z, w = s[0, :, k - 1], s[1, :, k - 1]
        s[0, :, k] += p11 * z + p12 * w
        s[1, :, k] += p21 * z + p22 * w
    free = np.empty((block, n, 2, 2))
    free[0] = once = held[:, :4].reshape(n, 2, 2)
    for k in range(1, block):
        free[k] = once @ free[k - 1]
    z, w = start
    for b in range(blocks):
        s[0, b] += free[:, :, 0, 0] * z + free[:, :, 0, 1] * w
        s[1, b] += free[:, :, 1, 0] * z + free[:, :, 1, 1] * w
        z, w = s[0, b, -1], s[1, b, -1]
    states = s.reshape(2, blocks * block, n)[:, :steps]
    return np.vstack((start.position, states[0])), np.vstack((start.velocity, states[1]))
