"""The figures of `tipforce design`, reproducible to the byte. Assumed, as the paper's text does not define figure 2:
the tip is a half disc with legs to the ends of the horizontal beam, the fixture a block."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.output_file import make_folder, save_figure
from tipforce.sensor import FABRICATED, Geometry, apparent_force, off_axis_wrenches
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.structure.layouts import CALIBRATION_WEIGHT_NEWTONS, CASES, GAUGE_LENGTH_M, LAYOUTS, POINTS
from tipforce.sensor.structure.strain import nominal_position
from tipforce_lab.design.sections import condition_against_shift, simulate_groove_errors
from tipforce_lab.design.tables import MM, Section, ranked_layouts
from tipforce_lab.plotting import new_figure, plotting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, for any colour vision. Line style or marker differ too, for black and white.
BLUE, VERMILLION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"
STYLE = {
    "font.size": 9.0, "grid.color": "#dddddd", "legend.edgecolor": "none", "legend.framealpha": 1.0, "savefig.dpi": 150,
}  # fmt: skip
STYLES: tuple[dict[str, Any], ...] = tuple(
    {"color": colour, "linestyle": line, "marker": marker}
    for colour, line, marker in ((BLUE, "-", "o"), (VERMILLION, "--", "s"), (GREEN, "-.", "^"), (GREY, ":", "D"))
)


def draw(what: str, directory: Path, kind: str, noise: float, repeats: int, seed: int) -> Iterator[Path]:
    """Draw the sections of `design table` named ``what``, or "all", as svg or png; yield each path. noise
    (microstrain), repeats, seed: of figure 9. Raises EnvironmentLackError, InputError for the directory."""

    makers: dict[str, list[tuple[str, Callable[[], Figure]]]] = {
        "1": [("cross-section", cross_section)],
        "3": [("condition-and-noise", condition_and_noise)],
        "fig6": [("figure-6", figure_6)],
        "fig9": [("grooves", groove_directions), ("figure-9", lambda: figure_9(noise, repeats, seed))],
        "off-axis": [("off-axis", off_axis)],
    }
    make_folder(directory)
    for name in makers if what == "all" else (what,):
        for stem, make in makers.get(name, ()):
            path = directory / f"{stem}.{kind}"
            with plotting(STYLE):
                save_figure(make(), path)
            yield path


def figure_6() -> Figure:
    """Draw condition number against gauge shift, one panel per case."""
    figure = new_figure(8.4, 3.2)
    panels = figure.subplots(1, 3, sharey=True)
    shifts_mm = np.linspace(0.0, 5.0, 51)
    for case, axes in zip(CASES, panels, strict=True):
        conditions = condition_against_shift(FABRICATED, case, shifts_mm * 1e-3)
        labels = [f"SG{k} (at {point.removesuffix('_H')})" for k, point in enumerate(LAYOUTS[case], 1)]
        for condition, style, label in zip(conditions, STYLES, [*labels, "all three"], strict=True):
            axes.plot(shifts_mm, condition, **style, markevery=10, markersize=4, label=label)
        axes.axvline(0.5, color=GREY, linewidth=0.8)
        axes.annotate("middle of a 1 mm gauge\nthat begins at the corner", (0.55, 2.05), fontsize=7, color=GREY)
        axes.set(title=f"case {case}", xlabel="shift inward along the beam (mm)", xlim=(0, 5), ylim=(2, 5))
        axes.legend(fontsize=7.5, loc="upper left", title="moved gauge", title_fontsize=7.5)
    panels[0].set_ylabel("condition number")
    return figure


def figure_9(noise_ue: float, repeats: int, seed: int) -> Figure:
    """Draw errors of P, phi, theta at the grooves: one simulated run as points, 95 % bands of first order."""
    simulated = simulate_groove_errors(FABRICATED, "I", noise_ue * 1e-6, repeats=repeats, seed=seed)
    figure = new_figure(8.4, 3.2)
    theta = np.degrees(simulated.grooves.theta_rad)
    scale = (1.0, 180.0 / np.pi, 180.0 / np.pi)
    labels = ("error of P (N)", "error of phi (degrees)", "error of theta (degrees)")
    right, along_x = theta < 90.0, simulated.grooves.along_x
    kinds = ((along_x & right, "x-grooves", BLUE, "o"), (along_x & ~right, "", BLUE, "o"),
             (~along_x, "y-grooves", VERMILLION, "s"))  # fmt: skip
    for index, axes in enumerate(figure.subplots(1, 3)):
        for chosen, name, colour, marker in kinds:
            order = np.flatnonzero(chosen)
            band = 1.96 * scale[index] * simulated.standard_uncertainties[order, index]
            label = name and f"95 %, {name}"
            axes.fill_between(theta[order], -band, band, color=colour, alpha=0.2, linewidth=0, label=label)
            for run, errors in enumerate(scale[index] * simulated.errors[:3, order, index]):
                label = f"{name}, 3 runs" if name and run == 0 else ""
                style = {"color": colour, "markersize": 3.5, "markerfacecolor": "none" if run else colour}
                axes.plot(theta[order], errors, marker, **style, label=label)
        axes.axvline(90.0, color=GREY, linewidth=0.8)
        axes.set(xlabel="contact angle theta (degrees)", ylabel=labels[index], xticks=range(0, 181, 45))
        low, high = axes.get_ylim()
        axes.set_ylim(1.25 * min(low, -high), 1.25 * max(high, -low))
        axes.text(88, axes.get_ylim()[0] * 0.97, "calibrated", ha="right", fontsize=7, color=GREY)
    title = f"case I, {CALIBRATION_WEIGHT_NEWTONS:g} N, gauge noise {noise_ue:g} microstrain"
    _legend_above(figure, axes, 4, title=title)
    return figure


def condition_and_noise() -> Figure:
    """Draw all regular layouts of three points: condition number against noise gain."""
    figure = new_figure(5.6, 3.8)
    axes = figure.subplots()
    rows = [row for row in ranked_layouts(FABRICATED) if row["condition"] < 20.0]
    noise, condition = ([row[key] for row in rows] for key in ("noise_gain_N_per_ue", "condition"))
    axes.loglog(noise, condition, "o", color=GREY, markersize=4, label="other layouts (mirrors coincide)")
    for x, y, row in zip(noise, condition, rows, strict=True):
        if row["case"]:
            style = STYLES[CASES.index(row["case"])] | {"linestyle": "None"}
            axes.plot(x, y, **style, markersize=8, label=f"case {row['case']}")
    line: dict[str, Any] = {"arrowprops": {"arrowstyle": "-", "color": GREY}}
    for at, text, offset, more in (
        (2, "L, T, S_H (2.622)", (10, -14), line),
        (4, "L or R, with T or U and K_V or S_V", (12, -6), {}),
    ):
        axes.annotate(text, (noise[at], condition[at]), offset, textcoords="offset points", fontsize=8, **more)
    axes.set(xlabel="noise gain sqrt(trace(C C^T))  (N per microstrain)", ylabel="condition number")
    for set_ticks, ticks in ((axes.set_xticks, (0.015, 0.02, 0.03, 0.04)), (axes.set_yticks, (2.5, 3, 4, 6, 9))):
        set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.legend(loc="upper left")
    return figure


def off_axis() -> Figure:
    """Draw the apparent force per newton along z against lateral offset and misalignment of the gauges."""
    figure = new_figure(8.4, 3.4)
    left, right = figure.subplots(1, 2)
    loads = off_axis_wrenches(FABRICATED, np.radians(np.arange(0.0, 181.0, 5.0)))
    for axes, key, unit, values in (
        (left, "lateral_offset_m", 1e-3, np.linspace(0.0, 1.0, 6)),
        (right, "misalignment_rad", np.pi / 180.0, np.linspace(0.0, 5.0, 6)),
    ):
        for case, held in itertools.product(CASES, (True, False)):
            apparent = [
                apparent_force(FABRICATED, case, loads, warping_held=held, **{key: unit * value}).norm_newtons
                for value in values.tolist()
            ]
            style = STYLES[CASES.index(case)] | {"linestyle": "-" if held else ":"}
            label = f"case {case}, warping {'held' if held else 'free'}"
            axes.plot(values, apparent, **style, markersize=4, label=label)
        axes.set(ylim=(0, None), ylabel="apparent |F| (N per N along z)")
    left.set_xlabel("lateral offset of every gauge (mm)")
    right.set_xlabel("misalignment of every gauge (degrees)")
    _legend_above(figure, left, 3)
    return figure


def _legend_above(figure: Figure, axes: Axes, columns: int, **options: Any) -> None:
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=columns, fontsize=8, **options)


def draw_sweep(path: Path, section: Section) -> None:
    """Draw a sweep: condition number and noise gain, one above the other. Raises as draw() does."""
    with plotting(STYLE):
        figure = new_figure(5.6, 4.6)
        name, *_ = section.columns
        values = [record[name] for record in section.records]
        keys = ("condition", "noise_gain_N_per_ue")
        panels: list[Axes] = list(figure.subplots(2, 1, sharex=True))
        for axes, key, style in zip(panels, keys, STYLES, strict=False):
            axes.plot(values, [record[key] for record in section.records], **style | {"marker": ""})
            axes.set_ylabel(section.columns[key])
        panels[0].set_title(section.title)
        panels[1].set_xlabel(section.columns[name])
        save_figure(figure, path)


LEG_MM, LEG_TOP_MM, SLIT_MM = 2.0, 2.5, 0.25
"""Legs: assumed, outside of a because a = r leaves no space for them. The slit is the paper's cutting line."""
BODY, BEAM = "#d9d9d9", "#8c8c8c"
Place = FloatArray | tuple[float, float]


