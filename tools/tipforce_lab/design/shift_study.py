"""Figure 6 of the paper: the condition number as a function of gauge shifts along the beams."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.gauge_shift import shifted_matrix
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import Layout, layout


class Influence(NamedTuple):
    """Effect of a shift of one gauge on the condition number of a layout."""

    slope_per_mm: float
    """Change per millimetre inward, at the nominal position."""
    change: float
    """Change for the whole requested shift."""


def condition_against_shift(geometry: Geometry, gauges: Layout, shifts_m: npt.ArrayLike) -> FloatArray:
    """Return the condition numbers (n + 1, m): each gauge shifted alone, and in the last row all together.

    shifts_m: (m,), inward along the beams. Raises InputError for an unusable layout or a shift off the beam.
    """
    n, shifts = len(layout(gauges)), np.asarray(shifts_m, dtype=np.float64)
    moving = np.vstack((np.eye(n), np.ones((1, n))))
    singular = np.linalg.svd(
        shifted_matrix(geometry, gauges, moving[:, np.newaxis] * shifts[:, np.newaxis]), compute_uv=False
    )
    result: FloatArray = singular[..., 0] / singular[..., -1]
    return result


def influences(geometry: Geometry, gauges: Layout, shift_m: float) -> list[Influence]:
    """Return per gauge the effect of its shift alone on the condition number. Raises as condition_against_shift()."""
    step = 1e-9
    found = condition_against_shift(geometry, gauges, [0.0, step, shift_m])[:-1]
    return [Influence((row[1] - row[0]) / step * 1e-3, row[2] - row[0]) for row in found.tolist()]


def most_influential(geometry: Geometry, gauges: Layout, shift_m: float) -> int:
    """Return the number (1 for SG1) of the gauge whose shift changes the condition number most, up or down."""
    changes = [abs(found.change) for found in influences(geometry, gauges, shift_m)]
    return 1 + int(np.argmax(changes))


def shift_to_reach(
    geometry: Geometry,
    gauges: Layout,
    condition: float,
    moving: tuple[str, ...],
    others_m: float = 0.0,
    largest_shift_m: float = 5e-3,
) -> float:
    """Return the smallest inward shift of the gauges at `moving` that gives the layout a condition number.

    The other gauges stay others_m off their points. NaN if no shift up to largest_shift_m does. Raises
    InputError for a point that is not in the layout.
    """
    points = layout(gauges)
    for point in moving:
        if point not in points:
            raise InputError(f"gauge point {point!r} is not in the layout: allowed are {', '.join(points)}")
    moves = np.array([point in moving for point in points])
    shifts = np.linspace(0.0, largest_shift_m, 501)
    for _ in range(4):
        rows = np.where(moves, shifts[:, np.newaxis], others_m)
        singular = np.linalg.svd(shifted_matrix(geometry, points, rows), compute_uv=False)
        above = singular[:, 0] / singular[:, -1] > condition
        crossings = np.flatnonzero(above[1:] != above[:-1])
        if crossings.size == 0:
            return float("nan")
        shifts = np.linspace(shifts[crossings[0]], shifts[crossings[0] + 1], 51)
    return float(shifts.mean())
