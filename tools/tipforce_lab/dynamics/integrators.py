"""Integrators of other kinds, for comparison only: all other modules use first_order_hold.py.

All have the same problem, load and times, and return the elastic force at the times and their cost. None uses the
linearity between events; a contact is a force that is 0 while open. Values that grow without bound are returned as
infinite or NaN: an unstable run is a valid result.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import State, hold
from tipforce.sensor.dynamics.model import HIGHEST_DAMPING_RATIO, Modes
from tipforce_lab.dynamics.impact import Assembly, Striker

Load = Callable[[float], FloatArray]
"""Time in s -> F (3,) in newtons."""

SCIPY_METHODS = ("Radau", "BDF", "LSODA", "DOP853")


class Run(NamedTuple):
    """Result of an integrator."""

    elastic_newtons: FloatArray
    """(m, 3)."""
    evaluations: int
    """Evaluations of the right-hand side, or of the residual if it is solved for the acceleration."""


class Problem:
    """The modes under a load, or struck by a body with linear contact; at rest at the start."""

    def __init__(self, modes: Modes, striker: Striker | None = None) -> None:
        if striker is not None and striker.exponent != 1.0:
            raise InputError("contact exponent 1.5: allowed here is a linear contact")
        assembly = Assembly(modes, striker)
        n, size = assembly.n, assembly.load if striker else 2 * assembly.n
        self.A = assembly.system.A[:size, :size]
        self.B = assembly.system.A[:size, assembly.load : assembly.rate]
        self.output = np.zeros((3, size))
        self.output[:, :n] = modes.force_shape * modes.omega_rad_s
        self.start = assembly.start()[:size]
        self.push: FloatArray | None = assembly.system.push[:size, 0] if striker else None
        self.closure = assembly.system.closure[0, :size] if striker else np.zeros(size)
        self.stiffness = striker.stiffness if striker else 0.0
        self.size = float(np.abs(modes.load_shape / modes.omega_rad_s[:, np.newaxis]).max())
        """Typical state per newton, for absolute tolerances."""
        self.modes, self.striker = modes, striker

    def rate(self, load: FloatArray, X: FloatArray) -> FloatArray:
        """Return X' (N,)."""
        rate: FloatArray = self.A @ X + self.B @ load
        if self.push is not None:
            overlap = float(self.closure @ X)
            if overlap > 0.0:
                rate += self.push * (self.stiffness * overlap)
        return rate


def no_load(time_s: float) -> FloatArray:
    """Return a zero load."""
    del time_s
    return np.zeros(3)


def runge_kutta_4(problem: Problem, load: Load, times_s: npt.ArrayLike) -> Run:
    """Integrate by the classic method, order 4, one step from each time to the next. Stable without damping up to
    omega h = 2 sqrt(2); see rk4_stability_limit().
    """
    t = _times(times_s)
    X, elastic = problem.start, [problem.output @ problem.start]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(t) - 1):
            h, F, middle = t[k + 1] - t[k], load(t[k]), load(0.5 * (t[k] + t[k + 1]))
            k1 = problem.rate(F, X)
            k2 = problem.rate(middle, X + 0.5 * h * k1)
            k3 = problem.rate(middle, X + 0.5 * h * k2)
            k4 = problem.rate(load(t[k + 1]), X + h * k3)
            X = X + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            elastic.append(problem.output @ X)
    return Run(np.array(elastic), 4 * (len(t) - 1))


def newmark(problem: Problem, load: Load, times_s: npt.ArrayLike) -> Run:
    """Integrate by average acceleration (beta 1/4, gamma 1/2): order 2, stable at any step, no numerical damping."""
    return _alpha(problem, load, times_s, 0.0, 0.0)


def generalised_alpha(problem: Problem, load: Load, times_s: npt.ArrayLike, rho_inf: float = 0.8) -> Run:
    """Integrate as Chung and Hulbert (1993): order 2, stable at any step; rho_inf, 0 to 1, is the factor per step of a
    mode that is far too fast for it. Raises InputError for another rho_inf.
    """
    if not 0.0 <= rho_inf <= 1.0:
        raise InputError(f"rho_inf = {rho_inf!r}: allowed is 0 to 1")
    return _alpha(problem, load, times_s, (2.0 * rho_inf - 1.0) / (rho_inf + 1.0), rho_inf / (rho_inf + 1.0))


def scipy_method(problem: Problem, load: Load, times_s: npt.ArrayLike, method: str, rtol: float) -> Run:
    """Integrate by scipy's solve_ivp with relative tolerance ``rtol``; absolute: rtol times the state of 1 N.

    Raises InputError for another method than SCIPY_METHODS. A run that scipy abandons is NaN from there on.
    """
    if method not in SCIPY_METHODS:
        raise InputError(f"method = {method!r}: allowed is {', '.join(SCIPY_METHODS)}")
    from scipy.integrate import solve_ivp

    t = _times(times_s)
    jacobian = {} if method == "DOP853" else {"jac": lambda _, X: _jacobian(problem, X)}
    solution = solve_ivp(
        lambda time_s, X: problem.rate(load(time_s), X), (t[0], t[-1]), problem.start,
        method=method, t_eval=t, rtol=rtol, atol=rtol * problem.size, **jacobian,
    )  # fmt: skip
    elastic = np.full((len(t), 3), np.nan)
    elastic[: solution.y.shape[1]] = solution.y.T @ problem.output.T
    return Run(elastic, int(solution.nfev))


