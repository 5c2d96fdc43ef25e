"""Simulated calibrations with everything wrong at once: the short form of bench/calibration.py."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


def test_twenty_calibrations_beside_the_fit_that_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    from bench.calibration_study import CONDITIONS, SEEDS, compare, pooled

    faults, drift = CONDITIONS["everything"]
    comparisons = [compare(seed, faults, drift) for seed in range(SEEDS)]
    assert pooled(comparisons, "fit") <= 1.15 * pooled(comparisons, "oracle")
    assert pooled(comparisons, "fit_matrix") <= 1.15 * pooled(comparisons, "oracle_matrix")
    assert pooled(comparisons, "linear") > 10 * pooled(comparisons, "fit")
    assert sum(one.found for one in comparisons) >= 0.95 * sum(one.outliers for one in comparisons)
    assert sum(one.falsely for one in comparisons) <= 1


@pytest.mark.parametrize(
    ("condition", "simulations"),
    [("offset and noise", 80), ("angles of grooves", 40), ("outliers", 40), ("everything", 50)],
)
def test_intervals_hold_what_they_promise(condition: str, simulations: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    from bench.calibration_study import coverage

    found = coverage(condition, simulations)
    # Two points, as for 2000 simulations, and what so few may be off by chance.
    assert 90.0 < found.matrix < 99.0
    assert 90.0 < found.force < 99.0
    assert found.false_alarm < 8.0


def test_the_command_prints_its_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    from bench.calibration import comparison_rows, coverage_rows
    from bench.calibration_study import CONDITIONS, compare, coverage
    from bench.printed import table

    faults, drift = CONDITIONS["offset and noise"]
    rows = comparison_rows([compare(0, faults, drift, "none")])
    assert rows[0][:2] == ["0", "I"]
    assert rows[-1][0] == "all"
    text = table(["a"] * 5, coverage_rows([coverage("linear drift", 3)]), markdown=True)
    assert text.splitlines()[2].startswith("| linear drift |")
    assert len({len(line) for line in table(["seed"] * 9, rows, markdown=False).splitlines()}) == 1
