"""Plane finite elements of the fingertip: convergence, corner exponents, Table 3's simulation column.

python -m bench.fem                    everything, as the Markdown tables of docs/finite-elements.md (minutes)
python -m bench.fem --quick            small meshes
python -m bench.fem -o docs/figures    writes fem-outline.png and fem-work-precision.png too

Nothing here is random. Times are of this machine, the least of three.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from bench import fem_studies as studies
from bench.fem_studies import Convergence, Variants
from bench.measure import arguments, in_turns, table

from tipforce.arrays import FloatArray
from tipforce.output_file import save_figure
from tipforce.sensor.structure.layouts import CASES
from tipforce.sensor.structure.published import GAUGE_LENGTH_M
from tipforce_lab.fem.mesh import GRADING, STATED, Outline, Resolution, Triangles, triangulate
from tipforce_lab.fem.plane_stress import Model, extrapolate_matrix, nearest_place, solve
from tipforce_lab.report.studies.structure import GAUGES, distance, worst_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
MM = 1e3
ORANGE, BLUE, GREY = "#d55e00", "#0072b2", "#666666"


def variant_table(variants: Variants) -> str:
    """What, and three condition numbers."""
    rows = [[what, *(f"{value:.3f}" for value in conditions)] for what, conditions in variants.items()]
    return table(["", "I", "II", "III"], rows)


def convergence_part(quick: bool, folder: Path | None) -> None:
    """The tables of convergence and the figure of error against run time."""
    cells = (1, 2, 4) if quick else (2, 3, 4, 6, 8, 12)
    fewer = (1, 2, 4) if quick else (2, 3, 4, 6, 8)
    ways = {str(g): partial(studies.convergence, g, cells if g == GRADING else fewer) for g in studies.GRADINGS}
    runs = [studies.least_times(same) for same in in_turns(ways, 1 if quick else 3).values()]
    best = next(run for run in runs if run.grading == GRADING)
    limits = best.limits()
    matrix, matrix_error = extrapolate_matrix([level.matrix for level in best.doubling()])
    values = [limit.value for limit in limits]
    print("## Convergence\n")
    print(f"Limit (graded {GRADING:g}, n = {', '.join(str(level.cells) for level in best.doubling()[-3:])}):")
    for case, limit in zip(CASES, limits, strict=True):
        print(f"  case {case}: {limit.value:.4f} +- {limit.error:.4f} ({limit.error / limit.value:.1e}), ", end="")
        print(f"observed order {limit.order:.2f}")
    print(f"  strain matrix: relative error {matrix_error:.1e}\n")
    rows = []
    for run in runs:
        for level in run.levels:
            errors = (worst_error(level.conditions, values), distance(level.matrix, matrix))
            figures = [*(f"{value:.4f}" for value in level.conditions), *(f"{error:.1e}" for error in errors)]
            figures += [f"{1e6 * level.point_strain:.0f}", f"{level.seconds:.2f}"]
            rows.append([f"{run.grading:g}", str(level.cells), str(level.unknowns), *figures])
    header = ["grading", "n", "unknowns", "I", "II", "III", "error, condition", "error, strains"]
    print(table([*header, "point strain at S, microstrain/N", "s"], rows), "\n")
    for run in runs:
        theory = 0.5445 * run.grading
        orders = ", ".join(f"{order:.2f}" for order in run.orders(matrix))
        print(f"grading {run.grading:g}: order of the strains, per halving {orders}; theory {min(theory, 3.0):.2f}")
    if folder is not None:
        known = (max(limit.error / limit.value for limit in limits), matrix_error)
        save_figure(work_precision_figure(runs, values, matrix, known), folder / "fem-work-precision.png", dpi=110)


def corner_part(quick: bool) -> None:
    """Observed exponents on two meshes beside Williams' roots."""
    cells = (2, 4) if quick else (4, 8)
    by_mesh = [studies.corner_exponents(n) for n in cells]
    rows = [
        [mode[0].mode, *(f"{exponent.observed:.4f}" for exponent in mode), f"{mode[0].theory:.4f}"]
        for mode in zip(*by_mesh, strict=True)
    ]
    print("\n## Corner exponent, 270 degrees, free faces\n")
    print(table(["mode", *(f"observed, n = {n}" for n in cells), "Williams"], rows))


def table_3_part(quick: bool) -> None:
    """What moves the condition numbers, what gives ANSYS's, and what cannot give the measured ones."""
    cells, coarse = (1, 1) if quick else (4, 3)
    # Away from the corners gauges end between nodes, where displacement is less exact: a finer mesh for them.
    base = solve(Model(resolution=Resolution(2 * cells)))
    print("\n## Outline\n\n" + variant_table(studies.outline_variants(cells)))
    print("\n## Places of the gauges\n")
    print(variant_table(studies.gauge_variants(base)))
    print("\n## What gives ANSYS's 2.53, 3.36, 3.94\n")
    rows = [
        [m.what, f"{m.case} = {m.wanted}", f"{m.value_mm:.2f} mm", *(f"{c:.2f}" for c in m.conditions)]
        for m in studies.matches(base, coarse)
    ]
    print(table(["by", "to reach", "needs", "I", "II", "III"], rows))
    if not quick:
        leg_mm, fillet_mm, conditions = studies.one_body(3)
        shown = ", ".join(f"{value:.2f}" for value in conditions)
        print(f"\nI and III at once: legs {leg_mm:.2f} mm, fillets {fillet_mm:.2f} mm give {shown}")
    print("\n## The measured 3.50, 3.50, 3.34\n")
    miss = studies.best_for_measured(base, 7 if quick else 25)
    places = ", ".join(f"{point} {place:.2f}" for point, place in zip(GAUGES, miss.places_mm, strict=True))
    shown = ", ".join(f"{value:.3f}" for value in miss.conditions)
    print(f"Best of all places up to 6 mm inward: {shown}, off by {miss.worst:.3f} (mm from the joint: {places})")


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
    sizes = f"slit {outline.slit_m * MM:g}\nh1 = {g.h1_m * MM:g}\nh2 = {g.h2_m * MM:g}"
    axes.text(-20.0, -19.0, sizes, color=BLUE, fontsize=8)


def work_precision_figure(
    runs: Sequence[Convergence], condition: Sequence[float], matrix: FloatArray, known: tuple[float, float]
) -> Figure:
    """Error against run time, uniform and graded: worst condition number, and strain matrix.

    condition: (3,) limits of the cases; matrix: (5, 3) limit; known: the relative errors of these references.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    for run, marker in zip(runs, "so^dv", strict=False):
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


def main(words: Sequence[str] | None = None) -> None:
    parser = arguments(__doc__, "--quick")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="write the figures here")
    options = parser.parse_args(words)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        save_figure(outline_figure(), options.output / "fem-outline.png", dpi=110)
    convergence_part(options.quick, options.output)
    corner_part(options.quick)
    table_3_part(options.quick)


if __name__ == "__main__":
    main()
