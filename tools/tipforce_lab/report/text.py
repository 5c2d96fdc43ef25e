"""The report as tables for text and page, as sentences, and as JSON records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

from tipforce_lab.report.study import Case, Grid, Item, LeftOut, Need, Outcome, Report, Study, sums_of

if TYPE_CHECKING:
    from rich.console import Console


class Cell(NamedTuple):
    """A cell that is more than its text."""

    text: str
    kind: str = ""
    """Class on the page: held, doubt or broken, which text prints in red."""
    note: str = ""
    """Shown where the pointer rests on the page."""
    link: str = ""
    """Identifier of the section that a heading of a row leads to."""


class Table(NamedTuple):
    """A table as the text prints it and the page shows it; the first cell of a row is its heading."""

    title: str
    heads: dict[str, str]
    """Kind of each column by its heading: a key of _COLUMNS."""
    rows: list[list[str | Cell]]


_COLUMNS: dict[str, dict[str, Any]] = {
    "": {},
    "key": {"overflow": "fold", "ratio": 2},
    "claim": {"ratio": 4},
    "seen": {"overflow": "fold", "ratio": 3},
    "method": {"ratio": 4},
    "setting": {"ratio": 3},
    "word": {"no_wrap": True},
    "number": {"justify": "right"},
    "error": {"justify": "right", "ratio": 2},
    "time": {"justify": "right", "no_wrap": True},
}
"""Options of rich by kind of column."""
NUMBERS = ("number", "error", "time")
"""Kinds whose cells the page aligns to the right."""


def verdict(report: Report) -> list[str]:
    """Return sentences: what the grids show, what held, what did not, how the references were checked."""
    sentences, failed = [_grid(grid) for grid in report.grids], [case.key for case in report.cases if not case.held]
    claims = f"{len(report.cases)} claims on extreme input"
    if failed:
        sentences.append(f"{len(failed)} of {claims} do NOT hold: {', '.join(failed)}.")
    elif report.cases:
        sentences.append(f"All {claims} hold.")
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


def advice_table(report: Report) -> Table:
    """Return for each need of the studies the method with the least processor time whose error is small enough."""
    heads = {"need": "", "method": "", "error": "number", "processor time": ""}
    pairs = ((study, need) for study in report.studies if study.series for need in study.needs)
    rows: list[list[str | Cell]] = [[Cell(need.text, link=study.key), *_choice(study, need)] for study, need in pairs]
    return Table("Which method for which need", heads, rows)


def _choice(study: Study, need: Need) -> tuple[str, str, str]:
    choice = study.recommended(need)
    if choice is None:
        return "none is exact enough", "", ""
    series, point = choice
    method = f"{series.method}, {point.setting}" if point.setting else series.method
    unit = study.work_unit.replace("s per", "per").split(" (")[0]
    time = f"{shown_time(point.timing.work_seconds)} {unit}"
    if need.unit:
        return method, f"{point.error:.2g} {need.unit}", time
    return method, f"{100.0 * point.error:.2g} %" if point.error >= 1e-5 else shown_error(point.error), time


def _grid(grid: Grid) -> str:
    """Say in how many cases all is well, in how many not, and which way shows the fewest wrong values as ok."""
    broken = [row.name for row in grid.rows if not row.held]
    over = sum(any(row.over) for row in grid.rows)
    _, least = sums_of(grid.methods, grid.rows)
    known = f"without a known reason in {'; '.join(broken)}" if broken else "for reasons that are known and listed"
    more = f"; in {over} at least one shows more, {known}" if over else ""
    return (
        f"In {len(grid.rows) - over} of {len(grid.rows)} cases of fault and gauges no way to show values shows more "
        f"wrong ones as ok than allowed (1 in 10,000, or one row){more}. Fewest: {least}."
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


def shown_reference(study: Study) -> str:
    """Return the reference with its own error, and how it was checked."""
    own = f"its own error is {shown_error(study.reference_error)}" if study.reference_error else "it is exact"
    text = f"{study.reference}; {own}"
    if study.check_difference is not None:
        text += f". Checked independently ({study.check}): differs by {shown_error(study.check_difference)}"
    return text


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
    machine = ", ".join(f"{name} {value}" for name, value in report.machine.items())
    console.print("\n".join([machine, *verdict(report)]))
    advices = advice_table(report)
    if advices.rows:
        _print_table(console, advices)
    for study in report.studies:
        _print_table(console, study_table(study))
        console.print("\n- ".join([f"reference: {shown_reference(study)}", *study_items(study)]))
    for grid in report.grids:
        _print_table(console, grid_table(grid))
        for item in grid_items(grid):
            console.print(f"- {item}")
    if report.cases:
        title = "Extreme cases, as the tests of this version recorded them"
        _print_table(console, case_table(title, report.cases), show_lines=True)
    for lack in report.left_out:
        console.print("left out", style="bold", end="")
        console.print(f" {lack.key}: {lack.reason}")
    console.print(summary(report))


def _print_table(console: Console, table: Table, **options: Any) -> None:
    from rich.table import Table as Printed
    from rich.text import Text

    printed = Printed(title=table.title, title_justify="left", **options)
    for head, kind in table.heads.items():
        printed.add_column(head, **_COLUMNS[kind])
    for row in table.rows:
        cells = (cell if isinstance(cell, Cell) else Cell(cell) for cell in row)
        printed.add_row(*(Text(cell.text, "bold red" if cell.kind == "broken" else "") for cell in cells))
    console.print()
    console.print(printed)


def study_table(study: Study) -> Table:
    """Return all points; the method is in its first row. Empty columns are left out."""
    heads = {
        "method": "method", "setting": "setting", study.error_unit: "error", "root mean square": "number",
        study.work_unit.replace("s per", "time per"): "time", "processor": "time", "quartiles": "word",
        "runs": "number",
    }  # fmt: skip
    rows: list[list[str | Cell]] = []
    for series in study.series:
        for number, point in enumerate(series.points):
            timing = point.timing
            rows.append([
                "" if number else series.method, point.setting, shown_error(point.error),
                "" if point.rms_error is None else shown_error(point.rms_error), shown_time(timing.seconds),
                "" if timing.cpu_seconds is None else shown_time(timing.cpu_seconds),
                f"{shown_time(timing.first_quartile_s)} - {shown_time(timing.third_quartile_s)}", str(timing.runs),
            ])  # fmt: skip
    optional = ("root mean square", "processor")
    kept = [k for k, head in enumerate(heads) if head not in optional or any(row[k] for row in rows)]
    named = {head: kind for k, (head, kind) in enumerate(heads.items()) if k in kept}
    return Table(f"{study.title} ({study.key})", named, [[row[k] for k in kept] for row in rows])


def study_items(study: Study) -> list[str]:
    """Return the remarks of a study, and what it left out."""
    return [*study.remarks, *(f"left out: {name}: {why}" for name, why in study.left_out.items())]


def grid_table(grid: Grid) -> Table:
    """Return the shares that say ok, and the wrong ones among them; more than allowed without a reason is broken."""
    rows: list[list[str | Cell]] = []
    for row in grid.rows:
        cells: list[str | Cell] = [row.name]
        for count, reason, over in zip(row.cells, row.reasons, row.over, strict=True):
            kind = ("doubt" if reason else "broken") if over else "" if count.wrong else "held"
            ok = f"{100.0 * count.ok / max(count.rows, 1):.0f} % ok"
            cells.append(Cell(f"{ok}, {count.wrong} wrong", kind, reason))
        rows.append(cells)
    return Table(grid.title, dict.fromkeys((grid.corner, *grid.methods), ""), rows)


def case_table(title: str, cases: Sequence[Case]) -> Table:
    """Return extreme cases: what each claims, and what the test observed."""
    rows: list[list[str | Cell]] = []
    for case in cases:
        outcome = Cell(case.outcome, "held") if case.held else Cell(f"NOT {case.outcome}", "broken")
        rows.append([case.key, outcome, f"{case.situation}: {case.claim}", case.figures])
    return Table(title, {"case": "key", "outcome": "word", "situation: claim": "claim", "seen": "seen"}, rows)


def grid_items(grid: Grid) -> list[str]:
    """Return the remarks of a grid, and each reason for wrong rows shown as ok with the cases that it is for."""
    rows_by_reason: dict[str, dict[str, None]] = {}
    for row in grid.rows:
        for reason in filter(None, row.reasons):
            rows_by_reason.setdefault(reason, {})[row.name] = None
    return [*grid.remarks, *(f"{'; '.join(names)}: {reason}" for reason, names in rows_by_reason.items())]


def head_record(report: Report) -> dict[str, Any]:
    """Return the first JSON line: date, effort and machine."""
    return {"record": "report", "date": report.date, **asdict(report.effort), "machine": report.machine}


def conclusions(report: Report) -> dict[str, Any]:
    """Return the verdict and the advice of a finished report, for JSON."""
    advices = [[cell.text if isinstance(cell, Cell) else cell for cell in row] for row in advice_table(report).rows]
    return {"verdict": verdict(report), "advice": advices}


def record(item: Item) -> dict[str, Any]:
    """Return a study, a grid, a case, or a part left out as a JSON record."""
    return {"record": _RECORDS[type(item)], **asdict(item)}


_RECORDS = {Study: "study", Grid: "grid", Case: "case", LeftOut: "left out"}
