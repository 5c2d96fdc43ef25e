"""Simulated calibrations with everything wrong at once: the short form of bench/calibration.py."""

from __future__ import annotations

import pytest
from bench.calibration import CONDITIONS, SEEDS, compare, comparison_rows, coverage, coverage_rows, pooled
from bench.measure import table


def test_twenty_calibrations_beside_the_fit_that_knows() -> None:
    faults, drift = CONDITIONS["everything"]
    comparisons = [compare(seed, faults, drift) for seed in range(SEEDS)]
    assert pooled(comparisons, "fit") <= 1.15 * pooled(comparisons, "oracle")
    assert pooled(comparisons, "fit_matrix") <= 1.15 * pooled(comparisons, "oracle_matrix")
    assert pooled(comparisons, "linear") > 10 * pooled(comparisons, "fit")
    assert sum(run.found for run in comparisons) >= 0.95 * sum(run.outliers for run in comparisons)
    assert sum(run.falsely for run in comparisons) <= 1


@pytest.mark.parametrize(
    ("condition", "simulations"),
    [("offset and noise", 40), ("angles of grooves", 25), ("outliers", 25), ("everything", 25)],
)
def test_intervals_hold_what_they_promise(condition: str, simulations: int) -> None:
    held = coverage(condition, simulations)
    # Two points, as for 2000 simulations, and what so few may be off by chance.
    assert 90.0 < held.matrix < 99.0
    assert 90.0 < held.force < 99.0
    assert held.false_alarm < 8.0


def test_the_command_prints_its_tables() -> None:
    faults, drift = CONDITIONS["offset and noise"]
    rows = comparison_rows([compare(0, faults, drift, "none")])
    assert rows[0][:2] == ["0", "I"]
    assert rows[-1][0] == "all"
    text = table(["a"] * 5, coverage_rows([coverage("linear drift", 3)]))
    assert text.splitlines()[2].startswith("| linear drift |")
    assert len({len(line) for line in table(["seed"] * 9, rows, markdown=False).splitlines()}) == 1
