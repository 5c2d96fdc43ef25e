"""The figures of docs/finite-elements.md: the outline with its mesh, and error against run time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from bench.fem.studies import Convergence

from tipforce.sensor.structure.published import GAUGE_LENGTH_M
from tipforce_lab.fem.gauges import nearest_place
from tipforce_lab.fem.mesh import Resolution, Triangles, triangulate
from tipforce_lab.fem.outline import STATED, Outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]
MM = 1e3
ORANGE, BLUE, GREY = "#d55e00", "#0072b2", "#666666"


def outline_figure(outline: Outline = STATED) -> Figure:
    """The body as it is meshed, and a corner of the graded mesh in three steps of magnification."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    whole, joint, slit, foot = figure.subplot_mosaic(
        [["a", "b"], ["a", "c"], ["a", "d"]], width_ratios=(2.3, 1.0)
    ).values()
    mesh = triangulate(outline, Resolution(2))
    _draw(whole, mesh, 0.25)
    _gauges(whole, outline)
    whole.set(xlim=(-21.0, 21.0), ylim=(-21.5, 19.0), title="the stated outline, mesh n = 2 (mm)")
    g, fine = outline.geometry, triangulate(outline, Resolution(3))
    half_h1, half_h2 = 0.5 * g.h1_m * MM, 0.5 * g.h2_m * MM
    views: list[tuple[Axes, float, float, str]] = [
        (joint, half_h2, -half_h1, "joint, corner S, n = 3"),
        (slit, g.a_m * MM, 0.5 * (half_h1 + outline.tip_bottom_m * MM), "end of the slit"),
        (foot, half_h2, outline.foot_m * MM, "foot, corner U"),
    ]
    for axes, x, y, title in views:
        _draw(axes, fine, 0.25)
        axes.set(xlim=(x - 0.75, x + 0.75), ylim=(y - 0.45, y + 0.45))
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=7)
    _dimensions(whole, outline)
    return figure


def _draw(axes: Axes, mesh: Triangles, width: float) -> None:
    from matplotlib.tri import Triangulation

    x, y = mesh.points_m * MM
    axes.set_aspect("equal")
    triangles = Triangulation(x, y, mesh.corners.T)
    axes.tripcolor(triangles, np.ones(mesh.corners.shape[1]), cmap="Greys", vmin=0.0, vmax=6.0)
    axes.triplot(triangles, color=GREY, linewidth=width)


def _gauges(axes: Axes, outline: Outline) -> None:
    g, half = outline.geometry, 0.5 * GAUGE_LENGTH_M
    for point, shift in (("L", (0, -2)), ("R", (0, -2)), ("K_H", (-2, -2)), ("S_H", (2, -2)), ("U", (2.2, 0.8))):
        place = nearest_place(outline, point)
        sign = -1.0 if place.side == "left" else 1.0
        ends = np.array([place.position_m - half, place.position_m + half])
        if place.beam == "H":
            x, y = sign * ends * MM, np.full(2, -0.5 * g.h1_m - 0.2e-3) * MM
        else:
            x, y = np.full(2, sign * (0.5 * g.h2_m + 0.2e-3)) * MM, (-0.5 * g.h1_m - ends) * MM
        axes.plot(x, y, color=ORANGE, linewidth=3, solid_capstyle="butt")
        axes.text(float(x.mean()) + shift[0], float(y.mean()) + shift[1], point, color=ORANGE, ha="center", fontsize=9)


def _dimensions(axes: Axes, outline: Outline) -> None:
    g = outline.geometry
    style: dict[str, Any] = {"arrowstyle": "<->", "color": BLUE, "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0}
    a, leg, bottom = g.a_m * MM, outline.leg_m * MM, (outline.foot_m - outline.fixture_depth_m) * MM
    axes.annotate("", (0.0, -5.0), (a, -5.0), arrowprops=style)
    axes.text(0.55 * a, -4.7, f"a = {a:g}", color=BLUE, fontsize=8)
    axes.annotate("", (a, -2.0), (a + leg, -2.0), arrowprops=style)
    axes.text(a + 0.5 * leg, -3.3, f"leg {leg:g}", color=BLUE, fontsize=8, ha="center")
    axes.annotate("", (-4.5, -0.5 * g.h1_m * MM), (-4.5, outline.foot_m * MM), arrowprops=style)
    axes.text(-4.9, -8.5, f"d = {g.d_m * MM:g}", color=BLUE, fontsize=8, ha="right")
    axes.text(0.0, bottom - 1.6, "clamped", color=BLUE, fontsize=8, ha="center")
    axes.text(
        -20.0,
        -19.0,
        f"slit {outline.slit_m * MM:g}\nh1 = {g.h1_m * MM:g}\nh2 = {g.h2_m * MM:g}",
        color=BLUE,
        fontsize=8,
    )


def work_precision_figure(
    found: Sequence[Convergence], condition: Sequence[float], matrix: FloatArray, known: tuple[float, float]
) -> Figure:
    """Error against run time, uniform and graded: worst condition number, and strain matrix.

    condition: (3,) limits of the cases; matrix: (5, 3) limit; known: the relative errors of these references.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    for run, marker in zip(found, "so^dv", strict=False):
        seconds = [level.seconds for level in run.levels]
        label = "uniform" if run.grading == 1.0 else f"graded, {run.grading:g}"
        left.loglog(
            seconds, [worst_error(level.conditions, condition) for level in run.levels], marker=marker, label=label
        )
        right.loglog(seconds, [distance(level.matrix, matrix) for level in run.levels], marker=marker, label=label)
    titles = ("condition number, worst of I, II, III", "strain matrix, Frobenius norm")
    for axes, title, error in zip((left, right), titles, known, strict=True):
        axes.axhspan(axes.get_ylim()[0], error, color="#dddddd", zorder=0)
        axes.text(0.98, 0.02, "grey: error of the reference", transform=axes.transAxes, ha="right", fontsize=8)
        axes.set(xlabel="seconds: mesh to strain matrix", ylabel="relative error", title=title)
        axes.grid(True, which="both", linewidth=0.3)
        axes.legend(fontsize=8)
    return figure


def worst_error(values: Sequence[float], limits: Sequence[float]) -> float:
    """The largest relative error of the cases."""
    return max(abs(value / limit - 1.0) for value, limit in zip(values, limits, strict=True))


def distance(matrix: FloatArray, other: FloatArray) -> float:
    """Relative distance in the Frobenius norm."""
    return float(np.linalg.norm(matrix - other) / np.linalg.norm(other))
