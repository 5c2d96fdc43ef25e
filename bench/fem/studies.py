"""Convergence on uniform and graded meshes, and the exponent of the corners."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.sensor.structure.layouts import CASES, LAYOUTS
from tipforce.sensor.structure.strain import condition_number
from tipforce_lab.fem.gauges import Face, Limit, corner_exponent, extrapolate, face, nearest_place, strain_matrix
from tipforce_lab.fem.mesh import GRADING, Resolution
from tipforce_lab.fem.outline import STATED
from tipforce_lab.fem.plane_stress import Model, solve

FloatArray = npt.NDArray[np.float64]
GAUGES = ("L", "R", "K_H", "S_H", "U")
GRADINGS = (1.0, 2.5, GRADING, 5.5)


class Level(NamedTuple):
    """One mesh of a series."""

    cells: int
    unknowns: int
    seconds: float
    conditions: tuple[float, ...]
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
        cells, found = self.levels[-1].cells, []
        while cells in by_cells:
            found.append(by_cells[cells])
            if cells % 2:
                break
            cells //= 2
        return tuple(reversed(found))

    def orders(self, reference: FloatArray) -> list[float]:
        """Observed orders of the strain matrix (Frobenius norm) against a reference (5, 3), per halving."""
        levels = self.doubling()
        errors = [np.linalg.norm(level.matrix - reference) for level in levels]
        return [float(np.log2(one / two)) for one, two in itertools.pairwise(errors)]


def case_conditions(matrix: FloatArray) -> tuple[float, ...]:
    """Condition numbers of cases I, II, III from the rows GAUGES (5, 3)."""
    return tuple(condition_number(matrix[[GAUGES.index(point) for point in LAYOUTS[case]]]) for case in CASES)


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
        levels.append(Level(n, solution.unknowns, seconds, case_conditions(matrix), matrix, point))
    return Convergence(grading, tuple(levels))


def least_times(rounds: Sequence[Convergence]) -> Convergence:
    """Return the first of several equal series with the least time of each mesh: a busy machine only adds."""
    levels = zip(*(run.levels for run in rounds), strict=True)
    return Convergence(
        rounds[0].grading, tuple(same[0]._replace(seconds=min(level.seconds for level in same)) for same in levels)
    )


class Exponent(NamedTuple):
    """A corner's singularity: what a mesh shows, and what Williams' equation says."""

    corner: str
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

    corners = {
        "S": (elongation(under, half_h2, 1.0), elongation(down, -half_h1, -1.0)),
    }
    found = []
    for corner, (first, second) in corners.items():
        for mode, values in (("opening", first + second), ("sliding", first - second)):
            # The load that excites this mode most, against the other one.
            load = int(np.argmax(np.abs(values[-1])))
            slope = float(np.polyfit(np.log(r), np.log(np.abs(values[:, load])), 1)[0])
            found.append(Exponent(corner, mode, slope, corner_exponent(1.5 * math.pi, mode)))
    return found
