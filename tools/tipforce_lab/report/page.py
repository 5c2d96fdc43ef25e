"""The report as one self-contained HTML page: no script, no network, readable on a phone and on paper."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from tipforce.output_file import HTML, JSON_LINES, write_file
from tipforce_lab.report import plots, text
from tipforce_lab.report.run import Item, Report
from tipforce_lab.report.study import Case, Study


def write(report: Report, directory: Path, json_line: Callable[[dict[str, Any]], str]) -> list[Path]:
    """Write index.html, report.jsonl and a KEY.svg for each study. Raises InputError, WriteError.

    json_line: from a record to its line of report.jsonl, without the newline.
    """
    items: list[Item] = [*report.studies, *report.grids, *report.cases, *report.left_out]
    records = [text.head_record(report) | text.conclusions(report), *map(text.record, items)]
    lines = "".join(json_line(record) + "\n" for record in records)
    write_file(directory / "index.html", html(report), HTML)
    write_file(directory / "report.jsonl", lines, JSON_LINES)
    figures = [directory / f"{study.key}.svg" for study in report.studies]
    for study, path in zip(report.studies, figures, strict=True):
        plots.save(study, path)
    return [directory / "index.html", directory / "report.jsonl", *figures]


def style() -> str:
    """Return the style sheet of the page, with the colours of the plots for light and dark mode."""
    light, night = (
        "".join(f".f-{name}{{fill:{value}}}.s-{name}{{stroke:{value}}}" for name, value in colours.items())
        for colours in (
            {name: pair[0] for name, pair in plots.COLOURS.items()} | {"grid": plots.GRID, "band": plots.BAND},
            {name: pair[1] for name, pair in plots.COLOURS.items()} | {"grid": "#3a4046", "band": "#9aa3ab"},
        )
    )
    paper = ".f-paper{fill:var(--paper)}.s-paper{stroke:var(--paper)}.label{fill:var(--ink)}"
    sheets = resources.files(__package__)
    always, dark_paper = (sheets.joinpath(name).read_text(encoding="utf-8") for name in ("style.css", "dark.css"))
    return f"{always}{light}{paper}\n@media screen and (prefers-color-scheme:dark){{{dark_paper}{night}}}\n"


def html(report: Report) -> str:
    """Return the page. Raises EnvironmentLackError without matplotlib."""
    sheet = style()
    digest = base64.b64encode(hashlib.sha256(sheet.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>tipforce report, {escape(report.date)}</title>",
        f"<style>{sheet}</style></head><body><main>",
        *_head(report),
    ]
    if report.studies:
        parts += ['<h2 id="studies">Error against run time</h2>', f'<p class="note">{_HOW_TO_READ}</p>']
        parts += [_study(study) for study in report.studies]
    for grid in report.grids:
        items, table = _items(text.grid_items(grid)), _table("cases grid", text.grid_table(grid))
        parts.append(f'<section id="{escape(grid.key)}"><h2>{escape(grid.title)}</h2><ul>{items}</ul>')
        parts.append(f'<p class="note">{_GRID}</p>{table}</section>')
    if report.cases:
        parts += ['<h2 id="cases">Extreme cases</h2>', f'<p class="note">{_OUTCOMES}</p>', *_cases(report.cases)]
    if report.left_out:
        lacks = (f"<li><b>{escape(lack.key)}</b>: {escape(lack.reason)}</li>" for lack in report.left_out)
        parts += ['<h2 id="left-out">Left out</h2>', f"<ul>{''.join(lacks)}</ul>"]
    return "\n".join([*parts, "</main></body></html>", ""])


def _items(texts: Iterable[str]) -> str:
    return "".join(f"<li>{escape(text)}</li>" for text in texts)


_HOW_TO_READ = (
    "Down is more exact, left is faster. Each point is a setting of a method, at the median processor time of its "
    "runs, all warm; the bar across it spans the quartiles, and the table has the wall time beside it. A dotted line "
    "leads from the largest error down to the root mean square. A triangle at the upper edge is a run that became "
    "unstable. Errors within a shaded band are not distinguishable from that of the reference; without a band it is "
    "far below the plot."
)
_OUTCOMES = (
    "pass: right to rounding. bounded: the error has a stated bound. flagged: the value is marked as unknown. refused: "
    "an error or abort code names the place, and nothing changed. The tests of this version recorded them."
)
_GRID = (
    "Share of the rows that are shown as ok, and how many of those are wrong. Bold: more than 1 in 10,000; the list "
    "above has the reason where the data cannot tell."
)


def _head(report: Report) -> list[str]:
    machine = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in report.machine.items())
    links = [(study.key, study.title) for study in report.studies]
    links += [(grid.key, grid.title) for grid in report.grids]
    links += [("cases", "Extreme cases")] if report.cases else []
    links += [("left-out", "Left out")] if report.left_out else []
    entries = "".join(f'<li><a href="#{escape(key)}">{escape(title)}</a></li>' for key, title in links)
    parts = [
        "<h1>tipforce: error against run time, and extreme cases</h1>",
        f'<div class="summary"><p>{escape(text.summary(report))}</p><ul>{_items(text.verdict(report))}</ul></div>',
    ]
    advices = text.advice_table(report)
    if advices.rows:
        note = "The least processor time among those whose error is small enough for the need."
        parts += [f'<h2 id="advice">{advices.title}</h2>', f'<p class="note">{note}</p>', _table("advice", advices)]
    return [
        *parts,
        f"<nav><h2>Contents</h2><ul>{entries}</ul></nav>",
        f"<details><summary>Run of {escape(text.headline(report))}: machine and versions</summary><dl>{machine}</dl>",
        "</details>",
    ]


def _study(study: Study) -> str:
    items = _items(text.study_items(study))
    points, key = sum(len(series.points) for series in study.series), escape(study.key)
    table = _table("points", text.study_table(study))
    return "\n".join(
        (
            f'<section class="study" id="{key}"><h3 id="{key}-title">{escape(study.title)}</h3>',
            f"<figure>{plots.svg(study)}</figure>",
            f"<ul>{items}</ul>" if items else "",
            f"<details><summary>All {points} points as a table</summary>{table}</details>",
            f'<p class="reference">Reference: {escape(text.shown_reference(study))}.</p></section>',
        )
    )


def _cases(cases: list[Case]) -> list[str]:
    """Return one table per area, folded unless a claim of it does not hold."""
    areas: dict[str, list[Case]] = {}
    for case in cases:
        areas.setdefault(case.key.split(".")[0], []).append(case)
    parts = []
    for area, of_area in areas.items():
        broken = sum(not case.held for case in of_area)
        opened = " open" if broken else ""
        result = f"{broken} of {len(of_area)} do NOT hold" if broken else f"all {len(of_area)} hold"
        table = _table("cases", text.case_table(area, of_area), "case-")
        parts.append(f"<details{opened}><summary>{escape(area)}: {result}</summary>{table}</details>")
    return parts


def _table(name: str, table: text.Table, row_ids: str | None = None) -> str:
    """Return a table that scrolls sideways; ``row_ids`` begins the identifier that each row has from its heading."""
    classes = {head: ' class="number"' if kind in text.NUMBERS else "" for head, kind in table.heads.items()}
    head = "".join(f'<th scope="col"{kind}>{escape(title)}</th>' for title, kind in classes.items())
    rows = []
    for first, *others in table.rows:
        heading = first if isinstance(first, text.Cell) else text.Cell(first)
        shown = escape(heading.text)
        shown = f'<a href="#{escape(heading.link)}">{shown}</a>' if heading.link else shown
        cells = [f'<th scope="row">{shown}</th>']
        for title, cell in zip(list(classes)[1:], others, strict=True):
            value, kind, note, _ = cell if isinstance(cell, text.Cell) else text.Cell(cell)
            attributes = f' class="{kind}"' if kind else classes[title]
            attributes += f' title="{escape(note)}"' if note else ""
            cells.append(f'<td data-name="{escape(title)}"{attributes}>{escape(value)}</td>')
        row_id = "" if row_ids is None else f' id="{row_ids}{escape(heading.text)}"'
        rows.append(f"<tr{row_id}>{''.join(cells)}</tr>")
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide"><table class="{name}">{body}</table></div>'
