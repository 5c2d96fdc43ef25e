"""A linear system with contacts that only press: exact between events, each event found to rounding.

    X' = A X + sum_j push_j N_j,    N >= 0,    closure - compliance N <= 0 where N = 0, = 0 where N > 0

closure_j = closure_row_j X is the overlap of contact j without contact forces. For every set of closed contacts the
state after any time is a matrix exponential. An event is a closing, or the end of the pressure of a closed contact.
Steps are short relative to the fastest oscillation and to the time since the last disturbance (a fast decay matters
only then), and turning points between steps are checked, so that a graze is found.

The slit (plane_frame.py) as a stop: an overload closes it, and the structure is stiffer from there. The arm yields
where it is pressed, as a beam with held ends; fixture and vertical beam feel the applied force alone."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.dynamics.model import Modes, compliances
from tipforce.sensor.structure.plane_frame import EULER_BERNOULLI, PAPER_SLIT_M, Frame
from tipforce.sensor.structure.strain import Geometry

_RADIANS_PER_STEP = 0.35
_MOST_STEPS = 2_000_000
_TERMS = 13
_ROUNDING = 2.0**-53


class Touch(NamedTuple):
    """One contact, from closing to opening."""

    contact: int
    begin_s: float
    end_s: float
    """inf if it was still closed at the end."""
    peak_newtons: float
    peak_s: float


class Switched(NamedTuple):
    """Matrices of the system above, N states and n contacts."""

    A: FloatArray
    """(N, N), all contacts open, 1/s."""
    push: FloatArray
    """(N, n): rate of the state per newton of each contact."""
    closure: FloatArray
    """(n, N): overlap in metres per state."""
    compliance: FloatArray
    """(n, n): metres per newton; symmetric positive definite."""


class _Regime(NamedTuple):
    A: FloatArray
    finest_s: float
    """Step that resolves the fastest oscillation or decay; inf if there is none."""
    coarsest_s: float
    """Step that resolves the fastest oscillation."""
    steps: dict[int, FloatArray]
    """k -> exp(A finest_s 2^k)."""
    forces: FloatArray
    """(n, N): N per state; rows of open contacts are 0."""
    violation: FloatArray
    """(n, N): positive, in metres, where contact j must change."""


def exponential(A: FloatArray) -> FloatArray:
    """Return exp(A), (N, N): Taylor's series of A / 2^k, squared k times. Relative error about 1e-15 for |A| near 1."""
    norm = float(np.linalg.norm(A, ord=1))
    halvings = max(0, math.frexp(norm)[1] + 2) if norm > 0.0 else 0
    small = A * 0.5**halvings
    # The identity is added last: E - 1 keeps the digits of values far below 1.
    change, term = small.copy(), small
    for n in range(2, _TERMS + 1):
        term = term @ small / n
        change += term
    for _ in range(halvings):
        change = change @ change + 2.0 * change
    return change + np.eye(len(A))


