"""Other integrators, for comparison with first_order_hold.py alone, closed_form() as reference; and the error of none.
All return the elastic force (m, 3) at times (m,), infinite or NaN if unstable; an open contact is a force of 0."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import State, holds
from tipforce.sensor.dynamics.model import HIGHEST_DAMPING_RATIO, Modes
from tipforce_lab.dynamics.impact import Assembly, Striker

Load = Callable[[float], FloatArray]
"""Time in s -> F (3,) in newtons."""

SCIPY_METHODS = ("Radau", "BDF", "LSODA", "DOP853")


class Problem:
    """The modes under a load, or struck by a body of finite mass with linear contact; at rest at the start."""

    def __init__(self, modes: Modes, striker: Striker | None = None) -> None:
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


def runge_kutta_4(problem: Problem, load: Load, times_s: npt.ArrayLike) -> FloatArray:
    """Integrate by the classic method, order 4, a step from time to time, stable up to rk4_stability_limit()."""
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
    return np.array(elastic)


def newmark(problem: Problem, load: Load, times_s: npt.ArrayLike) -> FloatArray:
    """Integrate by average acceleration (beta 1/4, gamma 1/2): order 2, stable at any step, no numerical damping."""
    return _alpha(problem, load, times_s, 0.0, 0.0)


def generalised_alpha(problem: Problem, load: Load, times_s: npt.ArrayLike, rho_inf: float = 0.8) -> FloatArray:
    """Integrate as Chung and Hulbert (1993): order 2, stable; rho_inf, 0 to 1: factor a step of a far too fast mode."""
    return _alpha(problem, load, times_s, (2.0 * rho_inf - 1.0) / (rho_inf + 1.0), rho_inf / (rho_inf + 1.0))


def scipy_method(problem: Problem, load: Load, times_s: npt.ArrayLike, method: str, rtol: float) -> FloatArray:
    """Integrate by one of SCIPY_METHODS, atol as rtol of the state of 1 N. A run that scipy abandons ends in NaN."""
    from scipy.integrate import solve_ivp

    def jacobian(_: float, X: FloatArray) -> FloatArray:
        if problem.push is None or not float(problem.closure @ X) > 0.0:
            return problem.A
        return np.add(problem.A, problem.stiffness * np.outer(problem.push, problem.closure))

    t = _times(times_s)
    solution = solve_ivp(
        lambda time_s, X: problem.rate(load(time_s), X), (t[0], t[-1]), problem.start,
        method=method, t_eval=t, rtol=rtol, atol=rtol * problem.size,
        **({} if method == "DOP853" else {"jac": jacobian}),
    )  # fmt: skip
    elastic = np.full((len(t), 3), np.nan)
    elastic[: solution.y.shape[1]] = solution.y.T @ problem.output.T
    return elastic


def rk4_stability_limit(damping_ratio: float) -> float:
    """Return the largest omega h at which RK4 amplifies no mode. Raises InputError for ratios outside 0 to 1e6."""
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


def _alpha(problem: Problem, load: Load, times_s: npt.ArrayLike, alpha_m: float, alpha_f: float) -> FloatArray:
    """Newmark's family in accelerations. The contact is open or closed at the end of each step: both are tried."""
    t = _times(times_s)  # equally spaced
    K, C, shape, v, output, along = _second_order(problem)
    d, h = np.zeros_like(v), float(t[1] - t[0])
    gamma, beta = 0.5 - alpha_m + alpha_f, 0.25 * (1.0 - alpha_m + alpha_f) ** 2
    f, m = 1.0 - alpha_f, 1.0 - alpha_m
    pressed = problem.stiffness * np.outer(along, along)
    open_, closed = (
        np.linalg.inv(m * np.eye(len(d)) + f * h * gamma * np.diag(C) + f * h * h * beta * (np.diag(K) + extra))
        for extra in (0.0, pressed)
    )
    a = shape @ load(t[0]) - C * v - K * d
    elastic = [output @ d]
    for k in range(len(t) - 1):
        F = shape @ load(f * t[k + 1] + alpha_f * t[k])
        d_free, v_free = d + h * v + h * h * (0.5 - beta) * a, v + h * (1.0 - gamma) * a
        d_known, v_known = f * d_free + alpha_f * d, f * v_free + alpha_f * v
        force = F - C * v_known - K * d_known - alpha_m * a
        new = open_ @ force
        if problem.push is not None and along @ (d_known + f * h * h * beta * new) > 0.0:
            new = closed @ (force - pressed @ d_known)
        d, v, a = d_free + h * h * beta * new, v_free + h * gamma * new, new
        elastic.append(output @ d)
    return np.array(elastic)


