"""Plane finite elements of the fingertip: convergence, corner exponents, Table 3's simulation column.

python -m bench.fem                    everything, as the Markdown tables of docs/finite-elements.md (minutes)
python -m bench.fem --quick            small meshes
python -m bench.fem -o docs/figures    writes fem-outline.png and fem-work-precision.png too

Nothing here is random. Times are of this machine, the least of three.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.fem import figures, studies, table_3
from bench.fem.table_3 import Variant

from tipforce.sensor.structure.layouts import CASES
from tipforce_lab.fem.gauges import extrapolate_matrix
from tipforce_lab.fem.mesh import GRADING, Resolution
from tipforce_lab.fem.plane_stress import Model, solve


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def variant_rows(found: Sequence[Variant]) -> list[list[str]]:
    """What, and three condition numbers."""
    return [[one.what, *(f"{value:.3f}" for value in one.conditions)] for one in found]


def convergence_part(quick: bool, folder: Path | None) -> None:
    """The tables of convergence and the figure of error against run time."""
    cells = (1, 2, 4) if quick else (2, 3, 4, 6, 8, 12)
    fewer = (1, 2, 4) if quick else (2, 3, 4, 6, 8)
    # Round by round, so that all gradings meet the same machine.
    rounds = [
        [studies.convergence(g, cells if g == GRADING else fewer) for g in studies.GRADINGS]
        for _ in range(1 if quick else 3)
    ]
    runs = [studies.least_times(same) for same in zip(*rounds, strict=True)]
    best = next(run for run in runs if run.grading == GRADING)
    limits = best.limits()
    matrix, matrix_error = extrapolate_matrix([level.matrix for level in best.doubling()])
    values = [limit.value for limit in limits]
    print("## Convergence\n")
    print(f"Limit (graded {GRADING:g}, n = {', '.join(str(level.cells) for level in best.doubling()[-3:])}):")
    for case, limit in zip(CASES, limits, strict=True):
        print(f"  case {case}: {limit.value:.4f} +- {limit.error:.4f} ({limit.error / limit.value:.1e}), ", end="")
        print(f"observed order {limit.order:.2f}")
    print(f"  strain matrix: relative error {matrix_error:.1e}\n")
    rows = []
    for run in runs:
        for level in run.levels:
            errors = (figures.worst_error(level.conditions, values), figures.distance(level.matrix, matrix))
            rows.append(
                [
                    f"{run.grading:g}",
                    str(level.cells),
                    str(level.unknowns),
                    *(f"{value:.4f}" for value in level.conditions),
                    *(f"{error:.1e}" for error in errors),
                    f"{1e6 * level.point_strain:.0f}",
                    f"{level.seconds:.2f}",
                ]
            )
    header = ["grading", "n", "unknowns", "I", "II", "III", "error, condition", "error, strains"]
    print(table([*header, "point strain at S, microstrain/N", "s"], rows), "\n")
    for run in runs:
        theory = 0.5445 * run.grading
        orders = ", ".join(f"{order:.2f}" for order in run.orders(matrix))
        print(f"grading {run.grading:g}: order of the strains, per halving {orders}; theory {min(theory, 3.0):.2f}")
    if folder is not None:
        known = (max(limit.error / limit.value for limit in limits), matrix_error)
        figures.work_precision_figure(runs, values, matrix, known).savefig(folder / "fem-work-precision.png", dpi=110)


def corner_part(quick: bool) -> None:
    """Observed exponents on two meshes beside Williams' roots."""
    cells = (2, 4) if quick else (4, 8)
    found = [studies.corner_exponents(n) for n in cells]
    rows = [
        [one[0].mode, *(f"{exponent.observed:.4f}" for exponent in one), f"{one[0].theory:.4f}"]
        for one in zip(*found, strict=True)
    ]
    print("\n## Corner exponent, 270 degrees, free faces\n")
    print(table(["mode", *(f"observed, n = {n}" for n in cells), "Williams"], rows))


def table_3_part(quick: bool) -> None:
    """What moves the condition numbers, what gives ANSYS's, and what cannot give the measured ones."""
    cells, coarse = (1, 1) if quick else (4, 3)
    # Away from the corners gauges end between nodes, where displacement is less exact: a finer mesh for them.
    base = solve(Model(resolution=Resolution(2 * cells)))
    header = ["", "I", "II", "III"]
    print("\n## Outline\n\n" + table(header, variant_rows(table_3.outline_variants(cells))))
    print("\n## Places of the gauges\n")
    variants = [*table_3.position_variants(base), *table_3.inner_variants(base), *table_3.gauge_length_variants(base)]
    print(table(header, variant_rows(variants)))
    print("\n## What gives ANSYS's 2.53, 3.36, 3.94\n")
    rows = [
        [one.what, f"{one.case} = {one.wanted}", f"{one.found:.2f} {one.unit}", *(f"{c:.2f}" for c in one.conditions)]
        for one in table_3.matches(base, coarse)
    ]
    print(table(["by", "to reach", "needs", "I", "II", "III"], rows))
    if not quick:
        body = table_3.one_body(3)
        shown = ", ".join(f"{value:.2f}" for value in body.conditions)
        print(f"\nI and III at once: legs {body.leg_mm:.2f} mm, fillets {body.fillet_mm:.2f} mm give {shown}")
    print("\n## The measured 3.50, 3.50, 3.34\n")
    miss = table_3.best_for_measured(base, 7 if quick else 25)
    places = ", ".join(f"{point} {place:.2f}" for point, place in zip(studies.GAUGES, miss.places_mm, strict=True))
    shown = ", ".join(f"{value:.3f}" for value in miss.conditions)
    print(f"Best of all places up to 6 mm inward: {shown}, off by {miss.worst:.3f} (mm from the joint: {places})")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m bench.fem", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small meshes: seconds")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="write the figures here")
    options = parser.parse_args(arguments)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        figures.outline_figure().savefig(options.output / "fem-outline.png", dpi=110)
    convergence_part(options.quick, options.output)
    corner_part(options.quick)
    table_3_part(options.quick)
    return 0


if __name__ == "__main__":
    sys.exit(main())
