"""The figures of `tipforce design`. Deterministic: the same numbers and matplotlib give the same bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tipforce.output_file import make_folder, save_figure
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import LAYOUTS
from tipforce.sensor.structure.off_axis import apparent_force, off_axis_wrenches
from tipforce.sensor.structure.published import CALIBRATION_WEIGHT_NEWTONS, CASES
from tipforce_lab.design.groove_errors import simulate_groove_errors
from tipforce_lab.design.ranking import ranked_layouts
from tipforce_lab.design.section import Section
from tipforce_lab.design.shift_study import condition_against_shift
from tipforce_lab.plotting import new_figure, plotting

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, for any colour vision. Line style or marker differ too, for black and white.
BLUE, VERMILLION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"
STYLE = {
    "font.size": 9.0,
    "grid.color": "#dddddd",
    "legend.edgecolor": "none",
    "legend.framealpha": 1.0,
    "savefig.dpi": 150,
}
STYLES = ((BLUE, "-", "o"), (VERMILLION, "--", "s"), (GREEN, "-.", "^"), (GREY, ":", "D"))


def draw(what: str, directory: Path, kind: str, noise: float, repeats: int, seed: int) -> Iterator[Path]:
    """Draw the sections of `design table` named ``what``, or "all"; yield each path after writing it.

    kind: svg or png. noise (microstrain), repeats, seed: of figure 9. Raises EnvironmentLackError without matplotlib,
    InputError if the directory cannot be written.
    """
    from tipforce_lab.design.drawing import cross_section, groove_directions

    makers: dict[str, list[tuple[str, Callable[[], Figure]]]] = {
        "1": [("cross-section", cross_section)],
        "2": [],
        "3": [("condition-and-noise", condition_and_noise)],
        "fig6": [("figure-6", figure_6)],
        "fig9": [("grooves", groove_directions), ("figure-9", lambda: figure_9(noise, repeats, seed))],
        "off-axis": [("off-axis", off_axis)],
    }
    make_folder(directory)
    for name in makers if what == "all" else (what,):
        for stem, make in makers[name]:
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
        found = condition_against_shift(FABRICATED, case, shifts_mm * 1e-3)
        for index, (colour, line, marker) in enumerate(STYLES):
            label = f"SG{index + 1} (at {LAYOUTS[case][index].removesuffix('_H')})" if index < 3 else "all three"
            axes.plot(
                shifts_mm,
                found[index],
                color=colour,
                linestyle=line,
                marker=marker,
                markevery=10,
                markersize=4,
                label=label,
            )
        axes.axvline(0.5, color=GREY, linewidth=0.8)
        axes.annotate("middle of a 1 mm gauge\nthat begins at the corner", (0.55, 2.05), fontsize=7, color=GREY)
        axes.set(title=f"case {case}", xlabel="shift inward along the beam (mm)", xlim=(0, 5), ylim=(2, 5))
        axes.legend(fontsize=7.5, loc="upper left", title="moved gauge", title_fontsize=7.5)
    panels[0].set_ylabel("condition number")
    return figure


def figure_9(noise_ue: float, repeats: int, seed: int) -> Figure:
    """Draw errors of P, phi, theta at the grooves: one simulated run as points, 95 % bands of first order."""
    found = simulate_groove_errors(FABRICATED, "I", noise_ue * 1e-6, repeats=repeats, seed=seed)
    figure = new_figure(8.4, 3.2)
    theta = np.degrees(found.grooves.theta_rad)
    scale = (1.0, 180.0 / np.pi, 180.0 / np.pi)
    labels = ("error of P (N)", "error of phi (degrees)", "error of theta (degrees)")
    right, along_x = theta < 90.0, found.grooves.along_x
    kinds = (
        (along_x & right, "x-grooves", BLUE, "o"),
        (along_x & ~right, "", BLUE, "o"),
        (~along_x, "y-grooves", VERMILLION, "s"),
    )
    for index, axes in enumerate(figure.subplots(1, 3)):
        for chosen, name, colour, marker in kinds:
            order = np.flatnonzero(chosen)
            band = 1.96 * scale[index] * found.standard_uncertainties[order, index]
            axes.fill_between(
                theta[order], -band, band, color=colour, alpha=0.2, linewidth=0, label=name and f"95 %, {name}"
            )
            for run in range(min(3, repeats)):
                axes.plot(
                    theta[order],
                    scale[index] * found.errors[run, order, index],
                    marker,
                    color=colour,
                    markersize=3.5,
                    markerfacecolor=colour if run == 0 else "none",
                    label=f"{name}, 3 runs" if name and run == 0 else "",
                )
        axes.axvline(90.0, color=GREY, linewidth=0.8)
        axes.set(xlabel="contact angle theta (degrees)", ylabel=labels[index], xticks=range(0, 181, 45))
        low, high = axes.get_ylim()
        axes.set_ylim(1.25 * min(low, -high), 1.25 * max(high, -low))
        axes.text(88, axes.get_ylim()[0] * 0.97, "calibrated", ha="right", fontsize=7, color=GREY)
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=4,
        fontsize=8,
        title=f"case I, {CALIBRATION_WEIGHT_NEWTONS:g} N, gauge noise {noise_ue:g} microstrain",
    )
    return figure


def condition_and_noise() -> Figure:
    """Draw all regular layouts of three points: condition number against noise gain."""
    figure = new_figure(5.6, 3.8)
    axes = figure.subplots()
    rows = [row for row in ranked_layouts(FABRICATED) if row.condition < 20.0]
    axes.loglog(
        [1e-6 * row.noise for row in rows],
        [row.condition for row in rows],
        "o",
        color=GREY,
        markersize=4,
        label="other layouts (mirrors coincide)",
    )
    for row in rows:
        if row.case:
            colour, _, marker = STYLES[CASES.index(row.case)]
            axes.plot(1e-6 * row.noise, row.condition, marker, color=colour, markersize=8, label=f"case {row.case}")
    axes.annotate(
        "L, T, S_H (2.622)",
        (1e-6 * rows[2].noise, rows[2].condition),
        (10, -14),
        textcoords="offset points",
        arrowprops={"arrowstyle": "-", "color": GREY},
        fontsize=8,
    )
    axes.annotate(
        "L or R, with T or U and K_V or S_V",
        (1e-6 * rows[4].noise, rows[4].condition),
        (12, -6),
        textcoords="offset points",
        fontsize=8,
    )
    axes.set(
        xlabel="noise gain sqrt(trace(C C^T))  (N per microstrain)",
        ylabel="condition number",
        xticks=(0.015, 0.02, 0.03, 0.04),
        xticklabels=("0.015", "0.02", "0.03", "0.04"),
        yticks=(2.5, 3, 4, 6, 9),
        yticklabels=("2.5", "3", "4", "6", "9"),
    )
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
        for case, (colour, _, marker) in zip(CASES, STYLES, strict=False):
            for held in (True, False):
                found = [_apparent(case, loads, held, {key: unit * value}) for value in values.tolist()]
                axes.plot(
                    values,
                    found,
                    color=colour,
                    linestyle="-" if held else ":",
                    marker=marker,
                    markersize=4,
                    label=f"case {case}, warping {'held' if held else 'free'}",
                )
        axes.set(ylim=(0, None), ylabel="apparent |F| (N per N along z)")
    left.set_xlabel("lateral offset of every gauge (mm)")
    right.set_xlabel("misalignment of every gauge (degrees)")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8)
    return figure


def draw_sweep(path: Path, section: Section) -> None:
    """Draw a sweep: condition number and noise gain, one above the other. Raises as draw() does."""
    with plotting(STYLE):
        figure = new_figure(5.6, 4.6)
        name, *_ = section.columns
        values = [record[name] for record in section.records]
        keys = ("condition", "noise_gain_N_per_ue")
        panels: list[Axes] = list(figure.subplots(2, 1, sharex=True))
        for axes, key, (colour, line, _) in zip(panels, keys, STYLES, strict=False):
            axes.plot(values, [record[key] for record in section.records], color=colour, linestyle=line)
            axes.set_ylabel(section.columns[key])
        panels[0].set_title(section.title)
        panels[1].set_xlabel(section.columns[name])
        save_figure(figure, path)


def _apparent(case: str, loads: np.ndarray, held: bool, placement: dict[str, float]) -> float:
    return apparent_force(FABRICATED, case, loads, warping_held=held, **placement).norm_newtons