def _second_order(problem: Problem) -> tuple[FloatArray, ...]:
    """Mass-normalised: K, C (N,) diagonals, load shape (N, 3), start v (N,), output (3, N), overlap row (N,)."""
    modes, striker, omega = problem.modes, problem.striker, problem.modes.omega_rad_s
    K, C, output = omega * omega, 2.0 * modes.damping_ratio * omega, modes.force_shape * omega * omega
    if striker is None:
        return K, C, modes.load_shape, np.zeros_like(omega), output, np.zeros_like(omega)
    root = striker.mass_kg**0.5
    along = np.append(-modes.load_shape @ striker.direction, 1.0 / root)
    v = np.append(np.zeros_like(omega), striker.speed_m_s * root)
    shape, output = np.pad(modes.load_shape, ((0, 1), (0, 0))), np.pad(output, ((0, 0), (0, 1)))
    return np.append(K, 0.0), np.append(C, 0.0), shape, v, output, along


def _times(times_s: npt.ArrayLike) -> FloatArray:
    t = np.asarray(times_s, dtype=np.float64)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or not (np.diff(t) > 0.0).all():
        raise InputError(f"times of shape {t.shape}: allowed are two or more finite numbers that rise strictly")
    return t


def free(modes: Modes, start: State, times_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return modal positions and velocities (m, n) at times (m,) after a start, without load."""
    held = [holds(modes, float(time_s)) for time_s in np.asarray(times_s, dtype=np.float64)]
    p11, p12, p21, p22 = np.array(held).reshape(-1, len(modes.omega_rad_s), 8)[..., :4].transpose(2, 0, 1)
    z, w = start
    return p11 * z + p12 * w, p21 * z + p22 * w


@dataclass(frozen=True, slots=True, eq=False)
class Wave:
    """A load with a closed solution: a force times mean + cosine cos(2 pi f t) + sine sin(2 pi f t), then none."""

    force: FloatArray
    """(3,)."""
    mean: float
    cosine: float
    sine: float
    frequency_hz: float
    """No mode may be undamped at exactly that frequency."""
    until_s: float = math.inf

    def __call__(self, time_s: float) -> FloatArray:
        """Return F (3,) at a time."""
        angle = 2.0 * math.pi * self.frequency_hz * time_s
        factor = self.mean + self.cosine * math.cos(angle) + self.sine * math.sin(angle)
        return self.force * (factor if time_s < self.until_s else 0.0)


def closed_form(modes: Modes, wave: Wave, times_s: npt.ArrayLike) -> FloatArray:
    """Return the elastic force (m, 3) from rest under a wave, at rising times (m,)."""
    t = np.asarray(times_s, dtype=np.float64)
    during = t <= wave.until_s
    z, _ = _forced(modes, wave, t[during])
    if not during.all():
        at_end, speed_at_end = _forced(modes, wave, np.array([wave.until_s]))
        z = np.vstack((z, free(modes, State(at_end[0], speed_at_end[0]), t[~during] - wave.until_s)[0]))
    return z @ modes.force_shape.T


def _forced(modes: Modes, wave: Wave, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return modal positions and velocities (m, n): the steady state, and the free motion that matches the start."""
    ratio = wave.frequency_hz / modes.frequency_hz
    per_newton = modes.load_shape @ wave.force
    amplitude = per_newton * (wave.cosine - 1j * wave.sine)
    amplitude = amplitude / ((1.0 - ratio) * (1.0 + ratio) + 2j * modes.damping_ratio * ratio)
    static = per_newton * wave.mean
    turning = amplitude * np.exp(2j * math.pi * wave.frequency_hz * times_s[:, np.newaxis])
    z, w = free(modes, State(-static - amplitude.real, np.asarray((ratio * amplitude).imag)), times_s)
    return static + turning.real + z, (1j * ratio * turning).real + w


def quasi_static_error(modes: Modes, frequency_hz: npt.ArrayLike) -> FloatArray:
    """Return the largest error, over all directions of F, of the elastic force relative to a sinusoidal load, (...)."""
    ratio = np.asarray(frequency_hz, dtype=np.float64)[..., np.newaxis] / modes.frequency_hz
    # gain - 1 without the difference of two numbers near 1.
    squared = ratio * ratio - 2j * modes.damping_ratio * ratio
    gain = squared / (1.0 - squared)
    error = (modes.force_shape * gain[..., np.newaxis, :]) @ modes.load_shape
    largest: FloatArray = np.linalg.norm(error, ord=2, axis=(-2, -1))
    return largest


def frequency_of_error(modes: Modes, error: float) -> float:
    """Return the lowest Hz at which quasi_static_error() is ``error``. Raises InputError unless 0 < error <= 0.5."""
    if not 0.0 < error <= 0.5:
        raise InputError(f"error = {error!r}: allowed is above 0, at most 0.5")
    low, high = 0.0, 0.9 * float(modes.frequency_hz[0])
    while float(quasi_static_error(modes, high)) < error:
        high = 0.5 * (high + float(modes.frequency_hz[0]))
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if float(quasi_static_error(modes, middle)) < error else (low, middle)
    return high
