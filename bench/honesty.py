"""Does "ok" mean ok? Simulated fingers with one fault each; rows that say ok and are wrong, against the bounds.

python -m bench.honesty                    1000 calibrations a cell (two hours on two processors)
python -m bench.honesty --calibrations 20  fewer
python -m bench.honesty --markdown         the tables of docs/uncertainty.md

A row is wrong where its P is off by more than five of its own standard uncertainties. Exit code 1 where the data can
tell and more than 1 in 10,000 of the rows that say ok are wrong, or where good fingers are not as good as they must be.
"""

from __future__ import annotations

import argparse
import os
from itertools import product

from bench.honesty_study import AFTER, CANNOT_TELL, GROOVE_ERROR_RAD, IN_CALIBRATION, Cell, Rig, cells
from bench.printed import table

FULL = 1000
ALLOWED_WRONG_PER_10000 = 1.0
LEAST_OK, LARGEST_U_RATIO = 0.99, 1.2
CLEAN_COVERAGE, LEAST_COVERAGE = (0.93, 0.97), 0.93
GRID = tuple(product((5, 8, 12, 19), (1, 2, 3), (1, 2, 3)))
"""Grooves, weights, repeats."""
GAUGE_FAULTS = ("drift", "stuck", "gain")
HEADER = ["gauges", "rig", "fault", "refused", "says ok, %", "wrong in 10,000", "95 % holds, %", "u / error", "verdict"]


def verdict(cell: Cell) -> str:
    """What the bounds say of a cell: good, why the data cannot tell, or what is out."""
    if not cell.ok:
        return "good: refused" if cell.refused else "good: never ok"
    out = []
    if cell.wrong_per_10000 > ALLOWED_WRONG_PER_10000:
        out.append("wrong rows")
    low, high = CLEAN_COVERAGE if cell.fault == "clean" else (LEAST_COVERAGE, 1.0)
    if not low <= cell.covered_share <= high:
        out.append("coverage")
    if cell.fault == "clean" and not cell.rig.groove_error_rad:
        out += ["ok share"] * (cell.ok_share < LEAST_OK) + ["u(P)"] * (cell.u_over_error > LARGEST_U_RATIO)
    if not out:
        return "good"
    if cell.fault in GAUGE_FAULTS and cell.gauges in CANNOT_TELL:
        return "cannot tell: " + CANNOT_TELL[cell.gauges]
    return "out: " + ", ".join(out)


def row_of(cell: Cell) -> list[str]:
    """One line of the table."""
    rig = f"{cell.rig.grooves} x {cell.rig.weights} x {cell.rig.repeats}"
    rig += " off by 0.5" if cell.rig.groove_error_rad else ""
    return [
        str(cell.gauges), rig, cell.fault, f"{sum(cell.refused.values())} of {cell.calibrations}",
        f"{100.0 * cell.ok_share:.1f}", f"{cell.wrong_per_10000:.1f}", f"{100.0 * cell.covered_share:.1f}",
        f"{cell.u_over_error:.2f}", verdict(cell),
    ]  # fmt: skip


def study(calibrations: int, jobs: int, grid: bool = True) -> list[Cell]:
    """Every fault on one rig for 3 to 8 gauges; the grid of rigs, grooves off by 0.5 degree, for 3 and 5."""
    found = []
    for gauges in range(3, 9):
        found += cells(gauges, Rig(), AFTER + IN_CALIBRATION, calibrations, jobs)
    for gauges in (3, 5) if grid else ():
        for grooves, weights, repeats in GRID:
            rig = Rig(grooves, weights, repeats, GROOVE_ERROR_RAD)
            found += cells(gauges, rig, ("clean",), calibrations, jobs)
    return found


def main() -> int:
    """Run the study; 1 where a cell is out of its bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calibrations", type=int, default=FULL, metavar="N")
    parser.add_argument("--no-grid", action="store_true", help="one rig only")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--markdown", action="store_true")
    args = parser.parse_args()
    found = study(args.calibrations, args.jobs, not args.no_grid)
    print(table(HEADER, [row_of(cell) for cell in found], args.markdown))
    reasons = {reason: count for cell in found for reason, count in cell.refused.items()}
    for reason in sorted(reasons):
        print(f"refused: {reason}...")
    out = [cell for cell in found if verdict(cell).startswith("out")]
    print(f"\n{len(found)} cells of {args.calibrations} calibrations, {len(out)} out of their bounds")
    return 1 if out else 0


if __name__ == "__main__":
    raise SystemExit(main())