def cross_section() -> Figure:
    """Draw the body to scale with the gauge points, and the sign conventions of load and angles."""
    figure = new_figure(8.4, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    _without_scales(left, right)
    _body(left, FABRICATED)
    _gauge_points(left, FABRICATED)
    _dimensions(left, FABRICATED)
    _load_signs(right, FABRICATED)
    return figure


def groove_directions() -> Figure:
    """Draw the 19 grooves: the contact of the rope and its direction."""
    figure = new_figure(6.2, 3.4)
    axes = figure.subplots()
    _without_scales(axes)
    _tip(axes, FABRICATED)
    grooves, r = paper_grooves(), FABRICATED.r_m * MM
    for theta, phi, along_x in zip(grooves.theta_rad, grooves.phi_rad, grooves.along_x, strict=True):
        x, y = r * np.cos(theta), r * np.sin(theta)
        colour = BLUE if along_x else VERMILLION
        _arrow(axes, (x, y), (x + 5.0 * np.cos(phi), y + 5.0 * np.sin(phi)), color=colour)
        axes.plot(x, y, "o" if along_x else "s", color=colour, markersize=3.5)
        inner = 0.87 if along_x else 0.74
        axes.text(inner * x, inner * y, f"{np.degrees(theta):.0f}", color=colour, fontsize=7, ha="center", va="center")
    axes.text(r + 6.0, 15.0, "y-grooves pull\nat phi = 90", color=VERMILLION, fontsize=8)
    axes.text(r + 6.0, 4.0, "x-grooves pull\nat phi = 0", color=BLUE, fontsize=8)
    axes.text(-r - 6.0, 4.0, "x-grooves pull\nat phi = 180", color=BLUE, fontsize=8, ha="right")
    axes.text(0, 1.0, "numbers: theta in degrees", fontsize=7.5, color=GREY, ha="center")
    axes.set(xlim=(-r - 15, r + 15), ylim=(-1, r + 7))
    return figure


def _without_scales(*panels: Axes) -> None:
    for axes in panels:
        axes.set_aspect("equal")
        axes.axis("off")


def _tip(axes: Axes, geometry: Geometry) -> None:
    angle = np.linspace(0.0, np.pi, 91)
    r = geometry.r_m * MM
    axes.fill(r * np.cos(angle), r * np.sin(angle), facecolor=BODY, edgecolor=GREY, linewidth=0.8)


def _body(axes: Axes, geometry: Geometry) -> None:
    a, d, r, h1, h2 = (MM * value for value in (geometry.a_m, geometry.d_m, geometry.r_m, geometry.h1_m, geometry.h2_m))
    slit, bottom = 0.5 * h1 + SLIT_MM, -0.5 * h1 - d
    start = np.arcsin(LEG_TOP_MM / r)
    arc = np.linspace(start, np.pi - start, 91)
    right = [(a, slit), (a, -0.5 * h1), (a + LEG_MM, -0.5 * h1), (a + LEG_MM, LEG_TOP_MM)]
    outline = [*right, *zip(r * np.cos(arc), r * np.sin(arc), strict=True), *((-x, y) for x, y in reversed(right))]
    axes.fill(*zip(*outline, strict=True), facecolor=BODY, edgecolor=GREY, linewidth=0.8)
    for left, low, width, height, colour in (
        (-a, -0.5 * h1, 2.0 * a, h1, BEAM),
        (-0.5 * h2, bottom, h2, d, BEAM),
        (-9.0, bottom - 4.0, 18.0, 4.0, BODY),
    ):
        corners_x, corners_y = [left, left + width, left + width, left], [low, low, low + height, low + height]
        axes.fill(corners_x, corners_y, facecolor=colour, edgecolor=GREY, linewidth=0.5)
    axes.text(0.0, 0.62 * r, "tip (rigid)", ha="center")
    axes.text(0.0, bottom - 5.6, "orange: gauges of the cases I, II, III", color=VERMILLION, fontsize=8, ha="center")
    axes.text(0.0, bottom - 2.0, "fixture (rigid)", ha="center", va="center")
    axes.set(xlim=(-a - 5.0, a + 5.0), ylim=(bottom - 6.5, r + 2.0))


def _gauge_points(axes: Axes, geometry: Geometry) -> None:
    """Draw the gauges as bars of their length, from the fixed end, with the names of their points."""
    half_h1, half_h2, length = 0.5 * geometry.h1_m * MM, 0.5 * geometry.h2_m * MM, GAUGE_LENGTH_M * MM
    cases = {point: case for case in ("III", "II", "I") for point in LAYOUTS[case]}
    for point in POINTS:
        place = nominal_position(geometry, point)
        sign = -1.0 if place.side == "left" else 1.0
        at_joint = place.position_m == 0.0
        along = (0.0, length) if at_joint else (place.position_m * MM - length, place.position_m * MM)
        colour = VERMILLION if point in cases else BLUE
        if place.beam == "H":
            # Drawn beside the vertical beam; the beam model measures from its axis.
            shift = half_h2 if at_joint else 0.0
            xs, ys = [sign * (shift + s) for s in along], [-half_h1 - 0.25] * 2
            label = (sign * 4.5, -3.2) if at_joint else (sign * 12.0, -3.2)
        else:
            xs, ys = [sign * (half_h2 + 0.25)] * 2, [-half_h1 - s for s in along]
            label = (sign * 5.5, -6.2) if at_joint else (sign * 4.5, ys[1] + 1.5)
        axes.plot(xs, ys, color=colour, linewidth=2.6, solid_capstyle="butt")
        line = {"arrowstyle": "-", "color": colour, "linewidth": 0.7, "shrinkB": 2}
        style: dict[str, Any] = {"ha": "center", "va": "center", "color": colour, "fontsize": 9, "arrowprops": line}
        axes.annotate(point, (sum(xs) / 2.0, sum(ys) / 2.0), label, **style)


def _dimensions(axes: Axes, geometry: Geometry) -> None:
    a, d, r, h1, h2 = (MM * value for value in (geometry.a_m, geometry.d_m, geometry.r_m, geometry.h1_m, geometry.h2_m))
    radius = r * np.cos(np.radians(125.0)), r * np.sin(np.radians(125.0))
    for start, end, arrow, at, text, side in (
        ((a, 2.2), (0.0, 2.2), "<->", (0.5 * a, 2.6), f"a = {a:g}", "center"),
        ((-9.5, -0.5 * h1 - d), (-9.5, -0.5 * h1), "<->", (-9.9, -0.5 * d), f"d = {d:g}", "right"),
        (radius, (0.0, 0.0), "<-", (-6.6, 7.6), f"r = {r:g}", "right"),
    ):
        _arrow(axes, start, end, arrow, color="black", linewidth=0.8)
        axes.text(*at, text, ha=side, fontsize=8)
    others = f"h1 = {h1:g}\nh2 = {h2:g}\nwidth = {geometry.width_m * MM:g}\n(mm)"
    axes.text(a + 4.8, -8.4, others, ha="right", fontsize=8)


def _load_signs(axes: Axes, geometry: Geometry) -> None:
    """Draw one force vector and the two contacts that give the same F: a rope that pulls, a body that pushes."""
    r = geometry.r_m * MM
    _tip(axes, geometry)
    theta, phi = np.radians(50.0), np.radians(15.0)
    direction = np.array([np.cos(phi), np.sin(phi)])
    pull = r * np.array([np.cos(theta), np.sin(theta)])
    push = pull - 2.0 * (pull @ direction) * direction
    axes.plot(*zip(push, pull, strict=True), color="black", linewidth=0.8, linestyle=":")
    up = 8.0 * direction
    _arrow(axes, pull, pull + up, color=VERMILLION, linewidth=1.8)
    _arrow(axes, push - up, push, color=BLUE, linewidth=1.8)
    _label(axes, pull + up + np.array([-1.0, 1.2]), "P: a rope\npulls here", VERMILLION, va="bottom")
    _label(axes, push - up + np.array([1.0, 2.6]), "the same F:\na contact\npushes here", BLUE, va="bottom")
    for end, name in ((np.array([r + 4.0, 0.0]), "x"), (np.array([0.0, r + 4.0]), "y")):
        _arrow(axes, np.zeros(2), end, color="black", linewidth=0.8)
        _label(axes, end * (1.0 + 1.0 / (r + 4.0)), name, "black")
    axes.plot(*zip(np.zeros(2), pull, strict=True), color="black", linewidth=0.8, linestyle="-")
    axes.plot(*zip(pull, pull + np.array([7.0, 0.0]), strict=True), color="black", linewidth=0.8, linestyle=":")
    for centre, radius, angle in ((np.zeros(2), 5.0, theta), (pull, 6.0, phi)):
        arc = np.linspace(0.0, angle, 31)
        axes.plot(centre[0] + radius * np.cos(arc), centre[1] + radius * np.sin(arc), color=GREEN, linewidth=1.2)
    _label(axes, (5.4, 2.0), "theta", GREEN, ha="left")
    _label(axes, pull + np.array([6.4, -1.0]), "phi", GREEN, ha="left")
    _label(axes, (0.0, -3.0), "angles from the x-axis; tension is positive on every gauge", GREY, va="baseline")
    axes.set(xlim=(-r - 11.0, r + 8.0), ylim=(-6.0, r + 7.0))


def _arrow(axes: Axes, start: Place, end: Place, arrow: str = "->", **line: Any) -> None:
    style = {"arrowstyle": arrow, **line, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (float(end[0]), float(end[1])), (float(start[0]), float(start[1])), arrowprops=style)


def _label(axes: Axes, at: Place, text: str, colour: str, **where: str) -> None:
    alignment: Any = {"ha": "center", "va": "center"} | where
    axes.text(float(at[0]), float(at[1]), text, color=colour, fontsize=8.5, **alignment)
