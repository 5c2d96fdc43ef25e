"""Search for better structures. Each distribution of the gauges over the faces of the beams is one configuration of
continuous variables: scipy's SLSQP from random starts, with exact derivatives by a complex step."""

import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError, needing
from tipforce.sensor.structure.layouts import CASES, LAYOUTS
from tipforce.sensor.structure.plane_frame import AnyArray, slit_compliance
from tipforce.sensor.structure.strain import FABRICATED, GaugePosition, Geometry
from tipforce_lab.design.merit import FIGURES, Assessment, Limits, assess, glued, load_weights, pareto

UNIT_M = 1e-3  # the search uses millimetres and microstrain
_DIMENSIONS = 6  # a, d, r, h1, h2, width; then the positions of the gauges
_SCALE = np.array([15.0, 15.0, 15.0, 0.4, 0.65, 10.0])
_PLACE_SCALE = 15.0
_MODULUS = FABRICATED.youngs_modulus_pascals * 1e-6  # N/mm^2
SLENDERNESS = 10.0
"""Least length over thickness of each beam (of an arm between joint and tip): the validity of beam theory."""


class Design(NamedTuple):
    """A structure with its gauges."""

    geometry: Geometry
    gauges: tuple[GaugePosition, ...]


_SLOTS = (
    GaugePosition("H", "left", 0.0), GaugePosition("H", "right", 0.0),
    GaugePosition("V", "left", 0.0), GaugePosition("V", "right", 0.0),
)  # fmt: skip
"""The faces that have gauges: not the upper one of the horizontal beam, inside the slit."""


def point_of(design: Design) -> FloatArray:
    """Return the variables (6 + n,) of a design, millimetres."""
    *lengths, _ = astuple(design.geometry)
    return np.array([*lengths, *(gauge.position_m for gauge in design.gauges)]) / UNIT_M


def configurations(gauges: int) -> list[tuple[GaugePosition, ...]]:
    """Return the distributions of 3 to 5 gauges over the faces, on both beams, mirrors once. Raises InputError."""
    if not 3 <= gauges <= 5:
        raise InputError(f"{gauges} gauges: allowed are 3 to 5")
    sets_of_slots: dict[tuple[GaugePosition, ...], None] = {}
    for chosen in itertools.combinations_with_replacement(_SLOTS, gauges):
        twin = tuple(sorted(slot._replace(side="left" if slot.side == "right" else "right") for slot in chosen))
        if len({slot.beam for slot in chosen}) == 2 and twin not in sets_of_slots:
            sets_of_slots[tuple(sorted(chosen))] = None
    return list(sets_of_slots)


