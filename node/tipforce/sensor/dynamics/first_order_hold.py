"""Exact stepping of the structure under a load that is linear between its samples: first-order hold, at any step. The
only error for a smooth load is that of its linear interpolation, step^2 / 8 times its curvature. A mode in its own time
tau = omega t and in units of its static response z:

    z'' + 2 zeta z' + z = g(tau),  state (z, w = z'),  x = omega h

    z1 = p11 z + p12 w + b10 g0 + b11 g1,    w1 = p21 z + p22 w + b20 g0 + b21 g1

With s the impulse response, I0 its integral (the step response) and J the integral of that: p11 = 1 - I0, p12 = s,
p21 = -s, p22 = 1 - I0 - 2 zeta s; b11 = J / x, b10 = I0 - J / x, b21 = I0 / x, b20 = s - I0 / x. Where differences of
nearly equal numbers would lose digits: a power series for short steps, two exponentials for strong damping."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import Modes

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
    """Return the coefficients for x = omega h and zeta, 0 or more and finite: to 1e-15 for x from 1e-150 to 1e300."""
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


def holds(modes: Modes, step_s: float) -> list[Hold]:
    """Return the coefficients of one step, one entry per mode. Raises InputError for a step out of range."""
    x = modes.omega_rad_s * step_s
    if not (step_s >= 0.0 and (x <= _LARGEST_X).all()):
        raise InputError(f"step_s = {step_s!r}: allowed is 0 or more, finite")
    return [hold(float(a), float(zeta)) for a, zeta in zip(x, modes.damping_ratio, strict=True)]


def node_coefficients(modes: Modes, step_s: float) -> Coefficients:
    """Return the arguments of ``sources.dynamic_load.DynamicLoad``, plain floats. Raises InputError as holds() does."""
    shapes = zip(modes.load_shape.tolist(), holds(modes, step_s), modes.force_shape.T.tolist(), strict=True)
    return tuple(((a, b, c), held, (d, e, f)) for (a, b, c), held, (d, e, f) in shapes)


def respond(modes: Modes, loads_newtons: npt.ArrayLike, step_s: float, start: State | None = None) -> Response:
    """Return the elastic force at the samples of a load (m, 3), ``step_s`` apart; start: None is ``at_rest``. After a
    load that is not finite no force is. Raises InputError for shapes that do not fit, or the step."""
    F = checked_loads(loads_newtons)
    held = np.array(holds(modes, step_s))
    g = F @ modes.load_shape.T
    state = start or at_rest(modes)
    drive = np.stack((held[:, 4] * g[:-1] + held[:, 5] * g[1:], held[:, 6] * g[:-1] + held[:, 7] * g[1:]))
    z, w = _scan(held, drive, state)
    return Response(z @ modes.force_shape.T, State(z[-1], w[-1]))


def checked_loads(loads_newtons: npt.ArrayLike) -> FloatArray:
    """Return loads as (m, 3), m at least 1. Raises InputError for another shape."""
    F = floats("loads", loads_newtons)
    if F.ndim != 2 or F.shape[1] != 3 or len(F) < 1:
        raise InputError(f"loads of shape {F.shape}: allowed is (m, 3), m at least 1")
    return F


def _scan(held: FloatArray, drive: FloatArray, start: State) -> tuple[FloatArray, FloatArray]:
    """Return all states (m, n) of the recurrence by blocks that start from zero: 2 sqrt(m) passes through Python. Their
    ends are carried on by powers of the step's matrix; multiples of a step would round."""
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