def rk4_stability_limit(damping_ratio: float) -> float:
    """Return the largest omega h at which RK4 does not amplify a mode, from |R(z)| = 1, R its stability polynomial.

    Undamped 2 sqrt(2); the mode's z = omega h (-zeta +- i sqrt(1 - zeta^2)), or its faster real one above 1. Raises
    InputError for a damping ratio outside 0 to 1e6.
    """
    if not 0.0 <= damping_ratio <= HIGHEST_DAMPING_RATIO:
        raise InputError(f"damping_ratio = {damping_ratio!r}: allowed is 0 to {HIGHEST_DAMPING_RATIO:g}")
    zeta = complex(damping_ratio)
    unit = -zeta + 1j * np.sqrt(1.0 - zeta * zeta)
    unit = min(unit, -2.0 * zeta - unit, key=lambda root: root.real)
    # |R(x unit)|^2 - 1 is a polynomial in x; its root x = 0 is not a limit.
    R = np.array([unit**4 / 24.0, unit**3 / 6.0, unit**2 / 2.0, unit, 1.0])
    grows = np.polymul(R, R.conj()).real
    grows[-1] = 0.0
    grows[np.abs(grows) < 1e-14 * np.abs(grows).max()] = 0.0
    roots = np.roots(grows)
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-6)]
    return float(real.min())


def _jacobian(problem: Problem, X: FloatArray) -> FloatArray:
    if problem.push is None or not float(problem.closure @ X) > 0.0:
        return problem.A
    J: FloatArray = problem.A + problem.stiffness * np.outer(problem.push, problem.closure)
    return J


def _alpha(problem: Problem, load: Load, times_s: npt.ArrayLike, alpha_m: float, alpha_f: float) -> Run:
    """Newmark's family in accelerations. The contact is open or closed at the end of each step: both are tried."""
    t = _times(times_s)
    K, C, shape, d, v, output, along = _second_order(problem)
    h = float(t[1] - t[0])
    if not np.allclose(np.diff(t), h, rtol=1e-9, atol=0.0):
        raise InputError("times: allowed are equally spaced ones for this method")
    gamma, beta = 0.5 - alpha_m + alpha_f, 0.25 * (1.0 - alpha_m + alpha_f) ** 2
    f, m = 1.0 - alpha_f, 1.0 - alpha_m
    pressed = problem.stiffness * np.outer(along, along)
    open_, closed = (
        np.linalg.inv(m * np.eye(len(d)) + f * h * gamma * np.diag(C) + f * h * h * beta * (np.diag(K) + extra))
        for extra in (0.0, pressed)
    )
    a = shape @ load(t[0]) - C * v - K * d
    elastic, evaluations = [output @ d], 0
    for k in range(len(t) - 1):
        F = shape @ load(f * t[k + 1] + alpha_f * t[k])
        d_free, v_free = d + h * v + h * h * (0.5 - beta) * a, v + h * (1.0 - gamma) * a
        d_known, v_known = f * d_free + alpha_f * d, f * v_free + alpha_f * v
        force = F - C * v_known - K * d_known - alpha_m * a
        new = open_ @ force
        evaluations += 1
        if problem.push is not None and along @ (d_known + f * h * h * beta * new) > 0.0:
            new = closed @ (force - pressed @ d_known)
            evaluations += 1
        d, v, a = d_free + h * h * beta * new, v_free + h * gamma * new, new
        elastic.append(output @ d)
    return Run(np.array(elastic), evaluations)


def _second_order(
    problem: Problem,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mass-normalised: K, C (N,) diagonals, load shape (N, 3), start d, v (N,), output (3, N), overlap row (N,)."""
    modes, striker = problem.modes, problem.striker
    omega = modes.omega_rad_s
    K, C = omega * omega, 2.0 * modes.damping_ratio * omega
    output = modes.force_shape * omega * omega
    n = len(omega)
    if striker is None:
        return K, C, modes.load_shape, np.zeros(n), np.zeros(n), output, np.zeros(n)
    if not np.isfinite(striker.mass_kg):
        raise InputError("mass_kg = inf: allowed is a finite mass for this method")
    root = striker.mass_kg**0.5
    along = np.append(-modes.load_shape @ striker.direction, 1.0 / root)
    v = np.append(np.zeros(n), striker.speed_m_s * root)
    return (
        np.append(K, 0.0), np.append(C, 0.0), np.vstack((modes.load_shape, np.zeros(3))), np.zeros(n + 1), v,
        np.hstack((output, np.zeros((3, 1)))), along,
    )  # fmt: skip


def _times(times_s: npt.ArrayLike) -> FloatArray:
    t = np.asarray(times_s, dtype=np.float64)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or not (np.diff(t) > 0.0).all():
        raise InputError(f"times of shape {t.shape}: allowed are two or more finite numbers that rise strictly")
    return t


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
    elastic: FloatArray = (g + z) @ modes.force_shape.T
    return elastic


def half_sine(modes: Modes, force: npt.ArrayLike, duration_s: float, times_s: npt.ArrayLike) -> FloatArray:
    """Return the elastic force (m, 3) from rest under force sin(pi t / duration) up to ``duration``, then none."""
    t, F = np.asarray(times_s, dtype=np.float64), np.asarray(force, dtype=np.float64)
    during = t <= duration_s
    zero = np.zeros(3)
    elastic, _ = (
        harmonic(modes, zero, zero, F, 0.5 / duration_s, t[during]) if during.any() else (np.empty((0, 3)), None)
    )
    _, end = harmonic(modes, zero, zero, F, 0.5 / duration_s, [duration_s])
    after, _ = free(modes, end, t[~during] - duration_s)
    return np.vstack((elastic, after @ modes.force_shape.T))
