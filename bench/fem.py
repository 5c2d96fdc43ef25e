"""Plane finite elements of the fingertip: convergence, corner exponents, Table 3's simulation column.

python -m bench.fem                    everything, as the Markdown tables of docs/finite-elements.md (minutes)
python -m bench.fem --quick            small meshes
python -m bench.fem -o docs/figures    writes fem-outline.png and fem-work-precision.png too"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from bench.measure import arguments, in_turns, table
from scipy.optimize import brentq

from tipforce.arrays import FloatArray
from tipforce.output_file import save_figure
from tipforce.sensor.structure.layouts import CASES, GAUGE_LENGTH_M
from tipforce.sensor.structure.strain import GaugePosition
from tipforce_lab.design.tables import TABLE_3_MEASUREMENT, TABLE_3_SIMULATION, nearest_common
from tipforce_lab.fem import plane_stress as fem
from tipforce_lab.fem.mesh import GRADING, STATED, Outline, Resolution, Triangles, triangulate
from tipforce_lab.fem.plane_stress import Limit, Model, Patch, Solution, face, nearest_place, solve, strain_matrix
from tipforce_lab.report.studies.structure import GAUGES, conditions, distance, worst_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GRADINGS = (1.0, 2.5, GRADING, 5.5)
MM = 1e3
ORANGE, BLUE, GREY = "#d55e00", "#0072b2", "#666666"


class Level(NamedTuple):
    cells: int
    unknowns: int
    seconds: float
    conditions: list[float]
    matrix: FloatArray  # (5, 3): rows GAUGES
    point_strain: float  # strain per newton of F2 at S itself, from the side of the mesh that ends there


class Convergence(NamedTuple):
    grading: float
    levels: tuple[Level, ...]

    def limits(self) -> tuple[Limit, ...]:
        """Cases I, II, III, from the last three of the levels that double."""
        return tuple(map(fem.extrapolate, zip(*(level.conditions for level in self.doubling()), strict=True)))

    def doubling(self) -> tuple[Level, ...]:
        """The longest run of levels n, 2 n, 4 n... that ends in the finest one."""
        by_cells = {level.cells: level for level in self.levels}
        cells, series = self.levels[-1].cells, []
        while cells in by_cells:
            series.append(by_cells[cells])
            if cells % 2:
                break
            cells //= 2
        return tuple(reversed(series))

    def orders(self, reference: FloatArray) -> list[float]:
        """Observed orders of the strain matrix (Frobenius norm) against a reference (5, 3), per halving."""
        levels = self.doubling()
        errors = [np.linalg.norm(level.matrix - reference) for level in levels]
        return [float(np.log2(one / two)) for one, two in itertools.pairwise(errors)]


def convergence(grading: float, cells: Sequence[int]) -> Convergence:
    """Solve on each mesh; the time is that of mesh, assembly, factorisation and gauges together."""
    solve(Model(resolution=Resolution(1, grading)))  # imports are not part of the time
    levels = []
    for n in cells:
        started = time.perf_counter()
        solution = solve(Model(resolution=Resolution(n, grading)))
        matrix = strain_matrix(solution, GAUGES)
        seconds = time.perf_counter() - started
        corner = face(solution, nearest_place(STATED, "S_H")).strain(0.5 * STATED.geometry.h2_m)
        point = float(corner[1]) * solution.scale
        levels.append(Level(n, solution.unknowns, seconds, conditions(matrix), matrix, point))
    return Convergence(grading, tuple(levels))


class Exponent(NamedTuple):
    """A corner's singularity: what a mesh shows, and what Williams' equation says."""

    mode: str
    observed: float
    theory: float


def corner_exponents(cells: int) -> list[Exponent]:
    """Displacement ~ r^lambda at the joint (S), on its two faces.

    Elongation from the corner along a face, of both faces at one distance from it: the sum has the symmetric mode
    alone, the difference the antisymmetric one; rigid motion cancels. Slopes between 1e-3 and 1e-2 of a thickness."""
    solution, g = solve(Model(resolution=Resolution(cells, 5.5))), STATED.geometry
    r = np.geomspace(1e-3, 1e-2, 15) * g.h1_m
    elongations = []
    for point, corner, sign in (("S_H", 0.5 * g.h2_m, 1.0), ("U", -0.5 * g.h1_m, -1.0)):
        moved = face(solution, nearest_place(STATED, point)).displacement(np.append(corner + sign * r, corner))
        elongations.append(sign * (moved[:-1] - moved[-1]))
    first, second = elongations
    exponents = []
    for mode, values in (("opening", first + second), ("sliding", first - second)):
        # The load that excites this mode most, against the other one.
        load = int(np.argmax(np.abs(values[-1])))
        slope = float(np.polyfit(np.log(r), np.log(np.abs(values[:, load])), 1)[0])
        exponents.append(Exponent(mode, slope, fem.corner_exponent(1.5 * math.pi, mode)))
    return exponents


def conditions_at(solution: Solution, moved: dict[str, GaugePosition] | None = None) -> list[float]:
    """Condition numbers of cases I, II, III, 1 mm gauges where they fit or at the places of ``moved``."""
    places = {point: (moved or {}).get(point) or nearest_place(solution.model.outline, point) for point in GAUGES}
    return conditions(strain_matrix(solution, [places[point] for point in GAUGES]))


def outline_variants(cells: int) -> dict[str, list[float]]:
    """How the outline's unstated parts move the condition numbers, gauges where they fit."""
    mm = 1e-3
    bodies = {
        "stated outline": Model(),
        **{f"legs {leg:g} mm": _body(leg_m=leg * mm) for leg in (0.2, 0.25, 0.3, 0.4, 0.5, 1.0, 4.0)},
        **{f"slit {slit:g} mm": _body(slit_m=slit * mm) for slit in (0.1, 1.0)},
        "legs 2 mm below the beam too": _body(leg_below_m=2.0 * mm),
        **{f"fillets {radius:g} mm at joint and foot": _body(fillet_m=radius * mm) for radius in (0.05, 0.25, 0.5)},
        "slit ends round, 0.125 mm": _body(slit_fillet_m=0.125 * mm),
        "foot clamped, no fixture": _body(fixture_depth_m=0.0),
        "plane strain": Model(plane="strain"),
        **{
            f"load on 10 degrees of arc at theta {theta}": Model(patch=Patch(math.radians(theta))) for theta in (30, 90)
        },
    }
    return {what: conditions_at(solve(replace(m, resolution=Resolution(cells)))) for what, m in bodies.items()}


