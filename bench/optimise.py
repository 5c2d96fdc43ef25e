"""How sure is the search of `tipforce design optimise` of its optimum, and what does that cost?

python -m bench.optimise                the full study as text (a few minutes)
python -m bench.optimise --json         JSON lines
python -m bench.optimise --quick        fewer seeds, no differential evolution

Per objective and number of gauges: the excess over the best value that any run found, median and worst over seeds,
against the starts per configuration and the run time. The reference is checked by another method: differential
evolution (scipy), which needs no derivative and no start, on the best configuration of 3 gauges with the limits as
penalties.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce_lab.design.merit import LoadSet
from tipforce_lab.design.search import OBJECTIVES, Design, Limits, Objective, Problem, Slot, score, search

FloatArray = npt.NDArray[np.float64]

STARTS = (1, 2, 4, 8, 16)
REFERENCE_STARTS = 32
LIMITS, LOADS = Limits(), LoadSet()
_PENALTY = 1e3


class Cell(NamedTuple):
    """One method for one objective and number of gauges."""

    gauges: int
    objective: str
    method: str
    median_excess: float
    """Relative to the reference, of the objective itself (not its logarithm)."""
    worst_excess: float
    seconds: float
    """Mean of one run."""


def value(design: Design, objective: Objective) -> float:
    """The logarithm of what the search minimised."""
    problem = _problem(design)
    return score(objective, LOADS)(problem.rows(problem.point(design)[np.newaxis])[0])[0]


def _problem(design: Design) -> Problem:
    return Problem([Slot(gauge.beam, gauge.side, gauge.face) for gauge in design.gauges], LIMITS)


def multi_start(gauges: int, objective: Objective, starts: int, seeds: int) -> tuple[FloatArray, float]:
    """(logarithms of the objective by seed, mean seconds)."""
    begin = time.perf_counter()
    found = [search(gauges, objective, LIMITS, LOADS, starts=starts, seed=1 + seed)[0] for seed in range(seeds)]
    seconds = (time.perf_counter() - begin) / seeds
    return np.array([value(design, objective) for design in found]), seconds


def evolution(reference: Design, objective: Objective) -> tuple[float, float]:
    """(logarithm of the objective, seconds) by differential evolution on the reference's configuration."""
    from scipy.optimize import differential_evolution

    problem, part = _problem(reference), score(objective, LOADS)
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
        found = differential_evolution(
            penalised, bounds[free], seed=1, maxiter=1500, popsize=12, tol=1e-8, polish=False
        )
    return float(found.fun), time.perf_counter() - begin


def study(quick: bool) -> Iterator[Cell]:
    """All cells, as they come."""
    for gauges in (3,) if quick else (3, 4, 5):
        for objective in OBJECTIVES:
            reference = search(gauges, objective, LIMITS, LOADS, starts=8 if quick else REFERENCE_STARTS)[0]
            runs = {f"{n} starts": multi_start(gauges, objective, n, 3 if quick else 6) for n in STARTS}
            if gauges == 3 and not quick:
                best, seconds = evolution(reference, objective)
                runs["evolution"] = np.array([best]), seconds
            least = min(value(reference, objective), *(float(values.min()) for values, _ in runs.values()))
            for method, (values, seconds) in runs.items():
                excess = np.expm1(values - least)
                yield Cell(gauges, objective, method, float(np.median(excess)), float(excess.max()), seconds)


def main() -> int:
    """Print the study; 1 where 8 starts, the default, miss the theta optimum by 0.1 %."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    if not args.json:
        print(f"{'gauges':>6}  {'objective':9}  {'method':10}  {'median %':>9}  {'worst %':>9}  {'s per run':>9}")
    missed = 0.0
    for cell in study(args.quick):
        if cell.objective == "theta" and cell.method == "8 starts":
            missed = max(missed, cell.worst_excess)
        if args.json:
            print(json.dumps(cell._asdict()), flush=True)
            continue
        print(
            f"{cell.gauges:6}  {cell.objective:9}  {cell.method:10}  {100 * cell.median_excess:9.4f}  "
            f"{100 * cell.worst_excess:9.4f}  {cell.seconds:9.3f}",
            flush=True,
        )
    return 1 if not missed <= 1e-3 else 0


if __name__ == "__main__":
    sys.exit(main())
