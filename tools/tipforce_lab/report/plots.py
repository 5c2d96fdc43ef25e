"""One work-precision plot per study, as SVG to embed in an HTML page: no script, no style, no URL."""

from __future__ import annotations

import io
import math
import re
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.output_file import save_figure
from tipforce_lab import plotting as figures
from tipforce_lab.report.study import Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    from matplotlib.figure import Figure

    errors = [error for series in study.series for point in series.points for error in (point.error, point.rms_error)]
    floor = _ZERO_BELOW * min((error for error in errors if error and math.isfinite(error)), default=1.0)
    lines = len(study.series) + 1  # and the band
    drawn = Figure(figsize=(_WIDTH_INCH, _AXES_INCH + _LEGEND_LINE_INCH * lines))
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
        if point.rms_error is not None and point.rms_error > 0.0:
            axes.plot(
                [at_s] * 2, [point.rms_error, max(point.error, floor)], color=colour, linewidth=0.8, linestyle=":"
            )
            axes.plot([at_s], [point.rms_error], "_", color=colour, markersize=5)


def _frame(axes: Axes, study: Study, zero: float | None) -> None:
    """Show at least two decades on each axis, because a shorter log axis has almost no labels; a band up to the error
    of the reference, unless that is too far below the points; and a line for errors of zero, if there are any."""
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
    """Return the plot as an <svg> element without file header; identifiers contain the study's key, so that a page can
    hold many, and attributes replace styles, which a strict CSP forbids."""
    with plotting():
        drawn, out, key = figure(study), io.StringIO(), study.key
        drawn.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = out.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", text[text.index("<svg") :], flags=re.S)
    head, body = text.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    assert box is not None
    body = re.sub(r'\sstyle="([^"]*)"', _attributes, body).replace("xlink:href=", "href=")
    for pattern, renamed in ((r'id="([^"]*)"', rf'id="{key}-\1"'), (r'href="#([^"]*)"', rf'href="#{key}-\1"'),
                             (r"url\(#([^)]*)\)", rf"url(#{key}-\1)"), (r"\n\s*", "\n")):  # fmt: skip
        body = re.sub(pattern, renamed, body)
    return f'<svg {box[0]} role="img" aria-labelledby="{key}-title">{body}'


def save(study: Study, path: Path) -> None:
    """Write the plot to a file, .svg or .png. Raises InputError if it cannot be written."""
    with plotting():
        save_figure(figure(study), path, transparent=False, facecolor=PAPER)


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