def _body(**change: float) -> Model:
    return Model(replace(STATED, **change))  # type: ignore[arg-type]


def outer_gauges(position_m: float) -> dict[str, GaugePosition]:
    return {"L": GaugePosition("H", "left", position_m), "R": GaugePosition("H", "right", position_m)}


def gauge_variants(solution: Solution) -> dict[str, list[float]]:
    """L and R elsewhere; K, S and U further from their corners; gauges of other lengths, each beginning at its corner.

    The others are where they fit, 1 mm long. Beyond 14.5 mm a part of the gauge is glued under the leg."""
    places_mm = (15.25, 15.0, 14.75, 14.5, 14.0, 13.5, 13.0)
    variants = {f"L, R at {x:g} mm": conditions_at(solution, outer_gauges(x * 1e-3)) for x in places_mm}
    for shift_mm in (0.0, 0.25, 0.5, 1.0):
        moved = {}
        for point, sign in (("K_H", 1.0), ("S_H", 1.0), ("U", -1.0)):
            place = nearest_place(solution.model.outline, point)
            moved[point] = place._replace(position_m=place.position_m + sign * shift_mm * 1e-3)
        variants[f"K, S, U {0.5 + shift_mm:g} mm from the corner"] = conditions_at(solution, moved)
    for length_mm in (0.1, 0.25, 0.5, 1e3 * GAUGE_LENGTH_M, 2.0):
        variants[f"gauges of {length_mm:g} mm"] = conditions(strain_matrix(solution, GAUGES, length_mm * 1e-3))
    return variants


_XTOL = 1e-4


class Match(NamedTuple):
    """What reaches a condition number that ANSYS has."""

    what: str
    case: str
    wanted: float
    value_mm: float
    conditions: list[float]


def matches(solution: Solution, cells: int) -> list[Match]:
    """The places of L and R, and the thickness of the legs, that give ANSYS's numbers for II and III."""

    def moved(x: float) -> list[float]:
        return conditions_at(solution, outer_gauges(x * 1e-3))

    def thinner(leg: float) -> list[float]:
        return conditions_at(solve(replace(_body(leg_m=leg * 1e-3), resolution=Resolution(cells))))

    matched = []
    for what, evaluate, low, high in (
        ("L, R inward", moved, 14.4, 12.6), ("L, R outward", moved, 14.6, 15.4), ("legs thin", thinner, 0.5, 0.2)
    ):  # fmt: skip
        for index, case in ((1, "II"), (2, "III")):
            wanted = TABLE_3_SIMULATION[case]
            value = brentq(lambda x, i=index, w=wanted, f=evaluate: f(x)[i] - w, low, high, xtol=_XTOL)
            matched.append(Match(what, case, wanted, value, evaluate(value)))
    return matched


