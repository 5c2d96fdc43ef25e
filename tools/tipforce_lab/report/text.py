"""The report as text and as JSON records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from tipforce_lab.report.run import Item, LeftOut, Report
from tipforce_lab.report.study import Case, Counted, Grid, Need, Outcome, Study, sums_of

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

ADVICE_HEADS = ("need", "method", "error", "processor time")


def verdict(report: Report) -> list[str]:
    """Return sentences: what held, what did not, how the references were checked."""
    sentences, failed = [], [case.key for case in report.cases if not case.held]
    if failed:
        sentences.append(
            f"{len(failed)} of {len(report.cases)} claims on extreme input do NOT hold: {', '.join(failed)}."
        )
    elif report.cases:
        sentences.append(f"All {len(report.cases)} claims on extreme input hold.")
    sentences += [_grid(grid) for grid in report.grids]
    checked = [study.check_difference for study in report.studies if study.check_difference is not None]
    if checked:
        sentences.append(
            f"{len(checked)} references that are code of the project agree with an independent computation within "
            f"{max(checked):.1e}."
        )
    failed = [lack.key for lack in report.left_out if lack.failed]
    if failed:
        sentences.append(f"Failed: {', '.join(failed)}.")
    return sentences


def advice(report: Report) -> list[tuple[str, ...]]:
    """Return (study, *ADVICE_HEADS) for each need of the studies: the fastest method whose error is small enough."""
    return [(study.key, *_advice(study, need)) for study in report.studies if study.series for need in study.needs]


def _advice(study: Study, need: Need) -> tuple[str, str, str, str]:
    choice = study.recommended(need)
    if choice is None:
        return need.text, "none is exact enough", "", ""
    series, point = choice
    method = f"{series.method}, {point.setting}" if point.setting else series.method
    unit = study.work_unit.replace("s per", "per").split(" (")[0]
    shown = f"{shown_time(point.timing.work_seconds)} {unit}"
    return need.text, method, shown_advised_error(point.error, need.unit), shown


def _grid(grid: Grid) -> str:
    broken = [row.name for row in grid.rows if not row.held]
    _, least = sums_of(grid.methods, grid.rows)
    sentence = f"Of the ways to show values, {least} shows the fewest wrong ones as ok"
    if broken:
        return f"{sentence}. Too many, without a known reason: {'; '.join(broken)}."
    excused = sum(any(row.reasons) for row in grid.rows)
    return (
        f"{sentence}. In {excused} of {len(grid.rows)} cases of fault and gauges at least one shows more of them than "
        "allowed (1 in 10,000, or one row); the reasons are known and listed."
    )


OUTCOMES: tuple[Outcome, ...] = ("pass", "bounded", "flagged", "refused")
_TIME_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (0.0, "ns"))


def shown_time(seconds: float) -> str:
    """Format seconds with three digits and a suitable unit: 4.57 us."""
    unit, name = next((unit, name) for unit, name in _TIME_UNITS if seconds >= unit)
    return f"{seconds / (unit or 1e-9):.3g} {name}"


def shown_error(error: float) -> str:
    """Format with two digits: 4.2e-12, 0."""
    return f"{error:.1e}" if error else "0"


def shown_advised_error(error: float, unit: str) -> str:
    """Format with its unit, a relative error from 1e-5 on in percent: 0.011 N, 5.3 %."""
    if unit:
        return f"{error:.2g} {unit}"
    return f"{100.0 * error:.2g} %" if error >= 1e-5 else shown_error(error)


def shown_reference(study: Study) -> str:
    """Return the reference with its own error, and how it was checked."""
    own = f"its own error is {shown_error(study.reference_error)}" if study.reference_error else "it is exact"
    text = f"{study.reference}; {own}"
    if study.check_difference is not None:
        text += f". Checked independently ({study.check}): differs by {shown_error(study.check_difference)}"
    return text


def shown_counts(cell: Counted) -> str:
    """Return a cell of a grid: the share that says ok, and the wrong ones among them."""
    return f"{100.0 * cell.ok / max(cell.rows, 1):.0f} % ok, {cell.wrong} wrong"


def headline(report: Report) -> str:
    """Return date and effort."""
    return f"{report.date}, {'quick' if report.effort.quick else 'full'} run, seed {report.effort.seed}"


def summary(report: Report) -> str:
    """Return the number of studies, of cases by outcome, and the claims that did not hold."""
    counts = Counter(case.outcome for case in report.cases if case.held)
    failed = [case.key for case in report.cases if not case.held]
    studies, cases = len(report.studies), len(report.cases)
    parts = [f"{studies} {'study' if studies == 1 else 'studies'}", f"{cases} extreme case{'' if cases == 1 else 's'}"]
    parts += [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
    if failed:
        parts.append(f"{len(failed)} NOT AS CLAIMED ({', '.join(failed)})")
    if report.left_out:
        parts.append(f"{len(report.left_out)} left out ({', '.join(lack.key for lack in report.left_out)})")
    return ", ".join(parts)


def print_report(console: Console, report: Report) -> None:
    """Print the whole report."""
    console.print("tipforce report", style="bold", end="")
    console.print(f", {headline(report)}")
    console.print(", ".join(f"{name} {value}" for name, value in report.machine.items()))
    for sentence in verdict(report):
        console.print(sentence)
    if choices := advice(report):
        columns: dict[str, dict[str, Any]] = {name: {} for name in ADVICE_HEADS}
        columns["error"] = _NUMBER
        _print_table(console, "Which method for which need", columns, (cells for _, *cells in choices))
    for study in report.studies:
        _print_table(console, f"{study.title} ({study.key})", *study_table(study))
        console.print(f"reference: {shown_reference(study)}")
        _print_items(console, [*study.remarks, *(f"left out: {name}: {why}" for name, why in study.left_out.items())])
    for grid in report.grids:
        rows = (
            [row.name, *(
                _marked(shown_counts(cell), over and not reason)
                for cell, reason, over in zip(row.cells, row.reasons, row.over, strict=True)
            )]
            for row in grid.rows
        )  # fmt: skip
        _print_table(console, grid.title, {name: {} for name in (grid.corner, *grid.methods)}, rows)
        _print_items(console, [*grid.remarks, *grid_reasons(grid)])
    if report.cases:
        title = "Extreme cases, as the tests of this version recorded them"
        _print_table(console, title, _CASE_COLUMNS, map(_case_row, report.cases), show_lines=True)
    for lack in report.left_out:
        console.print("left out", style="bold", end="")
        console.print(f" {lack.key}: {lack.reason}")
    console.print(summary(report))


def _print_table(
    console: Console, title: str, columns: Mapping[str, Mapping[str, Any]], rows: Iterable[Sequence[str | Text]],
    **options: Any,
) -> None:  # fmt: skip
    """Print an empty line and a table; ``columns``: rich's options by heading."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", **options)
    for head, column in columns.items():
        table.add_column(head, **column)
    for row in rows:
        table.add_row(*row)
    console.print()
    console.print(table)


