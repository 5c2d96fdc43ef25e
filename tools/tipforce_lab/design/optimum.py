"""The best design by an objective, the minimum condition number, and the path between them, assessed by two models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from tipforce.errors import InputError
from tipforce.sensor.calibration.statistics import FALSE_ALARM_RATE
from tipforce.sensor.contact.redundancy import detectable_strain, parity, weighted_inverse
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import CASES, LAYOUTS
from tipforce.sensor.structure.strain import gauge_matrix, gauge_name
from tipforce_lab.design.merit import FIGURES, Assessment, Limits, Merit, assess, glued, pareto
from tipforce_lab.design.search import TRADE_OFF_STEPS, Objective, configurations, search, trade_off

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
    """Optimise the objective and the condition number, follow the path between them, and assess all designs."""
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
    try:
        real = glued(FABRICATED, LAYOUTS["I"], limits.gauge_length_m)
        paper.append(judge("I glued", FABRICATED, real))
    except InputError:  # gauges of this length do not fit on the paper's body
        pass
    return Outcome(paper, front, condition_only if objective == "condition" else first, condition_only)


def detectable_microstrain(entry: Assessment, noise_microstrain: float) -> list[float]:
    """The smallest fault of each gauge that a sample shows, microstrain, with C known; none for three gauges."""
    if len(entry.gauges) < 4 or not noise_microstrain > 0.0:
        return []
    A, Sigma = gauge_matrix(entry.geometry, entry.gauges), np.eye(len(entry.gauges)) * noise_microstrain**2 * 1e-12
    strain = detectable_strain(parity(weighted_inverse(A, Sigma), Sigma), FALSE_ALARM_RATE)
    return [1e6 * smallest for smallest in strain.tolist()]


def record(entry: Assessment, noise_microstrain: float) -> dict[str, object]:
    """Return the JSON record of a structure: dimensions, gauges, figures of merit by each model, limits."""
    figures: dict[str, object] = {"name": entry.name, **asdict(entry.geometry)}
    figures["gauges"] = [gauge_name(gauge) for gauge in entry.gauges]
    for prefix, merit in (("", entry.theory), ("frame_", entry.frame), ("finite_joint_", entry.frame_finite_joint)):
        figures |= {f"{prefix}{field.name}": getattr(merit, field.name) for field in fields(Merit)}
    for name in ("worst_stress_pascals", "worst_strain", "slit_load_newtons", "disagreement", "agrees"):
        figures[name] = getattr(entry, name)
    return figures | {"detectable_microstrain": detectable_microstrain(entry, noise_microstrain)}