class Problem:
    """One configuration: variables -> strain matrix and constraints, for many points at once, real or complex."""

    def __init__(self, slots: Sequence[GaugePosition], limits: Limits) -> None:
        self.slots, self.limits = tuple(slots), limits
        self.horizontal = np.array([slot.beam == "H" for slot in slots])
        self.side = np.array([-1.0 if slot.side == "left" else 1.0 for slot in slots])
        self.scale = np.concatenate([_SCALE, np.full(len(slots), _PLACE_SCALE)])
        self._stress = limits.stress_pascals * 1e-6  # N/mm^2
        self._gap_slopes, self._gap_least = self._gaps()
        reach, height = 0.5 * limits.envelope_x_m / UNIT_M, limits.envelope_y_m / UNIT_M
        thin, b, longest = limits.min_thickness_m / UNIT_M, limits.width_m / UNIT_M, max(reach, height)
        dimensions = [
            (1e-3 * reach, reach), (1e-3 * height, height), (1e-3 * reach, reach),
            (thin, max(thin, longest)), (thin, max(thin, longest)), (b, b),
        ]  # fmt: skip
        self.bounds = np.array(dimensions + [(0.0, longest)] * len(self.slots))

    def rows(self, x: AnyArray) -> AnyArray:
        """Strain matrices (m, n, 3) in microstrain per newton of points (m, 6 + n), lengths in millimetres."""
        a, _, r, h1, h2, b = (x[:, k : k + 1] for k in range(_DIMENSIONS))
        s = x[:, _DIMENSIONS:]
        H, side = self.horizontal, self.side
        per_h1, per_h2, place = 1.0 / h1**2, 1.0 / h2**2, s / a
        stress = np.empty((*s.shape, 3), dtype=x.dtype)
        stress[..., 0] = np.where(H, 1.5 * a * per_h1 * (1.0 - 2.0 * place), 1.0 / h2)
        stress[..., 1] = side * np.where(H, 3.0 * r * per_h1 * (1.0 - 1.5 * place), 6.0 * r * per_h2)
        stress[..., 2] = side * np.where(H, 0.5 / h1, -6.0 * (s + 0.5 * h1) * per_h2)
        stress *= (1e6 / (b * _MODULUS))[..., np.newaxis]
        return stress

    def constraints(self, x: AnyArray) -> AnyArray:
        """Return the constraints, not negative, (m, k): stress, slit, envelope, wall, slenderness, gauge spacing."""
        limits = self.limits
        a, d, r, h1, h2, b = x[:, :_DIMENSIONS].T
        load = limits.load_newtons
        horizontal = np.sqrt((1.5 * a / h1**2) ** 2 + (0.5 / h1) ** 2) + 3.0 * r / h1**2
        vertical = np.sqrt((6.0 * (d + 0.5 * h1) / h2**2) ** 2 + 1.0 / h2**2) + 6.0 * r / h2**2
        closure = slit_compliance(a, r, h1) * load / (b * _MODULUS)
        columns = [np.log(self._stress * b / (load * stress)) for stress in (horizontal, vertical)]
        columns.append(np.log(limits.slit_m / UNIT_M / closure))
        rooms = (limits.envelope_y_m / UNIT_M - r - d - 0.5 * h1, r - a,
                 a - 0.5 * h2 - SLENDERNESS * h1, d - SLENDERNESS * h2)  # fmt: skip
        columns += [room / _PLACE_SCALE for room in rooms]
        gaps: AnyArray = (x @ self._gap_slopes - self._gap_least) / _PLACE_SCALE
        return np.concatenate((np.stack(columns, axis=-1), gaps), axis=-1)

    def design(self, x: FloatArray) -> Design:
        """Return the point (6 + n,) as a design."""
        a, d, r, h1, h2, b = (float(value) for value in x[:_DIMENSIONS] * UNIT_M)
        geometry = Geometry(a, d, r, h1, h2, b, FABRICATED.youngs_modulus_pascals)
        places = zip(self.slots, x[_DIMENSIONS:], strict=True)
        gauges = (slot._replace(position_m=float(s) * UNIT_M) for slot, s in places)
        return Design(geometry, tuple(gauges))

    def start(self, rng: np.random.Generator) -> FloatArray:
        """Return a random point, near or inside the limits."""
        limits = self.limits
        height, least, b = (size / UNIT_M for size in (limits.envelope_y_m, limits.min_thickness_m, limits.width_m))
        r = rng.uniform(0.5, 1.0) * min(0.5 * limits.envelope_x_m / UNIT_M, 0.8 * height)
        a = rng.uniform(0.4, 1.0) * r
        d = rng.uniform(0.5, 1.0) * (height - r)
        strength = self._stress * b / limits.load_newtons
        h1 = max(least, math.sqrt((1.5 * a + 3.0 * r) / strength)) * rng.uniform(1.0, 1.3)
        h2 = max(least, math.sqrt(6.0 * (d + r) / strength)) * rng.uniform(1.0, 1.3)
        lengths = np.where(self.horizontal, a, d)
        places = rng.uniform(0.1, 0.9, len(self.slots)) * lengths
        for slot in set(self.slots):
            same = [k for k, other in enumerate(self.slots) if other == slot]
            places[same] = np.sort(places[same])
        x: FloatArray = np.clip(np.concatenate([[a, d, r, h1, h2, b], places]), self.bounds[:, 0], self.bounds[:, 1])
        return x

    def _gaps(self) -> tuple[FloatArray, FloatArray]:
        """Return the spacing on each face, x @ slopes (6 + n, k) - least (k,): corner, gauges in order, corner."""
        length = self.limits.gauge_length_m / UNIT_M
        unit = np.eye(_DIMENSIONS + len(self.slots))
        a, d, _, _, h2, _ = unit[:_DIMENSIONS]
        slopes, least = list[FloatArray](), list[float]()
        for slot in dict.fromkeys(self.slots):
            places = [unit[_DIMENSIONS + k] for k, other in enumerate(self.slots) if other == slot]
            # The vertical beam covers h2 / 2 on either side of the middle, and above it there is no bending.
            inner, end = (0.5 * h2, a) if slot.beam == "H" else (0.0 * h2, d)
            slopes += [after - before for before, after in itertools.pairwise((inner, *places, end))]
            least += [0.5 * length, *[length] * (len(places) - 1), 0.5 * length]
        return np.stack(slopes, axis=-1), np.array(least)


Objective = Literal["theta", "noise", "singular", "condition"]
OBJECTIVES: tuple[Objective, ...] = ("theta", "noise", "singular", "condition")

TRADE_OFF_STEPS = tuple((np.arange(1, 10) / 10).tolist())
"""Fractions of the way from the objective's optimum to the least condition number, on a logarithmic scale."""

