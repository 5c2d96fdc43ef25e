"""The report as one HTML page that needs nothing else: no script, no network, readable on a phone and on paper."""

from __future__ import annotations

import base64
import hashlib
from html import escape
from importlib import resources
from pathlib import Path

from tipforce.errors import InputError
from tipforce_tools.cli.common import json_line
from tipforce_tools.report import plots, text
from tipforce_tools.report.run import Judged, LeftOut, Report
from tipforce_tools.report.study import Study


def write(report: Report, directory: Path) -> list[Path]:
    """Write index.html, report.jsonl and a KEY.svg for each study. Raises InputError where the disk refuses."""
    items: list[Study | Judged | LeftOut] = [*report.studies, *report.cases, *report.left_out]
    records = [text.head_record(report), *map(text.record, items)]
    lines = "".join(json_line(one) + "\n" for one in records)
    found = []
    for name, content in (("index.html", html(report)), ("report.jsonl", lines)):
        path = directory / name
        try:
            path.write_text(content, encoding="utf-8")
        except OSError as error:
            raise InputError(f"--output {path}: {error.strerror}") from None
        found.append(path)
    for study in report.studies:
        found.append(directory / f"{study.key}.svg")
        plots.save(study, found[-1])
    return found


def style() -> str:
    """The page's one style sheet, with the plots' colours on light and on dark paper."""
    light = [*((name, pair[0]) for name, pair in plots.COLOURS.items()), ("grid", plots.GRID), ("band", plots.BAND)]
    dark = [*((name, pair[1]) for name, pair in plots.COLOURS.items()), ("grid", "#3a4046"), ("band", "#9aa3ab")]
    rules = "".join(_colour_rules(name, value) for name, value in light)
    night = "".join(_colour_rules(name, value) for name, value in dark)
    paper = ".f-paper{fill:var(--paper)}.s-paper{stroke:var(--paper)}.label{fill:var(--ink)}"
    sheets = resources.files(__package__)
    always, dark_paper = (sheets.joinpath(name).read_text(encoding="utf-8") for name in ("style.css", "dark.css"))
    return f"{always}{rules}{paper}\n@media screen and (prefers-color-scheme:dark){{{dark_paper}{night}}}\n"


def _colour_rules(name: str, value: str) -> str:
    return f".f-{name}{{fill:{value}}}.s-{name}{{stroke:{value}}}"


def html(report: Report) -> str:
    """The page. Raises EnvironmentLackError without matplotlib."""
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
    if report.cases:
        parts += ['<h2 id="cases">Extreme cases</h2>', f'<p class="note">{_OUTCOMES}</p>', _cases(report.cases)]
    if report.left_out:
        parts += ['<h2 id="left-out">Left out</h2>', _left_out(report.left_out)]
    return "\n".join([*parts, "</main></body></html>", ""])


_HOW_TO_READ = (
    "Down is more exact, left is faster. Each point is a setting of a method, at the median time of its runs; the bar "
    "across it spans the quartiles. A dotted line leads from the largest error down to the root mean square. Errors "
    "within a shaded band are not told apart from the error of the reference; without a band that error is far below "
    "the plot."
)
_OUTCOMES = (
    "pass: right to rounding. bounded: the error has a stated bound. flagged: the value is marked as unknown. refused: "
    "an error or abort code names the place, and nothing changed."
)


def _head(report: Report) -> list[str]:
    machine = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in report.machine.items())
    links = [(study.key, study.title) for study in report.studies]
    links += [("cases", "Extreme cases")] if report.cases else []
    links += [("left-out", "Left out")] if report.left_out else []
    entries = "".join(f'<li><a href="#{escape(key)}">{escape(title)}</a></li>' for key, title in links)
    return [
        f"<h1>tipforce: error against run time, and extreme cases</h1><p>{escape(text.headline(report))}</p>",
        f'<p class="summary">{escape(text.summary(report))}</p>',
        f"<dl>{machine}</dl><nav><ul>{entries}</ul></nav>",
    ]


def _study(study: Study) -> str:
    own = f"its own error is {text.shown_error(study.reference_error)}" if study.reference_error else "it is exact"
    remarks = "".join(f"<li>{escape(remark)}</li>" for remark in study.remarks)
    absent = "".join(f"<li>left out: {escape(name)}: {escape(why)}</li>" for name, why in study.left_out.items())
    return "\n".join(
        (
            f'<section class="study" id="{escape(study.key)}"><h3 id="{escape(study.key)}-title">',
            f"{escape(study.title)}</h3>",
            f"<figure>{plots.svg(study)}</figure>",
            f"<ul>{remarks}{absent}</ul>" if remarks or absent else "",
            _table(study),
            f'<p class="reference">Reference: {escape(study.reference)}; {own}.</p></section>',
        )
    )


def _table(study: Study) -> str:
    heads = ["method", "setting", study.error_unit, *(["root mean square"] if text.has_rms(study) else [])]
    heads += [study.work_unit.replace("s per", "time per"), "quartiles", "runs"]
    rows = []
    for one in study.series:
        for number, point in enumerate(one.points):
            method, setting, *numbers = map(escape, text.cells(study, one.method if not number else "", point))
            cells = "".join(f'<td class="number">{value}</td>' for value in numbers)
            rows.append(f'<tr><th scope="row">{method}</th><td>{setting}</td>{cells}</tr>')
    kinds = ["", "", *[' class="number"'] * (len(heads) - 2)]
    head = "".join(f'<th scope="col"{kind}>{escape(name)}</th>' for name, kind in zip(heads, kinds, strict=True))
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _cases(cases: list[Judged]) -> str:
    rows = []
    for one in cases:
        case, held = one.case, one.observed.held
        told = {"situation": case.situation, "claim": case.claim, "seen": one.observed.figures}
        cells = "".join(f'<td data-name="{name}" class="seen">{escape(what)}</td>' for name, what in told.items())
        outcome = escape(case.outcome) if held else f"NOT {escape(case.outcome)}"
        rows.append(
            f'<tr id="case-{escape(case.key)}"><th scope="row" class="key">{escape(case.key)}</th>'
            f'<td class="outcome {"held" if held else "broken"}">{outcome}</td>{cells}</tr>'
        )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("case", "outcome", "situation", "claim", "seen"))
    body = f'<table class="cases"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return f'<div class="wide">{body}</div>'


def _left_out(lacks: list[LeftOut]) -> str:
    rows = "".join(f"<li><b>{escape(one.key)}</b>: {escape(one.reason)}</li>" for one in lacks)
    return f"<ul>{rows}</ul>"
