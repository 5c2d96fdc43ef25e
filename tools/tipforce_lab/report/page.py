"""The report as one self-contained HTML page without script and network, with one plot per study as SVG."""

from __future__ import annotations

import base64
import hashlib
import io
import math
import re
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from html import escape
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipforce.output_file import HTML, JSON_LINES, save_figure, write_file
from tipforce_lab import plotting as figures
from tipforce_lab.report import text
from tipforce_lab.report.study import Case, Grid, Item, Report, Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write(report: Report, directory: Path, json_line: Callable[[dict[str, Any]], str]) -> list[Path]:
    """Write index.html, report.jsonl (lines by ``json_line``), a KEY.svg per study. Raises InputError, WriteError."""
    items: list[Item] = [*report.studies, *report.grids, *report.cases, *report.left_out]
    records = [text.head_record(report) | text.conclusions(report), *map(text.record, items)]
    lines = "".join(json_line(record) + "\n" for record in records)
    write_file(directory / "index.html", html(report), HTML)
    write_file(directory / "report.jsonl", lines, JSON_LINES)
    paths = [directory / f"{study.key}.svg" for study in report.studies]
    for study, path in zip(report.studies, paths, strict=True):
        with plotting():
            save_figure(figure(study), path, transparent=False, facecolor=PAPER)
    return [directory / "index.html", directory / "report.jsonl", *paths]


def style() -> str:
    """Return the style sheet of the page, with the colours of the plots for light and dark mode."""
    colours = {**COLOURS, "grid": (GRID, "#3a4046"), "band": (BAND, "#9aa3ab")}
    light, night = (
        "".join(f".f-{name}{{fill:{pair[mode]}}}.s-{name}{{stroke:{pair[mode]}}}" for name, pair in colours.items())
        for mode in (0, 1)
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
    titled: list[Study | Grid] = [*report.studies, *report.grids]
    links = [(part.key, part.title) for part in titled]
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
    run = f"<summary>Run of {escape(text.headline(report))}: machine and versions</summary><dl>{machine}</dl>"
    return [*parts, f"<nav><h2>Contents</h2><ul>{entries}</ul></nav>", f"<details>{run}", "</details>"]


def _study(study: Study) -> str:
    items, table, key = _items(text.study_items(study)), _table("points", text.study_table(study)), escape(study.key)
    points = sum(len(series.points) for series in study.series)
    parts = (
        f'<section class="study" id="{key}"><h3 id="{key}-title">{escape(study.title)}</h3>',
        f"<figure>{svg(study)}</figure>",
        f"<ul>{items}</ul>" if items else "",
        f"<details><summary>All {points} points as a table</summary>{table}</details>",
        f'<p class="reference">Reference: {escape(text.shown_reference(study))}.</p></section>',
    )
    return "\n".join(parts)


def _cases(cases: list[Case]) -> list[str]:
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
    classes = {head: ' class="number"' if kind in text.NUMBERS else "" for head, kind in table.heads.items()}
    head = "".join(f'<th scope="col"{kind}>{escape(title)}</th>' for title, kind in classes.items())
    rows = []
    for row in table.rows:
        heading, *others = (cell if isinstance(cell, text.Cell) else text.Cell(cell) for cell in row)
        shown = escape(heading.text)
        shown = f'<a href="#{escape(heading.link)}">{shown}</a>' if heading.link else shown
        cells = [f'<th scope="row">{shown}</th>']
        for title, (value, kind, note, _link) in zip(list(classes)[1:], others, strict=True):
            attributes = f' class="{kind}"' if kind else classes[title]
            attributes += f' title="{escape(note)}"' if note else ""
            cells.append(f'<td data-name="{escape(title)}"{attributes}>{escape(value)}</td>')
        row_id = "" if row_ids is None else f' id="{row_ids}{escape(heading.text)}"'
        rows.append(f"<tr{row_id}>{''.join(cells)}</tr>")
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide"><table class="{name}">{body}</table></div>'


INK, GRID, PAPER, BAND = "#222222", "#d4d4d4", "#ffffff", "#8a8a8a"
# Okabe and Ito's palette, for any colour vision; yellow is too pale on white. Each with its shade on black.
COLOURS = {
    "blue": ("#0072b2", "#4fb3f0"),
    "vermillion": ("#d55e00", "#ff8b3d"),
    "green": ("#009e73", "#2fd6a5"),
    "purple": ("#b65f97", "#e79ccb"),
    "brown": ("#8a6000", "#e6b84a"),
    "sky": ("#2f8fc4", "#9bd8ff"),
    "ink": (INK, "#e8e8e8"),
}
_HUES = tuple(light for light, _ in COLOURS.values())
_LINES = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "*", ">", "h")
CLASSES = {light: name for name, (light, _) in COLOURS.items()} | {GRID: "grid", PAPER: "paper", BAND: "band"}
"""Colour in the SVG -> class, so that the page can change it in dark mode."""
_WIDTH_INCH, _AXES_INCH, _LEGEND_LINE_INCH = 4.6, 3.6, 0.21
_ZERO_BELOW = 0.1  # an error of zero is drawn at this fraction of the smallest other
_KEPT_STYLE = {"fill", "stroke"}


_STYLE = {
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
    "font.size": 10.0, "grid.color": GRID, "grid.linewidth": 0.6, "legend.frameon": False,
    "savefig.transparent": True, "savefig.dpi": 130,
}  # fmt: skip


def plotting() -> AbstractContextManager[None]:
    """Apply the style of the report. Raises EnvironmentLackError without matplotlib, on entry."""
    return figures.plotting(_STYLE, "report")