_POWER = 32  # of the norm that replaces the largest or smallest singular value: within 3.5 %, and smooth
_PENALTY = 30.0  # on the square of log(condition number / ceiling): a ceiling is met within a few percent
_TIE_BREAK = 1e-3  # weight of the noise, because the condition number alone does not determine the thickness
_FEASIBLE = 1e-7
_FAILED = 1e3

Score = Callable[[FloatArray], tuple[float, FloatArray]]
"""Strain matrix (n, 3) in microstrain per newton -> the minimised value, and its derivative by the matrix (n, 3).
Raises LinAlgError for a matrix that is not finite or not of rank 3."""


def score(objective: Objective, load_newtons: float) -> Score:
    """Return the logarithm of an objective, of condition with 0.001 of the noise. Raises InputError for another."""
    if objective not in OBJECTIVES:
        raise InputError(f"objective {objective!r} is not known: allowed are {', '.join(OBJECTIVES)}")
    if objective in ("theta", "noise"):
        W = load_weights(load_newtons)[2] * load_newtons**2 if objective == "theta" else np.eye(3)
        return lambda A: _trace(A, W)
    if objective == "singular":
        return lambda A: _extreme(A, -1.0)
    return mixed([(1.0, lambda A: _extreme(A, 1.0)), (1.0, lambda A: _extreme(A, -1.0)),
                  (_TIE_BREAK, lambda A: _trace(A, np.eye(3)))])  # fmt: skip


def mixed(parts: Sequence[tuple[float, Score]]) -> Score:
    """Return the weighted sum of scores."""

    def total(A: FloatArray) -> tuple[float, FloatArray]:
        values = [(weight, *part(A)) for weight, part in parts]
        return sum(w * v for w, v, _ in values), np.sum([w * g for w, _, g in values], axis=0)

    return total


def improve(problem: Problem, goal: Score, x: FloatArray) -> tuple[float, FloatArray] | None:
    """Return the local optimum near x as (score, point), or None. Raises EnvironmentLackError without scipy."""
    with needing("scipy is not installed: pip install 'tipforce[science]'"):
        from scipy.optimize import minimize
    scale = problem.scale
    step = 1e-30j * np.diag(scale)

    def scored(z: FloatArray) -> tuple[float, FloatArray]:
        try:
            value, by_matrix = goal(np.asarray(problem.rows((z * scale)[np.newaxis])[0].real, dtype=np.float64))
        except np.linalg.LinAlgError:
            return _FAILED, np.zeros_like(z)
        slopes = problem.rows(z * scale + step).imag / 1e-30
        return value, np.tensordot(slopes, by_matrix, axes=([1, 2], [0, 1]))

    constraint = {
        "type": "ineq",
        "fun": lambda z: problem.constraints((z * scale)[np.newaxis])[0],
        "jac": lambda z: problem.constraints(z * scale + step).imag.T / 1e-30,
    }
    with np.errstate(all="ignore"), warnings.catch_warnings():
        # SLSQP of scipy 1.11 leaves the bounds by rounding, and clips.
        warnings.filterwarnings("ignore", "Values in x were outside bounds", RuntimeWarning)
        minimum = minimize(
            scored, x / scale, jac=True, method="SLSQP", bounds=problem.bounds / scale[:, np.newaxis],
            constraints=[constraint], options={"maxiter": 300, "ftol": 1e-9},
        )  # fmt: skip
        point = np.asarray(minimum.x, dtype=np.float64) * scale
        feasible = bool(np.all(problem.constraints(point[np.newaxis]) > -_FEASIBLE))
    value = float(minimum.fun)
    return (value, point) if feasible and math.isfinite(value) and value < _FAILED else None


def _trace(A: FloatArray, W: FloatArray) -> tuple[float, FloatArray]:
    inverse = np.linalg.inv(A.T @ A)
    trace = float(np.trace(W @ inverse))
    if not 0.0 < trace < math.inf:
        raise np.linalg.LinAlgError("the matrix has no finite inverse")
    return 0.5 * math.log(trace), -(A @ (inverse @ W @ inverse)) / trace


def _extreme(A: FloatArray, sign: float) -> tuple[float, FloatArray]:
    """Return log of the largest singular value (sign +1), or of 1 / the smallest (-1), as a smooth norm of all."""
    U, values, V = np.linalg.svd(A, full_matrices=False)
    if not values[-1] > 0.0:
        raise np.linalg.LinAlgError("the matrix has no rank 3")
    reference = values[0] if sign > 0.0 else values[-1]
    powers = (values / reference) ** (sign * _POWER)
    total = float(powers.sum())
    return sign * math.log(reference) + math.log(total) / _POWER, sign * (U * (powers / total / values)) @ V


