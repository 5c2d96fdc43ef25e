"""Does "ok" mean ok? Simulated fingers with one fault each; rows that say ok and are wrong, against the bounds.

python -m bench.honesty                    1000 calibrations a cell (two hours on two processors)
python -m bench.honesty --calibrations 20  fewer
python -m bench.honesty --part grid        one of its tables
python -m bench.honesty --markdown         the tables of docs/uncertainty.md

A row is wrong where its P is off by more than five of its own standard uncertainties. Exit code 1 where the data can
tell and more than 1 in 10,000 of the rows that say ok are wrong, or where good fingers are not as good as they must be.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product

import numpy as np
from bench.honesty_study import (
    AFTER,
    GAUGES,
    GROOVE_ERROR_RAD,
    IN_CALIBRATION,
    INVISIBLE,
    OF_ONE_GAUGE,
    Cell,
    Rig,
    cells,
    drifting,
    false_alarms,
)  # fmt: skip
from bench.printed import table

from tipforce.sensor.contact.scalar_parity import LEAST_SHARE

FULL = 1000
ALLOWED_WRONG_PER_10000 = 1.0
ALLOWED_ALARMS_PER_100000 = 1.0
ALARM_ROWS = 10_000
"""Of each calibration."""
LEAST_OK, LARGEST_U_RATIO = 0.99, 1.2
CLEAN_COVERAGE, LEAST_COVERAGE = (0.93, 0.97), 0.93
GRID = tuple(product((5, 8, 12, 19), (1, 2, 3), (1, 2, 3)))
"""Grooves, weights, repeats."""
PARTS = ("faults", "grid", "alarms", "drift")
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
    reason = cannot_tell(cell, out)
    return f"cannot tell: {reason}" if reason else "out: " + ", ".join(out)


def cannot_tell(cell: Cell, out: list[str]) -> str | None:
    """Why the residuals cannot tell such a fault, from the matrix and the noise; None where they can."""
    if cell.fault.endswith(INVISIBLE):
        shares = ", ".join(f"{name} {100.0 * share:.2g} %" for name, share in sorted(cell.shares.items()))
        least = 100.0 * LEAST_SHARE
        return f"of its own noise the residuals show, at least, {shares} ({least:.0f} % needed)"
    if cell.fault not in OF_ONE_GAUGE:
        return None
    passes_5u, passes_2u = 1e4 * cell.passes_5u / cell.rows, 100.0 * cell.passes_2u / cell.rows
    if ("wrong rows" in out and passes_5u <= ALLOWED_WRONG_PER_10000) or (
        "coverage" in out and passes_2u <= 100.0 * (1.0 - LEAST_COVERAGE)
    ):
        return None
    return f"a fault of 5 u(P) passes in {passes_5u:.0f} of 10,000 readings, one of 2 u(P) in {passes_2u:.0f} %"


def row_of(cell: Cell) -> list[str]:
    """One line of the table."""
    rig = f"{cell.rig.grooves} x {cell.rig.weights} x {cell.rig.repeats}"
    rig += " off by 0.5" if cell.rig.groove_error_rad else ""
    return [
        str(cell.gauges), rig, cell.fault, f"{sum(cell.refused.values())} of {cell.calibrations}",
        f"{100.0 * cell.ok_share:.1f}", f"{cell.wrong_per_10000:.1f}", f"{100.0 * cell.covered_share:.1f}",
        f"{cell.u_over_error:.2f}", verdict(cell),
    ]  # fmt: skip


def faults(calibrations: int, jobs: int) -> list[Cell]:
    """Every fault on one rig for 3 to 8 gauges."""
    return [cell for n in range(3, 9) for cell in cells(n, Rig(), AFTER + IN_CALIBRATION, calibrations, jobs)]


def grid(calibrations: int, jobs: int) -> list[Cell]:
    """The grid of rigs, grooves off by 0.5 degree, for 3 and 5 gauges."""
    rigs = [Rig(grooves, weights, repeats, GROOVE_ERROR_RAD) for grooves, weights, repeats in GRID]
    return [cell for n in (3, 5) for rig in rigs for cell in cells(n, rig, ("clean",), calibrations, jobs)]


def alarms(gauges: int, calibrations: int, jobs: int) -> list[str]:
    """False alarms of good samples."""
    with ProcessPoolExecutor(jobs) as pool:
        found = sum(pool.map(partial(false_alarms, gauges, ALARM_ROWS), range(calibrations)))
    samples = calibrations * ALARM_ROWS
    good = found <= ALLOWED_ALARMS_PER_100000 * 1e-5 * samples
    return [str(gauges), f"{samples}", str(found), "good" if good else "out"]


def drift_row(gauge: int, calibrations: int, jobs: int) -> list[str]:
    """One of five gauges that drifts by 50 microstrain/s."""
    with ProcessPoolExecutor(jobs) as pool:
        found = list(pool.map(partial(drifting, gauge), range(calibrations)))
    samples, wrong = sum(one[0] for one in found), sum(one[1] for one in found)
    known = float(np.nanmean([one[2] for one in found]))
    verdict = "good" if wrong <= ALLOWED_WRONG_PER_10000 * 1e-4 * samples else "out"
    return [GAUGES[gauge], str(samples), f"{1e4 * wrong / samples:.2f}", f"{100 * known:.0f}", verdict]


def main() -> int:
    """Run the study; 1 where a cell is out of its bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calibrations", type=int, default=FULL, metavar="N")
    parser.add_argument("--part", choices=PARTS, help="one table only")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--markdown", action="store_true")
    args = parser.parse_args()
    parts = (args.part,) if args.part else PARTS
    seeds = f"{args.calibrations} calibrations, seeds 0 to {args.calibrations - 1}"
    out = 0
    for part, of_cells in (("faults", faults), ("grid", grid)):
        if part in parts:
            found = of_cells(args.calibrations, args.jobs)
            print(table(HEADER, [row_of(cell) for cell in found], args.markdown))
            for reason in sorted({reason for cell in found for reason in cell.refused}):
                print(f"refused: {reason}...")
            bad = sum(verdict(cell).startswith("out") for cell in found)
            print(f"\n{len(found)} cells of {seeds}: {bad} out of their bounds\n")
            out += bad
    if "alarms" in parts:
        rows = [alarms(n, args.calibrations, args.jobs) for n in range(4, 9)]
        print(table(["gauges", "good samples", "false alarms", "verdict"], rows, args.markdown))
        print(f"\n{seeds}\n")
        out += sum(row[-1] == "out" for row in rows)
    if "drift" in parts:
        once = max(1, args.calibrations // 10)
        rows = [drift_row(gauge, once, args.jobs) for gauge in range(5)]
        heading = ["drifting gauge", "samples", "wrong in 10,000", "P known after the find, %", "verdict"]
        print(table(heading, rows, args.markdown))
        print(f"\n{once} calibrations, seeds 0 to {once - 1}")
        out += sum(row[-1] == "out" for row in rows)
    return 1 if out else 0


if __name__ == "__main__":
    raise SystemExit(main())