def _print_items(console: Console, items: Iterable[str]) -> None:
    for item in items:
        console.print(f"- {item}")


def _marked(text: str, bad: bool) -> str | Text:
    from rich.text import Text

    return Text(text, "bold red") if bad else text


def _case_row(case: Case) -> list[str | Text]:
    outcome = _marked(case.outcome if case.held else f"NOT {case.outcome}", not case.held)
    return [case.key, outcome, f"{case.situation}: {case.claim}", case.figures]


_CASE_COLUMNS: dict[str, dict[str, Any]] = {
    "case": {"overflow": "fold", "ratio": 2},
    "outcome": {"no_wrap": True},
    "situation: claim": {"ratio": 4},
    "seen": {"overflow": "fold", "ratio": 3},
}
_NUMBER: dict[str, Any] = {"justify": "right"}
_TIME = {**_NUMBER, "no_wrap": True}


def study_table(study: Study) -> tuple[dict[str, dict[str, Any]], list[list[str]]]:
    """Return rich's options by heading, and the rows; the method is in its first row. Empty columns are left out."""
    columns: dict[str, dict[str, Any]] = {
        "method": {"ratio": 4},
        "setting": {"ratio": 3},
        study.error_unit: {"ratio": 2, **_NUMBER},
        "root mean square": _NUMBER,
        study.work_unit.replace("s per", "time per"): _TIME,
        "quartiles": {"no_wrap": True},
        "processor": _TIME,
        "runs": _NUMBER,
    }
    rows = []
    for series in study.series:
        for number, point in enumerate(series.points):
            timing = point.timing
            rows.append([
                "" if number else series.method, point.setting, shown_error(point.error),
                "" if point.rms_error is None else shown_error(point.rms_error), shown_time(timing.seconds),
                f"{shown_time(timing.first_quartile_s)} - {shown_time(timing.third_quartile_s)}",
                "" if timing.cpu_seconds is None else shown_time(timing.cpu_seconds), str(timing.runs),
            ])  # fmt: skip
    optional = ("root mean square", "processor")
    kept = [k for k, head in enumerate(columns) if head not in optional or any(row[k] for row in rows)]
    heads = list(columns)
    return {heads[k]: columns[heads[k]] for k in kept}, [[row[k] for k in kept] for row in rows]


def grid_reasons(grid: Grid) -> list[str]:
    """Return each reason why wrong rows are shown as ok, with the cases and methods that it is for."""
    rows_by_reason: dict[str, dict[str, None]] = {}
    for row in grid.rows:
        for reason in filter(None, row.reasons):
            rows_by_reason.setdefault(reason, {})[row.name] = None
    return [f"{'; '.join(names)}: {reason}" for reason, names in rows_by_reason.items()]


def head_record(report: Report) -> dict[str, Any]:
    """Return the first JSON line: date, effort and machine."""
    return {
        "record": "report",
        "date": report.date,
        "quick": report.effort.quick,
        "seed": report.effort.seed,
        "machine": report.machine,
    }


def conclusions(report: Report) -> dict[str, Any]:
    """Return the verdict and the advice of a finished report, for JSON."""
    return {"verdict": verdict(report), "advice": [cells for _, *cells in advice(report)]}


def record(item: Item) -> dict[str, Any]:
    """Return a study, a grid, a case, or a part left out as a JSON record."""
    return {"record": _RECORDS[type(item)], **asdict(item)}


_RECORDS = {Study: "study", Grid: "grid", Case: "case", LeftOut: "left out"}