def figure(study: Study) -> Figure:
    """Draw error against time, both logarithmic, with quartiles, the error of the reference, and a legend below."""
    errors = [error for series in study.series for point in series.points for error in (point.error, point.rms_error)]
    floor = _ZERO_BELOW * min((error for error in errors if error and math.isfinite(error)), default=1.0)
    lines = len(study.series) + 1  # and the band
    drawn = figures.new_figure(_WIDTH_INCH, _AXES_INCH + _LEGEND_LINE_INCH * lines)
    axes, unit = drawn.subplots(), study.error_unit
    if len(unit) >= 46:  # longer than the axis: two lines
        middle = min((match.start() for match in re.finditer(" ", unit)), key=lambda at: abs(at - len(unit) / 2))
        unit = f"{unit[:middle]}\n{unit[middle + 1 :]}"
    axes.set(xscale="log", yscale="log", xlabel=f"processor time, {study.work_unit}", ylabel=unit)
    for number in range(len(study.series)):
        _draw_series(axes, study, number, floor)
    _frame(axes, study, floor if 0.0 in errors else None)
    drawn.legend(loc="outside lower left", ncols=1, fontsize=9.5, handlelength=3.2, labelspacing=0.35)
    return drawn


def _draw_series(axes: Axes, study: Study, number: int, floor: float) -> None:
    series = study.series[number]
    colour = _HUES[number % len(_HUES)]
    points = [(point, point.timing.work_seconds) for point in series.points]
    for point, at_s in points:
        if not math.isfinite(point.error):
            axes.plot([at_s], [0.98], "^", color=colour, markersize=6, transform=axes.get_xaxis_transform())
    drawn = [(point, at_s) for point, at_s in points if math.isfinite(point.error)]
    spread = [
        [max(at_s - point.timing.first_quartile_s, 0.0) for point, at_s in drawn],
        [max(point.timing.third_quartile_s - at_s, 0.0) for point, at_s in drawn],
    ]
    axes.errorbar(
        [at_s for _, at_s in drawn], [max(point.error, floor) for point, _ in drawn], xerr=spread, color=colour,
        linestyle=_LINES[(number + 2 * (number // len(_HUES))) % len(_LINES)], marker=_MARKERS[number % len(_MARKERS)],
        markersize=5, linewidth=1.3, elinewidth=1.0, capsize=2.5, label=series.method,
    )  # fmt: skip
    for point, at_s in drawn:
        if point.rms_error:
            down = [point.rms_error, max(point.error, floor)]
            axes.plot([at_s] * 2, down, color=colour, linewidth=0.8, linestyle=":")
            axes.plot([at_s], [point.rms_error], "_", color=colour, markersize=5)


def _frame(axes: Axes, study: Study, zero: float | None) -> None:
    """Show at least two decades on each axis, a band up to the reference's error if near, and a line for zero."""
    for (low, high), set_limits in ((axes.get_xlim(), axes.set_xlim), (axes.get_ylim(), axes.set_ylim)):
        short = 2.0 - math.log10(high / low)
        if short > 0.0:
            set_limits(low * 10 ** (-short / 2), high * 10 ** (short / 2))
    own, (low, high) = study.reference_error, axes.get_ylim()
    if own >= low / 1e3:
        bottom = min(low, own / 3.0)
        axes.axhspan(bottom / 10.0, own, color=BAND, alpha=0.35, linewidth=0, label="error of the reference")
        axes.set_ylim(bottom, high)
    if zero is not None:
        axes.axhline(zero, color=BAND, linewidth=0.8)
        axes.annotate("0", (1.0, zero), xycoords=("axes fraction", "data"), fontsize=8, va="bottom", ha="right")


def svg(study: Study) -> str:
    """Return the plot as an <svg> element; identifiers contain the key, attributes replace styles (a strict CSP)."""
    with plotting():
        drawn, out, key = figure(study), io.StringIO(), study.key
        drawn.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = out.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", text[text.index("<svg") :], flags=re.S)
    head, body = text.split(">", 1)
    (box,) = re.findall(r'viewBox="[^"]*"', head)
    body = re.sub(r'\sstyle="([^"]*)"', _attributes, body).replace("xlink:href=", "href=")
    for pattern, renamed in ((r'id="([^"]*)"', rf'id="{key}-\1"'), (r'href="#([^"]*)"', rf'href="#{key}-\1"'),
                             (r"url\(#([^)]*)\)", rf"url(#{key}-\1)"), (r"\n\s*", "\n")):  # fmt: skip
        body = re.sub(pattern, renamed, body)
    return f'<svg {box} role="img" aria-labelledby="{key}-title">{body}'


def _attributes(style: re.Match[str]) -> str:
    """Convert `style="fill: #abc; stroke-width: 2"` to presentation attributes, with a class for each known colour."""
    attributes: dict[str, str] = {}
    classes: list[str] = []
    for declaration in style[1].split(";"):
        name, _, value = (part.strip() for part in declaration.partition(":"))
        if name == "font":  # "9px 'DejaVu Sans', sans-serif": the family is the page's
            size = re.search(r"([\d.]+)px", value)
            attributes["font-size"] = size[1] if size else "9"
        elif name in _KEPT_STYLE and value in CLASSES:
            attributes[name] = value
            classes.append(f"{name[0]}-{CLASSES[value]}")
        elif name:
            attributes[name] = value
    if "text-anchor" in attributes or "font-size" in attributes:
        classes.append("label")
    shown = "".join(f' {name}="{value}"' for name, value in attributes.items())
    return shown + (f' class="{" ".join(classes)}"' if classes else "")
