"""Impact with a Hertzian contact, P = k overlap^1.5: adaptive, of order 14, with exact landing on begin and end.

overlap^1.5 is not smooth where the contact begins and ends. There the square root of the overlap is the independent
variable: P is a cube in it, all is smooth, and the end of contact is its zero, not something to search for. In between,
time is. Tolerance per step 1e-14 of the impact's size (the square root of twice its energy); times and peak come out
within 1e-12 relative of the closed form on rigid ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.sensor.dynamics.assembly import Assembly, Striker
from tipforce.sensor.dynamics.extrapolation import adapted, step
from tipforce.sensor.dynamics.first_order_hold import State
from tipforce.sensor.dynamics.model import Modes
from tipforce.sensor.dynamics.switched import March, Touch

FloatArray = npt.NDArray[np.float64]

TOLERANCE = 1e-14
_NEAR = 0.3
"""Of the largest root of the overlap on rigid ground: nearer to 0 than this the root is the variable."""
_MOST_STEPS = 200_000


def hertz_impact(
    modes: Modes | None, striker: Striker, until_s: float, times_s: FloatArray, start: State | None
) -> tuple[tuple[Touch, ...], FloatArray, FloatArray, FloatArray, float, State]:
    """Return the fields of ``impact.Impact``; see there."""
    run = _Run(modes, striker, start, times_s, until_s)
    while run.time_s < until_s:
        if run.in_contact:
            run.contact()
        else:
            run.free()
    return run.result()


class _Run:
    """States as in Assembly, whose linear contact serves the free flight; time is one more entry of ``y``."""

    def __init__(
        self, modes: Modes | None, striker: Striker, start: State | None, times_s: FloatArray, until_s: float
    ) -> None:
        along = np.zeros(0) if modes is None else modes.load_shape @ striker.direction
        self._mass = 1.0 / (1.0 / striker.mass_kg + float(along @ along))
        self._k, self._until_s = striker.stiffness, until_s
        deepest = self._deepest(striker.speed_m_s)
        self._assembly = Assembly(modes, replace(striker, exponent=1.0, stiffness=striker.stiffness * deepest))
        self._A, self._push = self._assembly.system.A, self._assembly.system.push[:, 0]
        self._overlap = self._assembly.system.closure[0]
        self._speed = self._overlap @ self._A
        self._y = np.append(self._assembly.start(start), 0.0)
        self._scale = math.sqrt(self._mass) * striker.speed_m_s
        self._touches: list[Touch] = []
        self._samples = [float(time_s) for time_s in times_s]
        self._rows: list[tuple[FloatArray, FloatArray, float]] = []
        self._steps = 0
        self.in_contact = True

    @property
    def time_s(self) -> float:
        """Time now."""
        return float(self._y[-1])

    def contact(self) -> None:
        """From touch to parting, or to the end of the run."""
        self._note(self._y, at_least=self.time_s)
        self._touches.append(Touch(0, self.time_s, math.inf, 0.0, self.time_s))
        near = _NEAR * self._deepest(float(self._speed @ self._y[:-1]))
        root = self._by_root(0.0, near)
        if root is None:
            raise InputError("Hertzian contact: the touch is too slow to resolve; allowed is a speed above rounding")
        may_land = True
        h = 0.1 * near * near / max(float(self._speed @ self._y[:-1]), 1e-300)
        while self.time_s < self._until_s:
            rate, overlap = float(self._speed @ self._y[:-1]), float(self._overlap @ self._y[:-1])
            may_land = may_land or rate > 0.0
            if may_land and rate < 0.0 and overlap < near * near:
                root = self._by_root(math.sqrt(overlap), 0.0)
                if root == 0.0:
                    self._touches[-1] = self._touches[-1]._replace(end_s=self.time_s)
                    self.in_contact = False
                    return
                may_land = False
            else:
                h = self._by_time(h)

    def free(self) -> None:
        """From parting to the next touch, or to the end of the run."""
        march = March(self._assembly.system, self._y[:-1], self.time_s)
        march.part(0)
        while march.time_s < self._until_s:
            target = min([*self._samples[:1], self._until_s])
            if march.advance(target, stop_at_event=True):
                self.in_contact = True
                break
            if self._samples and march.time_s >= self._samples[0]:
                self._note(np.append(march.state, march.time_s), at_least=march.time_s)
        self._y = np.append(march.state, march.time_s)
        if self.in_contact:
            # The overlap is 0 by definition now, not by rounding.
            self._y[self._assembly.overlap] = 0.0

    def result(self) -> tuple[tuple[Touch, ...], FloatArray, FloatArray, FloatArray, float, State]:
        """What ``hertz_impact`` returns."""
        X = self._y[:-1]
        return (
            tuple(self._touches), np.array([row[0] for row in self._rows]).reshape(-1, 3),
            np.array([row[1] for row in self._rows]).reshape(-1, 3),
            np.array([row[2] for row in self._rows]).reshape(-1, 1),
            self._assembly.body_speed(X), self._assembly.structure(X),
        )  # fmt: skip

    def _deepest(self, speed: float) -> float:
        """Root of the largest overlap on rigid ground: (5 m v^2 / 4 k)^(1/5)."""
        return float((1.25 * self._mass * speed * speed / self._k) ** 0.2)

    def _rate_by_time(self, y: FloatArray) -> FloatArray:
        overlap = float(self._overlap @ y[:-1])
        if overlap < 0.0:
            return np.full(len(y), math.nan)  # beyond the contact: the step is refused
        return np.append(self._A @ y[:-1] + self._push * (self._k * overlap * math.sqrt(overlap)), 1.0)

    def _rate_by_root(self, y: FloatArray, sense: float) -> FloatArray:
        """y with the root of the overlap in place of the overlap's own entry."""
        root = float(y[self._assembly.overlap])
        X = y[:-1].copy()
        X[self._assembly.overlap] = 0.0  # nothing but the contact force depends on it
        speed = float(self._speed @ X)
        if not speed * sense > 0.0:
            return np.full(len(y), math.nan)
        dt = 2.0 * root / speed
        rate = np.append((self._A @ X + self._push * (self._k * root * root * root)) * dt, dt)
        rate[self._assembly.overlap] = 1.0
        return rate

    def _by_root(self, root: float, target: float) -> float | None:
        """Go from one root of the overlap to another; the root reached, None where no step was possible."""
        sense = 1.0 if target > root else -1.0
        index, unit = self._assembly.overlap, 1.0 / self._overlap[self._assembly.overlap]

        def rate(y: FloatArray) -> FloatArray:
            return self._rate_by_root(y, sense)

        def true_state(y: FloatArray) -> FloatArray:
            X = y.copy()
            X[index] = y[index] ** 2 * unit
            return X

        h, moved, reached = 0.25 * (target - root), False, root
        y = self._y.copy()
        while reached != target and true_state(y)[-1] < self._until_s:
            y[index] = reached
            after, error = self._step(rate, y, h)
            if not error <= TOLERANCE * self._scale:
                h = adapted(h, error, TOLERANCE * self._scale)
                if abs(h) < 1e-4 * abs(target - root):
                    break
                continue
            if after[-1] > self._until_s:
                h, after = self._to_time(rate, y, h, self._until_s)
            self._samples_within(rate, y, h, after, true_state)
            last = abs(target - reached - h) <= 1e-12 * abs(h)
            reached, y, moved = (target if last else reached + h), after, True
            h = min(adapted(h, error, TOLERANCE * self._scale), target - reached, key=abs)
        y[index] = reached
        self._y = true_state(y)
        return reached if moved else None

    def _by_time(self, h: float) -> float:
        """One accepted step; the next length to try."""
        h = min(h, self._until_s - self.time_s)
        while True:
            after, error = self._step(self._rate_by_time, self._y, h)
            if error <= TOLERANCE * self._scale and self._overlap @ after[:-1] > 0.0:
                break
            h = min(adapted(h, error, TOLERANCE * self._scale), 0.5 * h)
        self._note_peak(h, after)
        self._samples_within(self._rate_by_time, self._y, h, after, lambda y: y)
        if self.time_s + h >= self._until_s:
            after[-1] = self._until_s
        self._y = after
        return adapted(h, error, TOLERANCE * self._scale)

    def _step(self, rate: Callable[[FloatArray], FloatArray], y: FloatArray, h: float) -> tuple[FloatArray, float]:
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise InputError(
                f"Hertzian contact: {_MOST_STEPS} steps were not enough to reach {self._until_s!r} s; allowed are "
                "shorter runs or softer contacts"
            )
        return step(rate, y, h)

    def _note_peak(self, h: float, after: FloatArray) -> None:
        before_rate, after_rate = float(self._speed @ self._y[:-1]), float(self._speed @ after[:-1])
        if before_rate > 0.0 >= after_rate:
            _, after = _locate(self._rate_by_time, self._y, h, lambda y: -float(self._speed @ y[:-1]))
        force = self._force(after)
        if force > self._touches[-1].peak_newtons:
            self._touches[-1] = self._touches[-1]._replace(peak_newtons=force, peak_s=float(after[-1]))

    def _force(self, y: FloatArray) -> float:
        overlap = max(float(self._overlap @ y[:-1]), 0.0)
        return self._k * overlap * math.sqrt(overlap)

    def _samples_within(
        self,
        rate: Callable[[FloatArray], FloatArray],
        y: FloatArray,
        h: float,
        after: FloatArray,
        true_state: Callable[[FloatArray], FloatArray],
    ) -> None:
        while self._samples and self._samples[0] <= after[-1]:
            _, found = self._to_time(rate, y, h, self._samples[0]) if self._samples[0] > y[-1] else (0.0, y)
            self._note(true_state(found), at_least=self._samples[0])

    def _to_time(
        self, rate: Callable[[FloatArray], FloatArray], y: FloatArray, h: float, time_s: float
    ) -> tuple[float, FloatArray]:
        part, found = _locate(rate, y, h, lambda y: float(y[-1]) - time_s)
        found[-1] = time_s
        return part, found

    def _note(self, y: FloatArray, at_least: float) -> None:
        """Samples that are due at this very time."""
        while self._samples and self._samples[0] <= at_least:
            arms, vertical = self._assembly.elastic(y[:-1], np.zeros(1))
            self._rows.append((arms, vertical, self._force(y) if self.in_contact else 0.0))
            self._samples.pop(0)


def _locate(
    rate: Callable[[FloatArray], FloatArray], y: FloatArray, h: float, event: Callable[[FloatArray], float]
) -> tuple[float, FloatArray]:
    """The part of a step after which ``event``, negative before and not after it, is 0: regula falsi, Illinois."""
    low, high = 0.0, h
    value_low, end = event(y), step(rate, y, h)[0]
    value_high, side = event(end), 0
    for _ in range(60):
        if value_high == 0.0 or abs(high - low) <= 4e-16 * abs(h):
            break
        guess = high - value_high * (high - low) / (value_high - value_low)
        if not min(low, high) < guess < max(low, high):
            guess = 0.5 * (low + high)
        found = step(rate, y, guess)[0]
        value = event(found)
        # Illinois: the end that stays twice counts half, so both close in.
        if value < 0.0:
            low, value_low, value_high, side = guess, value, (0.5 * value_high if side == -1 else value_high), -1
        else:
            high, value_high, end = guess, value, found
            value_low, side = (0.5 * value_low if side == 1 else value_low), 1
    return high, end