@dataclass(slots=True)
class March:
    """A run of a switched system. ``touches`` grows as contacts open; ``advance`` moves on in time."""

    system: Switched
    state: FloatArray
    time_s: float = 0.0
    touches: list[Touch] = field(default_factory=list)
    _closed: tuple[int, ...] = ()
    _begun: dict[int, Touch] = field(default_factory=dict)
    _fresh: tuple[int, ...] = ()
    _regimes: dict[tuple[int, ...], _Regime] = field(default_factory=dict)
    _steps: int = 0
    _disturbed_s: float = 0.0

    @property
    def forces_newtons(self) -> FloatArray:
        """Force of each contact now, (n,)."""
        return self._regime().forces @ self.state

    def advance(self, until_s: float, stop_at_event: bool = False) -> bool:
        """Run to ``until_s``; return True if an event stopped it before. Raises InputError beyond 2 million steps."""
        while self.time_s < until_s:
            regime = self._regime()
            wanted = min(0.3 * (self.time_s - self._disturbed_s), regime.coarsest_s) / regime.finest_s
            k = math.floor(math.log2(wanted)) if 1.0 < wanted < math.inf else 0
            left, h = until_s - self.time_s, math.ldexp(regime.finest_s, k)
            last = left <= h
            h = left if last else h
            if not last and k not in regime.steps:
                regime.steps[k] = exponential(regime.A * h)
            after = _moved(regime.A, self.state, h) if last else regime.steps[k] @ self.state
            event = self._first_event(regime, h, after)
            if event is None:
                self._note_peaks(regime, h, after)
                self.state, self.time_s, self._fresh = after, until_s if last else self.time_s + h, ()
            else:
                self._switch(regime, *event)
                if stop_at_event:
                    return True
            self._steps += 1
            if self._steps > _MOST_STEPS:
                raise InputError(
                    f"contact: {_MOST_STEPS} steps were not enough to reach {until_s!r} s; allowed are shorter runs, "
                    "softer contacts or structures"
                )
        return False

    def disturbed(self) -> None:
        """Note a kink of the load now: fast decays restart."""
        self._disturbed_s = self.time_s

    def close(self, contact: int) -> None:
        """Note that an open contact closes now, with overlap 0 and about to grow."""
        self._fresh, self._disturbed_s = (contact,), self.time_s
        self._closed = tuple(sorted((*self._closed, contact)))
        self._begun[contact] = Touch(contact, self.time_s, math.inf, 0.0, self.time_s)

    def part(self, contact: int) -> None:
        """Note that an open contact has just separated, with overlap 0 and about to fall."""
        self._fresh, self._disturbed_s = (contact,), self.time_s

    def finish(self) -> tuple[Touch, ...]:
        """Return all contacts by start."""
        return tuple(sorted([*self.touches, *self._begun.values()], key=lambda touch: touch.begin_s))

    def _regime(self) -> _Regime:
        if self._closed in self._regimes:
            return self._regimes[self._closed]
        system, closed = self.system, list(self._closed)
        forces = np.zeros_like(system.closure)
        if closed:
            forces[closed] = np.linalg.solve(system.compliance[np.ix_(closed, closed)], system.closure[closed])
        A = system.A + system.push @ forces
        violation = system.closure - system.compliance @ forces
        for j in closed:
            violation[j] = -forces[j] * system.compliance[j, j]
        poles = np.linalg.eigvals(A)
        fastest, turning = float(np.abs(poles).max()), float(np.abs(poles.imag).max())
        finest, coarsest = (_RADIANS_PER_STEP / pole if pole > 0.0 else math.inf for pole in (fastest, turning))
        return self._regimes.setdefault(self._closed, _Regime(A, finest, coarsest, {}, forces, violation))

    def _first_event(self, regime: _Regime, h: float, after: FloatArray) -> tuple[float, int] | None:
        now, then = regime.violation @ self.state, regime.violation @ after
        rate_now, rate_then = regime.violation @ (regime.A @ self.state), regime.violation @ (regime.A @ after)
        first: tuple[float, int] | None = None
        for j in range(len(now)):
            row, low, high = regime.violation[j], 0.0, h
            if j in self._fresh and rate_now[j] < 0.0:
                # It has just switched: the violation starts at 0, up to rounding, and falls. It may rise again.
                if then[j] <= 0.0:
                    continue
                low = _root(regime.A, self.state, row @ regime.A, 0.0, h)
            elif then[j] <= 0.0:
                if not (rate_now[j] > 0.0 > rate_then[j]):
                    continue
                high = _root(regime.A, self.state, -row @ regime.A, 0.0, h)
                if row @ _moved(regime.A, self.state, high) <= 0.0:
                    continue
            tau = _root(regime.A, self.state, row, low, high) if now[j] <= 0.0 or low > 0.0 else 0.0
            if first is None or tau < first[0]:
                first = tau, j
        return first

    def _note_peaks(self, regime: _Regime, h: float, after: FloatArray) -> None:
        for j in self._closed:
            row, tau = regime.forces[j], h
            slope = row @ regime.A
            if slope @ self.state > 0.0 > slope @ after:
                tau = _root(regime.A, self.state, -slope, 0.0, h)
            force = float(row @ (after if tau == h else _moved(regime.A, self.state, tau)))
            if force > self._begun[j].peak_newtons:
                self._begun[j] = self._begun[j]._replace(peak_newtons=force, peak_s=self.time_s + tau)

    def _switch(self, regime: _Regime, tau: float, contact: int) -> None:
        after = _moved(regime.A, self.state, tau)
        self._note_peaks(regime, tau, after)
        self.state, self.time_s = after, self.time_s + tau
        if contact in self._closed:
            self.part(contact)
            self._closed = tuple(j for j in self._closed if j != contact)
            self.touches.append(self._begun.pop(contact)._replace(end_s=self.time_s))
        else:
            self.close(contact)


def _moved(A: FloatArray, state: FloatArray, tau: float) -> FloatArray:
    return exponential(A * tau) @ state


