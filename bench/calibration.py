"""How good is the calibration fit? Beside a fit that knows the truth, and by what its 95 % intervals hold.

python -m bench.calibration                 20 calibrations and 2000 simulations a condition (minutes)
python -m bench.calibration --quick         60 simulations a condition
python -m bench.calibration --markdown      the tables of docs/calibration.md
python -m bench.calibration --json          JSON lines

Exit code 1 where the fit is more than 1.15 times as far off as the one that knows, or the intervals of C hold the
truth in fewer than 93 or more than 97 per cent.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict

from bench.calibration_study import (
    CONDITIONS,
    FULL_SIMULATIONS,
    QUICK_SIMULATIONS,
    SEEDS,
    Comparison,
    Coverage,
    compare,
    coverage,
    pooled,
)
from bench.printed import table

ALLOWED_RATIO = 1.15
ALLOWED_PERCENT = (93.0, 97.0)


def comparison_rows(comparisons: list[Comparison]) -> list[list[str]]:
    """One row a calibration, and all together; newtons become millinewtons."""
    names = ("fit", "oracle", "linear", "fit_matrix", "oracle_matrix", "linear_matrix")
    rows = []
    for one in comparisons:
        errors = [f"{1e3 * getattr(one, name):.1f}" for name in names]
        outliers = f"{one.found} of {one.outliers}" + (f", {one.falsely} false" if one.falsely else "")
        rows.append([str(one.seed), one.case, *errors, outliers])
    rows.append(["all", "", *(f"{1e3 * pooled(comparisons, name):.1f}" for name in names), ""])
    return rows


def coverage_rows(found: list[Coverage]) -> list[list[str]]:
    """One row a condition, per cent."""
    return [
        [one.condition, *(f"{value:.1f}" for value in (one.matrix, one.matrix_worst, one.force, one.false_alarm))]
        for one in found
    ]


def main() -> int:
    """Run the study; 1 where it is out of its bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    faults, drift = CONDITIONS["everything"]
    comparisons = [compare(seed, faults, drift) for seed in range(SEEDS)]
    simulations = QUICK_SIMULATIONS if args.quick else FULL_SIMULATIONS
    found = [coverage(condition, simulations, os.cpu_count() or 1) for condition in CONDITIONS]
    ratio = pooled(comparisons, "fit") / pooled(comparisons, "oracle")
    matrix_ratio = pooled(comparisons, "fit_matrix") / pooled(comparisons, "oracle_matrix")
    if args.json:
        for record in (*map(asdict, comparisons), *map(asdict, found)):
            print(json.dumps(record))
    else:
        header = ["seed", "case", "fit", "knows", "paper", "fit, C only", "knows, C only", "paper, C only", "outliers"]
        print(table(header, comparison_rows(comparisons), args.markdown))
        print(
            f"\nRMS force error in mN; fit / knows = {ratio:.3f}, C only {matrix_ratio:.3f} (allowed {ALLOWED_RATIO})\n"
        )
        header = ["fault", "C", "worst entry of C", "force", "false alarms"]
        print(table(header, coverage_rows(found), args.markdown))
        print(f"\nper cent of {simulations} simulations that the 95 % intervals hold")
    low, high = ALLOWED_PERCENT
    good = max(ratio, matrix_ratio) <= ALLOWED_RATIO and all(low <= one.matrix <= high for one in found)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
