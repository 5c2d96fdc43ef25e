"""Rank all 56 choices of three of the eight gauge points by condition number or by noise."""

from __future__ import annotations

import itertools
from typing import Literal, NamedTuple

import numpy as np

from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import LAYOUTS, POINTS, mirror
from tipforce.sensor.structure.strain import (
    condition_number,
    noise_gain,
    row_equilibrated_condition_number,
    strain_matrix,
    thin_limit_matrix,
)

Figure = Literal["condition", "thin", "equilibrated", "noise"]


class RankedLayout(NamedTuple):
    """One pair of mirrored layouts, which share every figure. Infinite if they cannot separate the three forces."""

    points: tuple[str, ...]
    mirrored: tuple[str, ...]
    """The same points if a layout is its own mirror (none of three points is)."""
    case: str
    """I, II, III, or empty."""
    condition: float
    thin: float
    """Condition number in the thin-beam limit."""
    equilibrated: float
    """Condition number with every row scaled to unit length."""
    noise: float
    """sqrt(trace(C C^T)), newtons per unit strain."""


def ranked_layouts(geometry: Geometry, by: Figure = "condition") -> list[RankedLayout]:
    """Return the 28 mirrored pairs of layouts of three points, best first. Raises InputError for an unknown figure."""
    if by not in ("condition", "thin", "equilibrated", "noise"):
        raise InputError(f"rank by {by!r}: allowed are condition, thin, equilibrated, noise")
    found: dict[frozenset[frozenset[str]], RankedLayout] = {}
    for points in itertools.combinations(POINTS, 3):
        pair = frozenset((frozenset(points), frozenset(mirror(points))))
        if pair not in found:
            found[pair] = _ranked(geometry, points)
    return sorted(found.values(), key=lambda row: (round(getattr(row, by), 9), row.condition))


def ties(rows: list[RankedLayout], by: Figure, tolerance: float = 1e-6) -> list[list[RankedLayout]]:
    """Return the groups of rows whose figures agree within a relative tolerance, in order; infinite ones left out."""
    groups: list[list[RankedLayout]] = []
    for row in rows:
        value = getattr(row, by)
        if not np.isfinite(value):
            continue
        if groups and abs(value - getattr(groups[-1][0], by)) <= tolerance * value:
            groups[-1].append(row)
        else:
            groups.append([row])
    return [group for group in groups if len(group) > 1]


def _ranked(geometry: Geometry, points: tuple[str, ...]) -> RankedLayout:
    names = {frozenset(LAYOUTS[name]): name.rstrip("'") for name in LAYOUTS}
    case = names.get(frozenset(points), "")
    if case:
        points = LAYOUTS[case]
    matrix = strain_matrix(geometry, points)
    regular = int(np.linalg.matrix_rank(matrix)) == 3
    return RankedLayout(
        points,
        mirror(points),
        case,
        condition_number(matrix) if regular else float("inf"),
        _finite(condition_number(thin_limit_matrix(points))),
        row_equilibrated_condition_number(matrix) if regular else float("inf"),
        noise_gain(np.linalg.pinv(matrix)) if regular else float("inf"),
    )


def _finite(condition: float) -> float:
    """Return infinity for a singular matrix that rounding makes barely regular."""
    return condition if condition < 1e12 else float("inf")
