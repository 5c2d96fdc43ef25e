"""Impact of a body on the tip, or of the finger on a stop. Linear contact is exact (switched.py), Hertzian contact
scipy's DOP853; it starts at time 0, may open and close again, and is lossless. States: omega q and q' of every mode,
overlap and speed of the body, the load and its rate, and a constant; energy is half the sum of squares."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError, needing
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.dynamics.first_order_hold import State, checked_loads
from tipforce.sensor.dynamics.model import Modes
from tipforce_lab.dynamics.switched import March, SlitStop, Switched, Touch


@dataclass(frozen=True, slots=True)
class Striker:
    """A body that strikes the tip. Raises InputError for values out of range."""

    mass_kg: float
    """inf: a stop that the finger hits at constant speed."""
    speed_m_s: float
    """Towards the tip, relative to the fixture."""
    stiffness: float
    """Of the contact: N/m for exponent 1, N/m^1.5 for 1.5 (Hertz)."""
    exponent: float = 1.0
    theta_rad: float = 0.5 * math.pi
    """Place on the tip, where it pushes along the inward normal: phi is theta + pi."""

    def __post_init__(self) -> None:
        if not self.mass_kg > 0.0:
            raise InputError(f"mass_kg = {self.mass_kg!r}: allowed is above 0; inf is a stop that does not yield")
        for name, value in (("speed_m_s", self.speed_m_s), ("contact stiffness", self.stiffness)):
            if not 0.0 < value < math.inf:
                raise InputError(f"{name} = {value!r}: allowed is a positive finite number")
        if self.exponent not in (1.0, 1.5):
            raise InputError(f"contact exponent = {self.exponent!r}: allowed is 1 (linear) or 1.5 (Hertz)")
        if not math.isfinite(self.theta_rad):
            raise InputError(f"theta_rad = {self.theta_rad!r}: allowed is a finite angle")

    @property
    def direction(self) -> FloatArray:
        """F per newton of contact force, (3,)."""
        return force_vector(1.0, self.theta_rad + math.pi, self.theta_rad)


RIGID_GROUND = Modes(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((3, 0)), np.zeros((3, 0)))


class Assembly:
    """The system and the meaning of its states."""

    def __init__(self, modes: Modes, striker: Striker | None = None, slit: SlitStop | None = None) -> None:
        self.modes, self.striker, self.slit, omega = modes, striker, slit, modes.omega_rad_s
        n = self.n = len(omega)
        heavy = striker is None or math.isinf(striker.mass_kg)
        self._speed_scale = 1.0 if striker is None or heavy else math.sqrt(striker.mass_kg)
        self._gap_unit = 1.0 if slit is None else math.sqrt(float(slit.compliance[0, 0]))
        self.overlap, self.speed, self.load, self.rate, self.one = 2 * n, 2 * n + 1, 2 * n + 2, 2 * n + 5, 2 * n + 8
        size = 2 * n + 9
        A, speeds = np.zeros((size, size)), slice(n, 2 * n)
        A[self.load : self.rate, self.rate : self.one] = np.eye(3)
        A[:n, speeds], A[speeds, :n] = np.diag(omega), -np.diag(omega)
        A[speeds, speeds] = -2.0 * np.diag(modes.damping_ratio * omega)
        A[speeds, self.load : self.rate] = modes.load_shape
        body = 0 if striker is None else 1
        count = body + (0 if slit is None else len(slit.compliance))
        push, closure, compliance = np.zeros((size, count)), np.zeros((count, size)), np.zeros((count, count))
        if striker is not None:
            root, along = math.sqrt(striker.stiffness), modes.load_shape @ striker.direction
            A[self.overlap, self.speed], A[self.overlap, speeds] = root / self._speed_scale, -root * along
            push[speeds, 0], push[self.speed, 0] = along, 0.0 if heavy else -1.0 / self._speed_scale
            closure[0, self.overlap], compliance[0, 0] = 1.0 / root, 1.0 / striker.stiffness
        if slit is not None:
            compliance[body:, body:] = slit.compliance
            for j, per_newton in enumerate(slit.closure_per_newton, body):
                closure[j, :n] = per_newton @ modes.force_shape * omega
                closure[j, self.one] = -self._gap_unit
                push[speeds, j] = -closure[j, :n] * omega
        self.system = Switched(A, push, closure, compliance)

    def start(self) -> FloatArray:
        """Return the state at the moment of contact: structure at rest, no load."""
        X = np.zeros(len(self.system.A))
        if self.striker is not None:
            X[self.speed] = self.striker.speed_m_s * self._speed_scale
        if self.slit is not None:
            X[self.one] = self.slit.gap_m / self._gap_unit
        return X

    def impact(self, X: FloatArray, touches: tuple[Touch, ...], samples: list[_Sample]) -> Impact:
        """Return the results of a run that ends in state X."""
        omega = self.modes.omega_rad_s
        arms, vertical, contact = (
            np.array([sample[k] for sample in samples]).reshape(-1, width)
            for k, width in enumerate((3, 3, len(self.system.closure)))
        )
        body_speed = float(X[self.speed]) / self._speed_scale if self.striker else 0.0
        structure = State(X[: self.n] * omega, X[self.n : 2 * self.n] * omega)
        return Impact(touches, arms, vertical, contact, body_speed, structure)

    def sample(self, X: FloatArray, contact_newtons: FloatArray) -> _Sample:
        """Return what a run keeps of one time."""
        z = X[: self.n] * self.modes.omega_rad_s
        arms, vertical = self.modes.force_shape @ z, self.modes.vertical_force_shape @ z
        if self.slit is not None:
            stops = contact_newtons[-len(self.slit.closure_per_newton) :]
            arms, vertical = arms + self.slit.arms_per_newton @ stops, vertical + self.slit.vertical_per_newton @ stops
        return arms, vertical, contact_newtons


_Sample = tuple[FloatArray, FloatArray, FloatArray]
"""Elastic force (3,) in the arms and in the vertical beam, and the contact forces (n,)."""


class Impact(NamedTuple):
    """Results between 0 and the end of a run."""

    touches: tuple[Touch, ...]
    """Contact 0 is the body's, if there is one; the next two are the stops of the left and right arm."""
    elastic_newtons: FloatArray
    """(m, 3): F in the arms at the sample times: the gauges measure it, plus local bending near a closed stop."""
    vertical_newtons: FloatArray
    """(m, 3): F in the vertical beam."""
    contact_newtons: FloatArray
    """(m, n): force of each contact at the sample times."""
    body_speed_m_s: float
    """At the end, towards the tip: negative after a rebound."""
    structure: State
    """At the end."""