def one_body(cells: int) -> tuple[float, float, list[float]]:
    """Legs and fillets, mm, that give ANSYS's I and III at once, solved for in turn; II is then a check.

    The condition numbers returned are those of this body on a mesh twice as fine."""

    def body(leg: float, fillet: float, n: int = cells) -> list[float]:
        changed = _body(leg_m=leg * 1e-3, fillet_m=fillet * 1e-3)
        return conditions_at(solve(replace(changed, resolution=Resolution(n))))

    leg, fillet = 0.25, 0.3
    for _ in range(3):
        fillet = brentq(lambda x, t=leg: body(t, x)[0] - TABLE_3_SIMULATION["I"], 0.05, 0.6, xtol=_XTOL)
        leg = brentq(lambda x, t=fillet: body(x, t)[2] - TABLE_3_SIMULATION["III"], 0.15, 0.5, xtol=_XTOL)
    return leg, fillet, body(leg, fillet, 2 * cells)


class Miss(NamedTuple):
    """The best that places alone can do for the measured column."""

    places_mm: tuple[float, ...]  # L, R, K, S from the middle of the joint, U from its underside
    conditions: list[float]
    worst: float


def best_for_measured(solution: Solution, steps: int) -> Miss:
    """Search a grid of places of all five gauges, up to 6 mm inward, for the measured 3.50, 3.50, 3.34."""
    outline = solution.model.outline
    shifts = np.linspace(0.0, 6e-3, steps)
    rows, places = {}, {}
    for point in GAUGES:
        start = nearest_place(outline, point)
        sign = 1.0 if point in ("K_H", "S_H") else -1.0
        positions = [start._replace(position_m=start.position_m + sign * shift) for shift in shifts]
        rows[point], places[point] = strain_matrix(solution, positions), positions
    best, worst = nearest_common(rows, TABLE_3_MEASUREMENT)
    at = tuple(float(1e3 * places[point][best[point]].position_m) for point in GAUGES)
    return Miss(at, conditions(np.array([rows[point][best[point]] for point in GAUGES])), worst)


def variant_table(variants: dict[str, list[float]]) -> str:
    rows = [[what, *(f"{value:.3f}" for value in conditions)] for what, conditions in variants.items()]
    return table(["", "I", "II", "III"], rows)


def convergence_part(quick: bool, folder: Path | None) -> None:
    """The tables of convergence and the figure of error against run time."""
    cells = (1, 2, 4) if quick else (2, 3, 4, 6, 8, 12)
    fewer = (1, 2, 4) if quick else (2, 3, 4, 6, 8)
    ways = {str(g): partial(convergence, g, cells if g == GRADING else fewer) for g in GRADINGS}
    runs = []
    for same in in_turns(ways, 1 if quick else 3).values():  # the least time of each mesh: a busy machine only adds
        levels = zip(*(run.levels for run in same), strict=True)
        least = (level[0]._replace(seconds=min(each.seconds for each in level)) for level in levels)
        runs.append(Convergence(same[0].grading, tuple(least)))
    best = next(run for run in runs if run.grading == GRADING)
    limits = best.limits()
    matrix, matrix_error = fem.extrapolate_matrix([level.matrix for level in best.doubling()])
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
    by_mesh = [corner_exponents(n) for n in cells]
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
    print("\n## Outline\n\n" + variant_table(outline_variants(cells)))
    print("\n## Places of the gauges\n")
    print(variant_table(gauge_variants(base)))
    print("\n## What gives ANSYS's 2.53, 3.36, 3.94\n")
    rows = [
        [m.what, f"{m.case} = {m.wanted}", f"{m.value_mm:.2f} mm", *(f"{c:.2f}" for c in m.conditions)]
        for m in matches(base, coarse)
    ]
    print(table(["by", "to reach", "needs", "I", "II", "III"], rows))
    if not quick:
        leg_mm, fillet_mm, conditions = one_body(3)
        shown = ", ".join(f"{value:.2f}" for value in conditions)
        print(f"\nI and III at once: legs {leg_mm:.2f} mm, fillets {fillet_mm:.2f} mm give {shown}")
    print("\n## The measured 3.50, 3.50, 3.34\n")
    miss = best_for_measured(base, 7 if quick else 25)
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

    condition: (3,) limits of the cases; matrix: (5, 3) limit; known: the relative errors of these references."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    for run, marker in zip(runs, "so^dv", strict=False):
        seconds = [level.seconds for level in run.levels]
        label = "uniform" if run.grading == 1.0 else f"graded, {run.grading:g}"
        of_conditions = [worst_error(level.conditions, condition) for level in run.levels]
        of_strains = [distance(level.matrix, matrix) for level in run.levels]
        for axes, errors in ((left, of_conditions), (right, of_strains)):
            axes.loglog(seconds, errors, marker=marker, label=label)
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
