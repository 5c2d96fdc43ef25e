"""Impact with a Hertzian contact, P = k overlap^1.5: scipy's DOP853 in contact, matrix exponentials in free flight.

The end of contact and the peak are events on the integrator's dense output. Relative tolerance per step 1e-13: times,
peak and rebound speed agree with the closed form on rigid ground within 1e-11.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import EnvironmentLackError
from tipforce.sensor.dynamics.first_order_hold import State
from tipforce.sensor.dynamics.model import Modes
from tipforce_lab.dynamics.assembly import Assembly, Striker
from tipforce_lab.dynamics.switched import March, Touch

RELATIVE_TOLERANCE = 1e-13
_ABSOLUTE = 1e-16
"""Relative to the square root of twice the impact's energy, the scale of the states."""


def hertz_impact(
    modes: Modes | None, striker: Striker, until_s: float, times_s: FloatArray, start: State | None
) -> tuple[tuple[Touch, ...], FloatArray, FloatArray, FloatArray, float, State]:
    """Return the fields of ``impact.Impact``; see there. Raises EnvironmentLackError without scipy."""
    run = _Run(modes, striker, start, times_s, until_s)
    while run.time_s < until_s:
        run.contact()
        run.free()
    rows = np.array(run.rows).reshape(-1, 7)
    body_speed, structure = run.assembly.body_speed(run.state), run.assembly.structure(run.state)
    return tuple(run.touches), rows[:, :3], rows[:, 3:6], rows[:, 6:], body_speed, structure


class _Run:
    """States as in Assembly, whose linear contact computes the free flight."""

    def __init__(
        self, modes: Modes | None, striker: Striker, start: State | None, times_s: FloatArray, until_s: float
    ) -> None:
        along = np.zeros(0) if modes is None else modes.load_shape @ striker.direction
        mass = 1.0 / (1.0 / striker.mass_kg + float(along @ along))
        self._stiffness, self._until_s, self._samples = striker.stiffness, until_s, times_s
        # On rigid ground the square of this is the largest overlap.
        deepest = (1.25 * mass * striker.speed_m_s**2 / striker.stiffness) ** 0.2
        self.assembly = Assembly(modes, replace(striker, exponent=1.0, stiffness=striker.stiffness * deepest))
        self._A, self._push = self.assembly.system.A, self.assembly.system.push[:, 0]
        self._overlap = self.assembly.system.closure[0]
        self._scale = math.sqrt(mass) * striker.speed_m_s
        self.state, self.time_s = self.assembly.start(start), 0.0
        self.touches: list[Touch] = []
        self.rows: list[FloatArray] = []

    def contact(self) -> None:
        """Integrate from contact to separation, or to the end of the run."""
        try:
            from scipy.integrate import solve_ivp
        except ImportError as error:
            raise EnvironmentLackError('Hertzian contact needs scipy: pip install "tipforce[science]"') from error

        def parting(_: float, X: FloatArray) -> float:
            return float(self._overlap @ X)

        def turning(_: float, X: FloatArray) -> float:
            return float(self._overlap @ (self._A @ X))

        parting.terminal = True  # type: ignore[attr-defined]
        parting.direction = turning.direction = -1.0  # type: ignore[attr-defined]
        found = solve_ivp(
            self._rate, (self.time_s, self._until_s), self.state, method="DOP853", events=(parting, turning),
            rtol=RELATIVE_TOLERANCE, atol=_ABSOLUTE * self._scale, dense_output=True,
        )  # fmt: skip
        end_s, parted = float(found.t[-1]), found.status == 1
        self._note_until(end_s, found.sol)
        peak_newtons, peak_s = max(
            (self._force(X), float(time_s))
            for time_s, X in ((end_s, found.y[:, -1]), *zip(found.t_events[1], found.y_events[1], strict=True))
        )
        self.touches.append(Touch(0, self.time_s, end_s if parted else math.inf, peak_newtons, peak_s))
        self.state, self.time_s = found.y[:, -1], end_s
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

    def _rate(self, _: float, X: FloatArray) -> FloatArray:
        rate: FloatArray = self._A @ X + self._push * self._force(X)
        return rate

    def _force(self, X: FloatArray) -> float:
        return self._stiffness * math.pow(max(float(self._overlap @ X), 0.0), 1.5)

    def _note_until(self, end_s: float, state_at: Callable[[float], FloatArray]) -> None:
        """Add the samples up to a time."""
        due = int(np.searchsorted(self._samples, end_s, side="right"))
        for time_s in self._samples[:due]:
            X = state_at(float(time_s))
            self.rows.append(np.concatenate((*self.assembly.elastic(X, np.zeros(1)), [self._force(X)])))
        self._samples = self._samples[due:]