def impact(
    modes: Modes | None, striker: Striker, until_s: float, times_s: npt.ArrayLike = (), slit: SlitStop | None = None
) -> Impact:
    """Return the course of an impact on a structure at rest (modes None: rigid ground) at times_s (m,), 0 to until_s.
    Raises InputError for times, too many steps, a Hertzian contact with a slit; EnvironmentLackError without scipy."""
    t = floats("times_s", times_s).reshape(-1)
    if not 0.0 < until_s < math.inf:
        raise InputError(f"until_s = {until_s!r}: allowed is a positive finite number")
    if not ((t >= 0.0) & (t <= until_s)).all() or (np.diff(t) < 0.0).any():
        raise InputError(f"times: allowed are rising numbers from 0 to until_s, {until_s!r}")
    ground = RIGID_GROUND if modes is None else modes
    if striker.exponent != 1.0:
        if slit is not None:
            raise InputError("a Hertzian contact and a slit in one run: allowed is a linear contact with a slit")
        if modes is None and math.isinf(striker.mass_kg):
            raise InputError("a stop on rigid ground, where neither yields: allowed is a body of finite mass")
        return _HertzRun(ground, striker, t, until_s).impact()
    if modes is None and slit is not None:
        raise InputError("a slit on rigid ground: allowed with the modes of a structure only")
    assembly = Assembly(ground, striker, slit)
    march, samples = March(assembly.system, assembly.start()), list[_Sample]()
    march.close(0)
    for time_s in t.tolist():
        march.advance(time_s)
        samples.append(assembly.sample(march.state, march.forces_newtons))
    march.advance(until_s)
    return assembly.impact(march.state, march.finish(), samples)


def overload(modes: Modes, slit: SlitStop, times_s: npt.ArrayLike, loads_newtons: npt.ArrayLike) -> Impact:
    """Return the response of a structure with a stop to a load that is linear between its samples, (m,) and (m, 3).
    Raises InputError for times that do not rise strictly, shapes that do not fit, or loads that are not finite."""
    t, F = floats("times_s", times_s), checked_loads(loads_newtons)
    if t.shape != (len(F),) or not (np.diff(t) > 0.0).all() or not np.isfinite(t).all():
        raise InputError(f"times of shape {t.shape}: allowed are {len(F)} finite numbers that rise strictly")
    if not np.isfinite(F).all():
        raise InputError("loads: allowed are finite numbers")
    assembly = Assembly(modes, None, slit)
    march, samples = March(assembly.system, assembly.start(), float(t[0])), list[_Sample]()
    for k in range(len(t)):
        march.state[assembly.load : assembly.rate] = F[k]
        samples.append(assembly.sample(march.state, march.forces_newtons))
        if k + 1 < len(t):
            march.state[assembly.rate : assembly.one] = (F[k + 1] - F[k]) / (t[k + 1] - t[k])
            march.disturbed()
            march.advance(float(t[k + 1]))
    return assembly.impact(march.state, march.finish(), samples)