def _root(A: FloatArray, state: FloatArray, row: FloatArray, low: float, high: float) -> float:
    """Find where row X(tau) rises through 0 in (low, high], by Newton's steps and bisection."""
    slope, size = row @ A, np.abs(row)
    tau = 0.5 * (low + high)
    for _ in range(100):
        moved = _moved(A, state, tau)
        value, rate = float(row @ moved), float(slope @ moved)
        if abs(value) <= _ROUNDING * float(size @ np.abs(moved)):
            return tau
        low, high = (low, tau) if value > 0.0 else (tau, high)
        better = tau - value / rate if rate > 0.0 else math.nan
        if not low < better < high:
            better = 0.5 * (low + high)
        if abs(better - tau) <= 2e-16 * high or better in (low, high):
            return better
        tau = better
    return high


STOP_STIFFNESS = 1e7
"""N/m of the contact alone, assumed; the arm behind it is softer (in the fabricated body 2.4e6 N/m)."""
CLOSE_ENOUGH, SMALLEST_CLOSURE = 0.02, 0.02
"""By what share the stop's points may close later than the whole slit, for loads that close it by at least so much of
what the worst one does: the others (beyond 750 N in the fabricated body) bend it elsewhere first."""
_FRACTIONS = np.linspace(0.0, 1.0, 201)
_SENSES = np.radians(np.arange(0.0, 360.0, 10.0))


class SlitStop(NamedTuple):
    """k contacts, those of the left arm first, in terms of the elastic force of the open structure."""

    closure_per_newton: FloatArray
    """(k, 3): how far the slit has closed per newton of elastic force in the arms, m/N."""
    gap_m: float
    compliance: FloatArray
    """(k, k): metres per newton of stop force, the tip held."""
    arms_per_newton: FloatArray
    """(3, k): what stop forces add to the elastic force in the arms."""
    vertical_per_newton: FloatArray
    """(3, k): and in the vertical beam."""
    fraction: FloatArray
    """(k,): place along the arm, 0 at the joint."""


def slit_stop(geometry: Geometry, modes: Modes) -> SlitStop:
    """Return the stop for the modes of the same geometry and the paper's slit."""
    g, frame = geometry, Frame(geometry, EULER_BERNOULLI)
    xi = contact_fractions(frame)
    s = frame.slit_closure(xi).reshape(-1, 3)
    bending = g.youngs_modulus_pascals * g.width_m * g.h1_m**3 / 12.0
    # Deflection at one place per unit force at another, of a beam with held ends: times E I / length^3.
    x, y = np.minimum.outer(xi, xi), np.maximum.outer(xi, xi)
    held = x**2 * (1.0 - y) ** 2 * (3.0 * y - x - 2.0 * x * y) / 6.0
    own = np.kron(np.eye(2), held * g.a_m**3 / bending) + np.eye(2 * len(xi)) / STOP_STIFFNESS
    places = np.tile(xi, 2)
    if len(modes.omega_rad_s) > 3:
        # The joint's motion is a state: a stop force acts on the tip's motion relative to it, nothing in between.
        return SlitStop(s, PAPER_SLIT_M, own, np.zeros((3, len(s))), np.zeros((3, len(s))), places)
    arms, vertical = compliances(frame)
    arm_stiffness, stiffness_of_both = np.linalg.inv(arms), np.linalg.inv(arms + vertical)
    behind = s @ (arm_stiffness - stiffness_of_both) @ s.T
    return SlitStop(
        s, PAPER_SLIT_M, own + 0.5 * (behind + behind.T),
        (stiffness_of_both - arm_stiffness) @ s.T, stiffness_of_both @ s.T, places,
    )  # fmt: skip


def contact_fractions(frame: Frame) -> FloatArray:
    """Return the places along an arm, (k,), that together close as early as the whole slit, within CLOSE_ENOUGH."""
    phi, theta = (grid.ravel() for grid in np.meshgrid(_SENSES, _SENSES[:19]))
    F = force_vector(1.0, phi, theta)
    closures = (frame.slit_closure(_FRACTIONS) @ F.T).max(axis=0)  # of the arm that closes first, (fractions, loads)
    most = closures.max(axis=0)
    near = most > SMALLEST_CLOSURE * most.max()
    closures, most = closures[:, near], most[near]
    chosen = [int(np.argmax(closures.max(axis=1)))]
    while len(chosen) < len(_FRACTIONS):
        late = 1.0 - closures[chosen].max(axis=0) / most
        if late.max() < CLOSE_ENOUGH:
            break
        chosen.append(int(np.argmax(closures[:, int(np.argmax(late))])))
    fractions: FloatArray = _FRACTIONS[np.sort(chosen)]
    return fractions
