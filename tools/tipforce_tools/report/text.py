"""The report as text and as JSON records."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from tipforce_tools.report.run import Judged, LeftOut, Report
from tipforce_tools.report.stability.case import Outcome
from tipforce_tools.report.study import Point, Study

if TYPE_CHECKING:
    from rich.console import Console

OUTCOMES: tuple[Outcome, ...] = ("pass", "bounded", "flagged", "refused")
_TIME_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (0.0, "ns"))


def shown_time(seconds: float) -> str:
    """Format seconds with three digits and a suitable unit: 4.57 us."""
    unit, name = next((unit, name) for unit, name in _TIME_UNITS if seconds >= unit)
    return f"{seconds / (unit or 1e-9):.3g} {name}"


def shown_error(error: float) -> str:
    """Format with two digits: 4.2e-12, 0."""
    return f"{error:.1e}" if error else "0"


def shown_quartiles(point: Point) -> str:
    """Return the interquartile range of the runs."""
    return f"{shown_time(point.timing.first_quartile_s)} - {shown_time(point.timing.third_quartile_s)}"


def has_rms(study: Study) -> bool:
    """Return whether any point has a root mean square besides its error."""
    return any(point.rms_error is not None for one in study.series for point in one.points)


def headline(report: Report) -> str:
    """Return date and effort."""
    return f"{report.date}, {'quick' if report.effort.quick else 'full'} run, seed {report.effort.seed}"


def summary(report: Report) -> str:
    """Return the number of studies, of cases by outcome, and the claims that did not hold."""
    counts = Counter(one.case.outcome for one in report.cases if one.observed.held)
    failed = [one.case.key for one in report.cases if not one.observed.held]
    parts = [_counted(len(report.studies), "study", "studies"), _counted(len(report.cases), "extreme case")]
    parts += [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
    if failed:
        parts.append(f"{len(failed)} NOT AS CLAIMED ({', '.join(failed)})")
    if report.left_out:
        parts.append(f"{len(report.left_out)} left out ({', '.join(one.key for one in report.left_out)})")
    return ", ".join(parts)


def _counted(count: int, one: str, many: str = "") -> str:
    return f"{count} {one if count == 1 else many or one + 's'}"


def print_report(console: Console, report: Report) -> None:
    """Print the whole report."""
    from rich.markup import escape

    console.print(f"[bold]tipforce report[/bold], {headline(report)}")
    console.print(escape(", ".join(f"{name} {value}" for name, value in report.machine.items())))
    for study in report.studies:
        _print_study(console, study)
    if report.cases:
        _print_cases(console, report.cases)
    for lack in report.left_out:
        console.print(f"[bold]left out[/bold] {lack.key}: {escape(lack.reason)}")
    console.print(escape(summary(report)))


def _print_study(console: Console, study: Study) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"{escape(study.title)} ({study.key})", title_justify="left")
    table.add_column("method", ratio=4)
    table.add_column("setting", ratio=3)
    table.add_column(escape(study.error_unit), ratio=2, justify="right")
    if has_rms(study):
        table.add_column("root mean square", justify="right")
    table.add_column(escape(study.work_unit.replace("s per", "time per")), justify="right", no_wrap=True)
    table.add_column("quartiles", no_wrap=True)
    table.add_column("runs", justify="right")
    for one in study.series:
        for number, point in enumerate(one.points):
            table.add_row(*map(escape, cells(study, one.method if not number else "", point)))
    console.print()
    console.print(table)
    own = f"; its own error {shown_error(study.reference_error)}" if study.reference_error else ", which is exact"
    console.print(escape(f"reference: {study.reference}{own}"))
    for remark in study.remarks:
        console.print(escape(f"- {remark}"))
    for method, reason in study.left_out.items():
        console.print(f"- left out: {escape(method)}: {escape(reason)}")


def cells(study: Study, method: str, point: Point) -> list[str]:
    """Return one row of a study's table."""
    row = [method, point.setting, shown_error(point.error)]
    if has_rms(study):
        row.append("" if point.rms_error is None else shown_error(point.rms_error))
    return [*row, shown_time(point.timing.seconds), shown_quartiles(point), str(point.timing.runs)]


def _print_cases(console: Console, cases: list[Judged]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title="Extreme cases", title_justify="left", show_lines=True)
    table.add_column("case", overflow="fold", ratio=2)
    table.add_column("outcome", no_wrap=True)
    table.add_column("situation: claim", ratio=4)
    table.add_column("seen", overflow="fold", ratio=3)
    for one in cases:
        case, seen = one.case, one.observed
        outcome = case.outcome if seen.held else f"[bold red]NOT {case.outcome}[/bold red]"
        table.add_row(escape(case.key), outcome, escape(f"{case.situation}: {case.claim}"), escape(seen.figures))
    console.print()
    console.print(table)


def head_record(report: Report) -> dict[str, Any]:
    """Return the first JSON line: date, effort and machine."""
    return {
        "record": "report",
        "date": report.date,
        "quick": report.effort.quick,
        "seed": report.effort.seed,
        "machine": report.machine,
    }


def record(item: Study | Judged | LeftOut) -> dict[str, Any]:
    """Return a study, a case, or a part left out as a JSON record."""
    if isinstance(item, Study):
        return {"record": "study", **asdict(item)}
    if isinstance(item, Judged):
        case = item.case
        return {
            "record": "case",
            "key": case.key,
            "situation": case.situation,
            "outcome": case.outcome,
            "claim": case.claim,
            "held": bool(item.observed.held),  # numpy's bool is not a bool of JSON
            "figures": item.observed.figures,
        }
    return {"record": "left out", "key": item.key, "reason": item.reason, "failed": item.failed}
