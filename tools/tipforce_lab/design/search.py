"""Search for better structures: multi-start over dimensions and gauge places, within limits set by the manufacturer.

Every distribution of the gauges over the faces of the beams is one configuration (mirror images count once). In
one configuration, all variables are continuous: sequential quadratic programming (scipy's SLSQP) from several random
starts, with exact derivatives (a complex step through the formulas of Table 1, made continuous).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import EnvironmentLackError, InputError
from tipforce_lab.design.figures_of_merit import LoadSet
from tipforce_lab.design.search_problem import Design, Limits, Problem, Slot, configurations

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
"""Strain matrix (n, 3) in microstrain per newton -> the minimised value, and its derivative by the matrix (n, 3)."""


def score(objective: Objective, loads: LoadSet) -> Score:
    """Return the logarithm of an objective: u_theta, sqrt(trace(C C^T)), 1 / smallest singular value, or condition.

    The condition number alone does not determine the beams' thickness, since it is unchanged when all gauges read
    less; a thousandth of the noise is added to determine it. Raises InputError for an unknown objective.
    """
    if objective not in OBJECTIVES:
        raise InputError(f"objective {objective!r} is not known: allowed are {', '.join(OBJECTIVES)}")
    if objective in ("theta", "noise"):
        W = loads.weights()[2] * loads.load_newtons**2 if objective == "theta" else np.eye(3)
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
    """Return the local optimum near x as (score, point), or None if it violates a limit.

    Raises EnvironmentLackError if scipy is missing.
    """
    try:
        from scipy.optimize import minimize
    except ImportError:
        raise EnvironmentLackError("scipy is not installed: pip install 'tipforce[science]'") from None
    scale = problem.scale
    step = 1e-30j * np.diag(scale)

    def scored(z: FloatArray) -> tuple[float, FloatArray]:
        A = problem.rows((z * scale)[np.newaxis])[0].real
        if not np.isfinite(A).all():
            return _FAILED, np.zeros_like(z)
        value, by_matrix = goal(np.asarray(A, dtype=np.float64))
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
        found = minimize(
            scored, x / scale, jac=True, method="SLSQP", bounds=problem.bounds / scale[:, np.newaxis],
            constraints=[constraint], options={"maxiter": 300, "ftol": 1e-9},
        )  # fmt: skip
        point = np.asarray(found.x, dtype=np.float64) * scale
        feasible = bool(np.all(problem.constraints(point[np.newaxis]) > -_FEASIBLE))
    value = float(found.fun)
    return (value, point) if feasible and math.isfinite(value) and value < _FAILED else None


def _trace(A: FloatArray, W: FloatArray) -> tuple[float, FloatArray]:
    """Return log sqrt(tr(W (A^T A)^-1)) and its derivative."""
    try:
        inverse = np.linalg.inv(A.T @ A)
    except np.linalg.LinAlgError:
        return _FAILED, np.zeros_like(A)
    weighted = inverse @ W @ inverse
    trace = float(np.trace(W @ inverse))
    if not 0.0 < trace < math.inf:
        return _FAILED, np.zeros_like(A)
    return 0.5 * math.log(trace), -(A @ weighted) / trace


def _extreme(A: FloatArray, sign: float) -> tuple[float, FloatArray]:
    """Return log of the largest singular value (sign +1), or of 1 / the smallest (-1), as a smooth norm of all."""
    U, values, V = np.linalg.svd(A, full_matrices=False)
    if not values[-1] > 0.0:
        return _FAILED, np.zeros_like(A)
    reference = values[0] if sign > 0.0 else values[-1]
    powers = (values / reference) ** (sign * _POWER)
    total = float(powers.sum())
    return sign * math.log(reference) + math.log(total) / _POWER, sign * (U * (powers / total / values)) @ V


def search(
    gauges: int,
    objective: Objective,
    limits: Limits,
    loads: LoadSet,
    *,
    starts: int = 4,
    seed: int = 0,
    done: Callable[[], None] = lambda: None,
) -> list[Design]:
    """Return the best design of each configuration that has one within the limits, the best first.

    starts: random starts per configuration; done is called after each. The same seed gives the same designs.
    Raises InputError for values out of range or if no start ends within the limits, EnvironmentLackError
    if scipy is missing.
    """
    if starts < 1:
        raise InputError(f"{starts} starts: allowed is 1 or more")
    goal = score(objective, loads)
    best: list[tuple[float, Design]] = []
    for number, slots in enumerate(configurations(gauges, limits.upper_face)):
        problem, rng = Problem(slots, limits), np.random.default_rng((seed, number))
        ends: list[tuple[float, FloatArray]] = []
        for _ in range(starts):
            end = improve(problem, goal, problem.start(rng))
            ends += [end] if end else []
            done()
        if ends:
            value, x = min(ends, key=lambda end: end[0])
            best.append((value, problem.design(x, objective)))
    if not best:
        raise InputError("no design found within the limits: increase envelope, stress, slit or the number of starts")
    return [design for _, design in sorted(best, key=lambda item: item[0])]


def trade_off(
    best: Design,
    others: Sequence[Design],
    least: Design,
    objective: Objective,
    loads: LoadSet,
    limits: Limits,
    done: Callable[[], None] = lambda: None,
) -> list[Design]:
    """Return designs between the best one for an objective and the one of the least condition number.

    The condition number has a ceiling (TRADE_OFF_STEPS of the way from best to least, as a penalty). Each
    optimum is the start of the next: downwards from best and from each of others, upwards from least. done is
    called after each. Raises as search() does.
    """
    goal, condition = score(objective, loads), score("condition", loads)
    highest, lowest = (condition(_matrix(design, limits))[0] for design in (best, least))
    found: list[Design] = []
    for design in (best, *others, least):
        problem = _problem(design, limits)
        x = problem.point(design)
        for step in reversed(TRADE_OFF_STEPS) if design is least else TRADE_OFF_STEPS:
            held = mixed([(1.0, goal), (1.0, _below(condition, highest + step * (lowest - highest)))])
            end = improve(problem, held, x)
            done()
            if end:
                x = end[1]
                found.append(problem.design(x, objective))
    return found


def _below(part: Score, ceiling: float) -> Score:
    """Return a penalty for a score above its ceiling; much smoother for the search than a constraint."""

    def penalty(A: FloatArray) -> tuple[float, FloatArray]:
        value, slope = part(A)
        excess = max(value - ceiling, 0.0)
        return _PENALTY * excess * excess, 2.0 * _PENALTY * excess * slope

    return penalty


def _problem(design: Design, limits: Limits) -> Problem:
    return Problem([Slot(gauge.beam, gauge.side, gauge.face) for gauge in design.gauges], limits)


def _matrix(design: Design, limits: Limits) -> FloatArray:
    problem = _problem(design, limits)
    return np.asarray(problem.rows(problem.point(design)[np.newaxis])[0], dtype=np.float64)
