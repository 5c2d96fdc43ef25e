"""How sure is the search of `tipforce design optimise` of its optimum, and what does that cost?

python -m bench.optimise    a few minutes

Per objective and number of gauges: the excess over the best value that any run found, median and worst over seeds,
against the starts per configuration and the run time. The reference is checked by another method: differential
evolution (scipy), which needs no derivative and no start, on the best configuration of 3 gauges with the limits as
penalties.
"""

from __future__ import annotations

import itertools
import sys
import time

import numpy as np
from bench.measure import arguments, table

from tipforce.arrays import FloatArray
from tipforce_lab.design.merit import Limits
from tipforce_lab.design.search import OBJECTIVES, Design, Objective, problem_of, score, search

STARTS = (1, 2, 4, 8, 16)
REFERENCE_STARTS, SEEDS = 32, 6
LIMITS = Limits()
_PENALTY = 1e3


def value(design: Design, objective: Objective) -> float:
    """The logarithm of what the search minimised."""
    problem = problem_of(design, LIMITS)
    return score(objective, LIMITS.loads)(problem.rows(problem.point(design)[np.newaxis])[0])[0]


def multi_start(gauges: int, objective: Objective, starts: int, seeds: int) -> tuple[FloatArray, float]:
    """(logarithms of the objective by seed, mean seconds)."""
    begin = time.perf_counter()
    designs = [search(gauges, objective, LIMITS, starts=starts, seed=1 + seed)[0] for seed in range(seeds)]
    seconds = (time.perf_counter() - begin) / seeds
    return np.array([value(design, objective) for design in designs]), seconds


def evolution(reference: Design, objective: Objective) -> tuple[float, float]:
    """(logarithm of the objective, seconds) by differential evolution on the reference's configuration."""
    from scipy.optimize import differential_evolution

    problem, part = problem_of(reference, LIMITS), score(objective, LIMITS.loads)
    free = problem.bounds[:, 1] > problem.bounds[:, 0]
    base = problem.bounds[:, 0].copy()
    bounds = problem.bounds.copy()
    bounds[3:5, 1] = 3.0  # thicknesses beyond 3 mm are far outside: the search need not look there

    def penalised(z: FloatArray) -> float:
        x = base.copy()
        x[free] = z
        excess = np.minimum(problem.constraints(x[np.newaxis])[0], 0.0)
        rows = problem.rows(x[np.newaxis])[0]
        return part(rows)[0] + _PENALTY * float(np.abs(excess).sum()) if np.isfinite(rows).all() else 1e6

    begin = time.perf_counter()
    with np.errstate(all="ignore"):
        optimum = differential_evolution(
            penalised, bounds[free], seed=1, maxiter=1500, popsize=12, tol=1e-8, polish=False
        )
    return float(optimum.fun), time.perf_counter() - begin


def main() -> int:
    """Print the study; 1 where 8 starts, the default, miss the theta optimum by 0.1 %."""
    missed, rows = 0.0, []
    arguments(__doc__).parse_args()
    for gauges, objective in itertools.product((3, 4, 5), OBJECTIVES):
        reference = search(gauges, objective, LIMITS, starts=REFERENCE_STARTS)[0]
        runs = {f"{n} starts": multi_start(gauges, objective, n, SEEDS) for n in STARTS}
        if gauges == 3:
            best, seconds = evolution(reference, objective)
            runs["evolution"] = np.array([best]), seconds
        least = min(value(reference, objective), *(float(values.min()) for values, _ in runs.values()))
        for method, (values, seconds) in runs.items():
            excess = np.expm1(values - least)  # of the objective itself, not of its logarithm
            if objective == "theta" and method == "8 starts":
                missed = max(missed, float(excess.max()))
            excesses = (f"{100 * float(part):.4f}" for part in (np.median(excess), excess.max()))
            rows.append([str(gauges), objective, method, *excesses, f"{seconds:.3f}"])
    print(table(["gauges", "objective", "method", "median %", "worst %", "s per run"], rows, markdown=False))
    return 1 if not missed <= 1e-3 else 0


if __name__ == "__main__":
    sys.exit(main())
