"""Convergence on uniform and graded meshes, the exponent of the corners, and Table 3's simulation column."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.structure.published import GAUGE_LENGTH_M, TABLE_3_MEASUREMENT, TABLE_3_SIMULATION
from tipforce.sensor.structure.strain import GaugePosition
from tipforce_lab.design.tables import nearest_common
from tipforce_lab.fem.mesh import GRADING, STATED, Resolution
from tipforce_lab.fem.plane_stress import (
    Face,
    Limit,
    Model,
    Patch,
    Solution,
    corner_exponent,
    extrapolate,
    face,
    nearest_place,
    solve,
    strain_matrix,
)
from tipforce_lab.report.studies.structure import GAUGES
from tipforce_lab.report.studies.structure import conditions as conditions_of_cases

GRADINGS = (1.0, 2.5, GRADING, 5.5)


class Level(NamedTuple):
    """One mesh of a series."""

    cells: int
    unknowns: int
    seconds: float
    conditions: list[float]
    matrix: FloatArray
    """(5, 3): rows GAUGES."""
    point_strain: float
    """Strain per newton of F2 at S itself, from the side of the mesh that ends there."""


@dataclass(frozen=True, slots=True)
class Convergence:
    """A series of meshes with one grading."""

    grading: float
    levels: tuple[Level, ...]

    def limits(self) -> tuple[Limit, ...]:
        """Cases I, II, III, from the last three of the levels that double."""
        return tuple(
            extrapolate(values) for values in zip(*(level.conditions for level in self.doubling()), strict=True)
        )

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
        levels.append(Level(n, solution.unknowns, seconds, conditions_of_cases(matrix), matrix, point))
    return Convergence(grading, tuple(levels))


def least_times(rounds: Sequence[Convergence]) -> Convergence:
    """Return the first of several equal series with the least time of each mesh: a busy machine only adds."""
    levels = zip(*(run.levels for run in rounds), strict=True)
    return Convergence(
        rounds[0].grading, tuple(same[0]._replace(seconds=min(level.seconds for level in same)) for same in levels)
    )


class Exponent(NamedTuple):
    """A corner's singularity: what a mesh shows, and what Williams' equation says."""

    mode: str
    observed: float
    theory: float


def corner_exponents(cells: int) -> list[Exponent]:
    """Displacement ~ r^lambda at the joint (S), on its two faces.

    Elongation from the corner along a face, of both faces at one distance from it: the sum has the symmetric mode
    alone, the difference the antisymmetric one; rigid motion cancels. Slopes between 1e-3 and 1e-2 of a thickness.
    """
    outline = STATED
    solution = solve(Model(resolution=Resolution(cells, 5.5)))
    g = outline.geometry
    half_h1, half_h2 = 0.5 * g.h1_m, 0.5 * g.h2_m
    r = np.geomspace(1e-3, 1e-2, 15) * g.h1_m
    under = face(solution, nearest_place(outline, "S_H"))
    down = face(solution, nearest_place(outline, "U"))

    def elongation(surface: Face, corner: float, sign: float) -> FloatArray:
        moved = surface.displacement(np.append(corner + sign * r, corner))
        result: FloatArray = sign * (moved[:-1] - moved[-1])
        return result

    first, second = elongation(under, half_h2, 1.0), elongation(down, -half_h1, -1.0)
    exponents = []
    for mode, values in (("opening", first + second), ("sliding", first - second)):
        # The load that excites this mode most, against the other one.
        load = int(np.argmax(np.abs(values[-1])))
        slope = float(np.polyfit(np.log(r), np.log(np.abs(values[:, load])), 1)[0])
        exponents.append(Exponent(mode, slope, corner_exponent(1.5 * math.pi, mode)))
    return exponents


def conditions(solution: Solution, moved: dict[str, GaugePosition] | None = None) -> list[float]:
    """Condition numbers of cases I, II, III, 1 mm gauges where they fit or at the places of ``moved``."""
    places = {point: (moved or {}).get(point) or nearest_place(solution.model.outline, point) for point in GAUGES}
    matrix = strain_matrix(solution, [places[point] for point in GAUGES])
    return conditions_of_cases(matrix)


Variants = dict[str, list[float]]
"""The condition numbers of cases I, II, III by body or placing of gauges."""


def outline_variants(cells: int) -> Variants:
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
    return {what: conditions(solve(replace(m, resolution=Resolution(cells)))) for what, m in bodies.items()}


def _body(**change: float) -> Model:
    return Model(replace(STATED, **change))  # type: ignore[arg-type]


def outer_gauges(position_m: float) -> dict[str, GaugePosition]:
    """L and R at one distance from the middle."""
    return {"L": GaugePosition("H", "left", position_m), "R": GaugePosition("H", "right", position_m)}


def gauge_variants(solution: Solution) -> Variants:
    """L and R elsewhere; K, S and U further from their corners; gauges of other lengths, each beginning at its corner.

    The others are where they fit, 1 mm long. Beyond 14.5 mm a part of the gauge is glued under the leg.
    """
    places_mm = (15.25, 15.0, 14.75, 14.5, 14.0, 13.5, 13.0)
    variants = {f"L, R at {x:g} mm": conditions(solution, outer_gauges(x * 1e-3)) for x in places_mm}
    for shift_mm in (0.0, 0.25, 0.5, 1.0):
        moved = {}
        for point, sign in (("K_H", 1.0), ("S_H", 1.0), ("U", -1.0)):
            place = nearest_place(solution.model.outline, point)
            moved[point] = place._replace(position_m=place.position_m + sign * shift_mm * 1e-3)
        variants[f"K, S, U {0.5 + shift_mm:g} mm from the corner"] = conditions(solution, moved)
    for length_mm in (0.1, 0.25, 0.5, 1e3 * GAUGE_LENGTH_M, 2.0):
        matrix = strain_matrix(solution, GAUGES, length_mm * 1e-3)
        variants[f"gauges of {length_mm:g} mm"] = conditions_of_cases(matrix)
    return variants


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
        return conditions(solution, outer_gauges(x * 1e-3))

    def thinner(leg: float) -> list[float]:
        return conditions(solve(replace(_body(leg_m=leg * 1e-3), resolution=Resolution(cells))))

    ways: dict[str, tuple[Callable[[float], list[float]], float, float]] = {
        "L, R inward": (moved, 14.4, 12.6), "L, R outward": (moved, 14.6, 15.4), "legs thin": (thinner, 0.5, 0.2),
    }  # fmt: skip
    matched = []
    for what, (evaluate, low, high) in ways.items():
        for index, case in ((1, "II"), (2, "III")):
            wanted = TABLE_3_SIMULATION[case]
            value = _root(lambda x, i=index, w=wanted, f=evaluate: f(x)[i] - w, low, high)  # type: ignore[misc]
            matched.append(Match(what, case, wanted, value, evaluate(value)))
    return matched


def one_body(cells: int) -> tuple[float, float, list[float]]:
    """Legs and fillets, mm, that give ANSYS's I and III at once, solved for in turn; II is then a check.

    The condition numbers returned are those of this body on a mesh twice as fine.
    """

    def body(leg: float, fillet: float, n: int = cells) -> list[float]:
        changed = _body(leg_m=leg * 1e-3, fillet_m=fillet * 1e-3)
        return conditions(solve(replace(changed, resolution=Resolution(n))))

    leg, fillet = 0.25, 0.3
    for _ in range(3):
        fillet = _root(lambda x, t=leg: body(t, x)[0] - TABLE_3_SIMULATION["I"], 0.05, 0.6)  # type: ignore[misc]
        leg = _root(lambda x, t=fillet: body(x, t)[2] - TABLE_3_SIMULATION["III"], 0.15, 0.5)  # type: ignore[misc]
    return leg, fillet, body(leg, fillet, 2 * cells)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq

    return float(brentq(function, low, high, xtol=1e-4))


class Miss(NamedTuple):
    """The best that places alone can do for the measured column."""

    places_mm: tuple[float, ...]
    """L, R, K, S from the middle of the joint, U from its underside."""
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
    return Miss(at, conditions_of_cases(np.array([rows[point][best[point]] for point in GAUGES])), worst)