RELATIVE_TOLERANCE = 1e-13
_ABSOLUTE = 1e-16
"""Relative to the square root of twice the impact's energy, the scale of the states."""


class _HertzRun:
    """A Hertzian contact. States as in Assembly, whose linear contact computes the free flight."""

    def __init__(self, modes: Modes, striker: Striker, times_s: FloatArray, until_s: float) -> None:
        along = modes.load_shape @ striker.direction
        mass = 1.0 / (1.0 / striker.mass_kg + float(along @ along))
        self._stiffness, self._until_s, self._samples = striker.stiffness, until_s, times_s
        # On rigid ground the square of this is the largest overlap.
        deepest = (1.25 * mass * striker.speed_m_s**2 / striker.stiffness) ** 0.2
        self.assembly = Assembly(modes, replace(striker, exponent=1.0, stiffness=striker.stiffness * deepest))
        self._A, self._push = self.assembly.system.A, self.assembly.system.push[:, 0]
        self._overlap = self.assembly.system.closure[0]
        self._scale = math.sqrt(mass) * striker.speed_m_s
        self.state, self.time_s = self.assembly.start(), 0.0
        self.touches: list[Touch] = []
        self.rows: list[_Sample] = []

    def impact(self) -> Impact:
        """Run to the end. Raises EnvironmentLackError without scipy."""
        while self.time_s < self._until_s:
            self.contact()
            self.free()
        return self.assembly.impact(self.state, tuple(self.touches), self.rows)

    def contact(self) -> None:
        """Integrate from contact to separation, or to the end of the run."""
        with needing('Hertzian contact needs scipy: pip install "tipforce[science]"'):
            from scipy.integrate import solve_ivp

        def parting(_: float, X: FloatArray) -> float:
            return float(self._overlap @ X)

        def turning(_: float, X: FloatArray) -> float:
            return float(self._overlap @ (self._A @ X))

        parting.terminal = True  # type: ignore[attr-defined]
        parting.direction = turning.direction = -1.0  # type: ignore[attr-defined]
        solution = solve_ivp(
            lambda _, X: self._A @ X + self._push * self._force(X), (self.time_s, self._until_s), self.state,
            method="DOP853", events=(parting, turning), rtol=RELATIVE_TOLERANCE, atol=_ABSOLUTE * self._scale,
            dense_output=True,
        )  # fmt: skip
        end_s, parted = float(solution.t[-1]), solution.status == 1
        self._note_until(end_s, solution.sol)
        peak_newtons, peak_s = max(
            (self._force(X), float(time_s))
            for time_s, X in ((end_s, solution.y[:, -1]), *zip(solution.t_events[1], solution.y_events[1], strict=True))
        )
        self.touches.append(Touch(0, self.time_s, end_s if parted else math.inf, peak_newtons, peak_s))
        self.state, self.time_s = solution.y[:, -1], end_s
        if parted:
            self.state[self.assembly.overlap] = 0.0  # by definition, not by rounding

    def free(self) -> None:
        """Step from separation to the next contact, or to the end of the run."""
        march = March(self.assembly.system, self.state, self.time_s)
        march.part(0)
        touched = False
        while march.time_s < self._until_s and not touched:
            touched = march.advance(min([*self._samples[:1], self._until_s]), stop_at_event=True)
            if not touched:
                self._note_until(march.time_s, lambda _: march.state)
        self.state, self.time_s = march.state, march.time_s
        if touched:
            self.state[self.assembly.overlap] = 0.0

    def _force(self, X: FloatArray) -> float:
        return self._stiffness * math.pow(max(float(self._overlap @ X), 0.0), 1.5)

    def _note_until(self, end_s: float, state_at: Callable[[float], FloatArray]) -> None:
        due = int(np.searchsorted(self._samples, end_s, side="right"))
        for time_s in self._samples[:due]:
            X = state_at(float(time_s))
            self.rows.append(self.assembly.sample(X, np.array([self._force(X)])))
        self._samples = self._samples[due:]
