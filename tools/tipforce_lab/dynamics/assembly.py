"""Combine modes, a body that strikes the tip, the slit and a load into one switched linear system.

States: a = omega q and q' of every mode (mass-normalised), overlap and speed of the body, the load and its rate, and a
constant. They are scaled so that energy is half the sum of their squares: without damping and load the matrix is
skew-symmetric, and its exponential keeps lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import State
from tipforce.sensor.dynamics.model import Modes
from tipforce_lab.dynamics.slit import SlitStop
from tipforce_lab.dynamics.switched import Switched


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
    """Place on the tip."""
    phi_rad: float | None = None
    """Direction of the contact force on the tip; None is a push along the inward normal, theta + pi."""

    def __post_init__(self) -> None:
        if not self.mass_kg > 0.0:
            raise InputError(f"mass_kg = {self.mass_kg!r}: allowed is above 0; inf is a stop that does not yield")
        for name, value in (("speed_m_s", self.speed_m_s), ("contact stiffness", self.stiffness)):
            if not 0.0 < value < math.inf:
                raise InputError(f"{name} = {value!r}: allowed is a positive finite number")
        if self.exponent not in (1.0, 1.5):
            raise InputError(f"contact exponent = {self.exponent!r}: allowed is 1 (linear) or 1.5 (Hertz)")
        if not math.isfinite(self.theta_rad) or not (self.phi_rad is None or math.isfinite(self.phi_rad)):
            raise InputError("theta_rad and phi_rad: allowed are finite angles")

    @property
    def direction(self) -> FloatArray:
        """F per newton of contact force, (3,)."""
        phi = self.theta_rad + math.pi if self.phi_rad is None else self.phi_rad
        return np.array([math.sin(phi), math.sin(phi - self.theta_rad), math.cos(phi)])


class Assembly:
    """The system and the meaning of its states. modes None is rigid ground."""

    def __init__(self, modes: Modes | None, striker: Striker | None = None, slit: SlitStop | None = None) -> None:
        self.modes, self.striker, self.slit = modes, striker, slit
        n = self.n = 0 if modes is None else len(modes.omega_rad_s)
        self.overlap, self.speed, self.load, self.rate, self.one = 2 * n, 2 * n + 1, 2 * n + 2, 2 * n + 5, 2 * n + 8
        self.size = 2 * n + 9
        A = np.zeros((self.size, self.size))
        A[self.load : self.rate, self.rate : self.one] = np.eye(3)
        self._shape = np.zeros((0, 3)) if modes is None else modes.load_shape
        if modes is not None:
            omega = modes.omega_rad_s
            A[:n, n : 2 * n], A[n : 2 * n, :n] = np.diag(omega), -np.diag(omega)
            A[n : 2 * n, n : 2 * n] = -2.0 * np.diag(modes.damping_ratio * omega)
            A[n : 2 * n, self.load : self.rate] = modes.load_shape
        rows: list[tuple[FloatArray, FloatArray]] = []
        if striker is not None:
            rows.append(self._striker_rows(A, striker))
        if slit is not None:
            rows += self._slit_rows(slit)
        push = np.array([row[0] for row in rows]).reshape(-1, self.size).T
        closure = np.array([row[1] for row in rows]).reshape(-1, self.size)
        self.system = Switched(A, push, closure, self._compliance())

    def start(self, structure: State | None = None) -> FloatArray:
        """Return the state at the moment of contact: structure at rest if None, no load."""
        X = np.zeros(self.size)
        if self.modes is not None and structure is not None:
            X[: self.n] = structure.position / self.modes.omega_rad_s
            X[self.n : 2 * self.n] = structure.velocity / self.modes.omega_rad_s
        if self.striker is not None:
            X[self.speed] = self.striker.speed_m_s * self._speed_scale
        if self.slit is not None:
            X[self.one] = self.slit.gap_m / self._gap_unit
        return X

    def structure(self, X: FloatArray) -> State:
        """Return the state of the modes within X."""
        if self.modes is None:
            return State(np.zeros(0), np.zeros(0))
        omega = self.modes.omega_rad_s
        return State(X[: self.n] * omega, X[self.n : 2 * self.n] * omega)

    def body_speed(self, X: FloatArray) -> float:
        """Return the speed of the body towards the tip, m/s."""
        return float(X[self.speed]) / self._speed_scale

    def elastic(self, X: FloatArray, contact_newtons: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the elastic force (3,) in the arms and in the vertical beam."""
        if self.modes is None:
            return np.zeros(3), np.zeros(3)
        z = X[: self.n] * self.modes.omega_rad_s
        arms, vertical = self.modes.force_shape @ z, self.modes.vertical_force_shape @ z
        if self.slit is not None:
            stops = contact_newtons[-len(self.slit.closure_per_newton) :]
            arms, vertical = arms + self.slit.arms_per_newton @ stops, vertical + self.slit.vertical_per_newton @ stops
        return arms, vertical

    @property
    def _speed_scale(self) -> float:
        striker = self.striker
        if striker is None or not math.isfinite(striker.mass_kg):
            return 1.0
        return math.sqrt(striker.mass_kg)

    @property
    def _gap_unit(self) -> float:
        return 1.0 if self.slit is None else math.sqrt(float(self.slit.compliance[0, 0]))

    def _striker_rows(self, A: FloatArray, striker: Striker) -> tuple[FloatArray, FloatArray]:
        """Set the rates of overlap and speed; return (push, closure) of the contact."""
        n, root = self.n, math.sqrt(striker.stiffness)
        along = self._shape @ striker.direction
        A[self.overlap, self.speed] = root / self._speed_scale
        A[self.overlap, n : 2 * n] = -root * along
        push, closure = np.zeros(self.size), np.zeros(self.size)
        push[n : 2 * n] = along
        push[self.speed] = 0.0 if math.isinf(striker.mass_kg) else -1.0 / self._speed_scale
        closure[self.overlap] = 1.0 / root
        return push, closure

    def _slit_rows(self, slit: SlitStop) -> list[tuple[FloatArray, FloatArray]]:
        if self.modes is None:
            raise InputError("a slit on rigid ground: allowed with the modes of a structure only")
        rows = []
        for per_newton in slit.closure_per_newton:
            push, closure = np.zeros(self.size), np.zeros(self.size)
            closure[: self.n] = per_newton @ self.modes.force_shape * self.modes.omega_rad_s
            closure[self.one] = -self._gap_unit
            push[self.n : 2 * self.n] = -closure[: self.n] * self.modes.omega_rad_s
            rows.append((push, closure))
        return rows

    def _compliance(self) -> FloatArray:
        blocks = []
        if self.striker is not None:
            blocks.append(np.array([[1.0 / self.striker.stiffness]]))
        if self.slit is not None:
            blocks.append(self.slit.compliance)
        size = sum(len(block) for block in blocks)
        C, at = np.zeros((size, size)), 0
        for block in blocks:
            C[at : at + len(block), at : at + len(block)] = block
            at += len(block)
        return C