def search(
    gauges: int,
    objective: Objective,
    limits: Limits,
    *,
    starts: int = 4,
    seed: int = 0,
    done: Callable[[], None] = lambda: None,
) -> list[Design]:
    """Return the best design of each configuration, the best first; done is called after each start. Raises InputError
    for values out of range or if no start ends within the limits, EnvironmentLackError without scipy."""
    if starts < 1:
        raise InputError(f"{starts} starts: allowed is 1 or more")
    goal = score(objective, limits.load_newtons)
    best: list[tuple[float, Design]] = []
    for number, slots in enumerate(configurations(gauges)):
        problem, rng = Problem(slots, limits), np.random.default_rng((seed, number))
        ends: list[tuple[float, FloatArray]] = []
        for _ in range(starts):
            end = improve(problem, goal, problem.start(rng))
            ends += [end] if end else []
            done()
        if ends:
            value, x = min(ends, key=lambda end: end[0])
            best.append((value, problem.design(x)))
    if not best:
        raise InputError("no design found within the limits: increase envelope, stress, slit or the number of starts")
    return [design for _, design in sorted(best, key=lambda item: item[0])]


def trade_off(
    best: Design,
    others: Sequence[Design],
    least: Design,
    objective: Objective,
    limits: Limits,
    done: Callable[[], None] = lambda: None,
) -> list[Design]:
    """Return designs between the best one for an objective and the one of the least condition number, by a ceiling at
    TRADE_OFF_STEPS: from best and others downwards, from least upwards, in sequence. Raises as search()."""
    goal, condition = score(objective, limits.load_newtons), score("condition", limits.load_newtons)
    begins = [
        (Problem([gauge._replace(position_m=0.0) for gauge in design.gauges], limits), point_of(design))
        for design in (best, *others, least)
    ]
    highest, lowest = (
        condition(np.asarray(problem.rows(x[np.newaxis])[0], dtype=np.float64))[0]
        for problem, x in (begins[0], begins[-1])
    )
    designs: list[Design] = []
    for number, (problem, begin) in enumerate(begins):
        x = begin
        for step in reversed(TRADE_OFF_STEPS) if number == len(begins) - 1 else TRADE_OFF_STEPS:
            held = mixed([(1.0, goal), (1.0, _below(condition, highest + step * (lowest - highest)))])
            end = improve(problem, held, x)
            done()
            if end:
                x = end[1]
                designs.append(problem.design(x))
    return designs


def _below(part: Score, ceiling: float) -> Score:
    """Return a penalty for a score above its ceiling; much smoother for the search than a constraint."""

    def penalty(A: FloatArray) -> tuple[float, FloatArray]:
        value, slope = part(A)
        excess = max(value - ceiling, 0.0)
        return _PENALTY * excess * excess, 2.0 * _PENALTY * excess * slope

    return penalty


_FROM = 4  # configurations from which the path to the minimum condition number starts


class Outcome(NamedTuple):
    """Result of one run."""

    paper: list[Assessment]
    """Cases I to III of the paper, then case I with gauges of the stated length."""
    front: list[Assessment]
    """Pareto-optimal designs in objective and condition number, and always condition_only."""
    best: Assessment
    """The best design by the objective."""
    condition_only: Assessment
    """The design with the minimum condition number, and among such designs the minimum noise."""


def steps(gauges: int, starts: int) -> int:
    """Return how often ``optimise`` calls ``done``."""
    searches = len(configurations(gauges)) * max(starts, 0)
    return 2 * searches + (_FROM + 1) * len(TRADE_OFF_STEPS)


def optimise(
    objective: Objective,
    gauges: int,
    limits: Limits,
    noise_microstrain: float,
    *,
    starts: int,
    seed: int,
    done: Callable[[], None] = lambda: None,
) -> Outcome:
    """Return the optima of the objective and of the condition number, and those on the path between them, assessed."""
    axis: Objective = "theta" if objective == "condition" else objective
    best = search(gauges, axis, limits, starts=starts, seed=seed, done=done)
    least = search(gauges, "condition", limits, starts=starts, seed=seed, done=done)[0]
    between = trade_off(best[0], best[1:_FROM], least, axis, limits, done)
    judge = partial(assess, limits=limits, noise_microstrain=noise_microstrain)
    first, condition_only = judge("best", *best[0]), judge("condition", *least)
    others = [judge("", *design) for design in (*best[1:], *between)]
    front = pareto([first, *others, condition_only], (FIGURES[axis], FIGURES["condition"]))
    front = [entry if entry.name else replace(entry, name=f"{k}") for k, entry in enumerate(front, 1)]
    if condition_only not in front:
        front.append(condition_only)
    paper = [judge(case, FABRICATED, LAYOUTS[case]) for case in CASES]
    with suppress(InputError):  # gauges of this length do not fit on the paper's body
        paper.append(judge("I glued", FABRICATED, glued(FABRICATED, LAYOUTS["I"], limits.gauge_length_m)))
    return Outcome(paper, front, condition_only if objective == "condition" else first, condition_only)
