"""The verdict of a report, and which method to take for which need: what its first page says."""

from __future__ import annotations

from dataclasses import dataclass

from tipforce_lab.report.run import Report
from tipforce_lab.report.study import Counted, Grid, Need, Study


@dataclass(frozen=True, slots=True)
class Advice:
    """One need and the method for it."""

    study: str
    """Key of the study that says so."""
    need: str
    method: str
    """With its setting; "" where no method is exact enough."""
    error: float
    unit: str
    """Of the error; "" for a relative one."""
    seconds: float
    """Processor time where it is known."""
    work_unit: str


def verdict(report: Report) -> list[str]:
    """Return sentences: what held, what did not, how the references were checked."""
    found = [_cases(report)] if report.cases else []
    found += [_grid(grid) for grid in report.grids]
    checked = [study.check_difference for study in report.studies if study.check_difference is not None]
    if checked:
        found.append(
            f"{len(checked)} references that are code of the project agree with an independent computation within "
            f"{max(checked):.1e}."
        )
    failed = [lack.key for lack in report.left_out if lack.failed]
    if failed:
        found.append(f"Failed: {', '.join(failed)}.")
    return found


def advice(report: Report) -> list[Advice]:
    """Return for each need of the studies the method with the least processor time whose error is small enough."""
    return [_advice(study, need) for study in report.studies if study.series for need in study.needs]


def _advice(study: Study, need: Need) -> Advice:
    found = study.recommended(need)
    if found is None:
        return Advice(study.key, need.text, "", float("nan"), need.unit, float("nan"), study.work_unit)
    one, point = found
    method = f"{one.method}, {point.setting}" if point.setting else one.method
    return Advice(study.key, need.text, method, point.error, need.unit, point.timing.work_seconds, study.work_unit)


def _cases(report: Report) -> str:
    failed = [one.case.key for one in report.cases if not one.observed.held]
    if failed:
        return f"{len(failed)} of {len(report.cases)} claims on extreme input do NOT hold: {', '.join(failed)}."
    return f"All {len(report.cases)} claims on extreme input hold."


def _grid(grid: Grid) -> str:
    sums = [sum((row.cells[k] for row in grid.rows), Counted()) for k in range(len(grid.methods))]
    broken = [row.name for row in grid.rows if not row.held]
    least = min(range(len(sums)), key=lambda k: (sums[k].wrong, -sums[k].ok))
    told = f"Of the ways to show values, {grid.methods[least]} shows the fewest wrong ones as ok"
    if broken:
        return f"{told}. Too many, without a known reason: {'; '.join(broken)}."
    excused = sum(any(row.reasons) for row in grid.rows)
    return (
        f"{told}. In {excused} of {len(grid.rows)} cases of fault and gauges at least one shows more of them than "
        "allowed (1 in 10,000, or one row); the reasons are known and listed."
    )
