"""The paper's three measured calibration matrices: the range that three printed digits allow, and their consistency."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.sensor.structure.gauge_shift import shifted_matrix
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import LAYOUTS
from tipforce.sensor.structure.published import CASES, HALF_DIGIT, MEASURED_MATRICES
from tipforce.sensor.structure.strain import condition_number


class RoundingRange(NamedTuple):
    """Range of the condition numbers of matrices that print as the given one."""

    printed: float
    """Of the printed entries themselves."""
    low: float
    high: float


class CommonShifts(NamedTuple):
    """The gauge shifts that best fit three measured condition numbers at once."""

    shifts_m: dict[str, float]
    """Per gauge point, inward along its beam, the same in every case that uses the point."""
    conditions: dict[str, float]
    worst_miss: float
    """Largest difference from the wanted condition numbers."""


def rounding_range(matrix: npt.ArrayLike, half_digit: float = HALF_DIGIT) -> RoundingRange:
    """Return the range of condition numbers over all matrices (3, 3) whose entries round to the given ones.

    All 512 corners of the box of entries. The condition number is smooth here and the box small (curvature adds
    under 1e-4), so its extremes are at corners.
    """
    centre = np.asarray(matrix, dtype=np.float64)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=centre.size))).reshape(-1, *centre.shape)
    singular = np.linalg.svd(centre + half_digit * signs, compute_uv=False)
    conditions = singular[:, 0] / singular[:, -1]
    return RoundingRange(condition_number(centre), float(conditions.min()), float(conditions.max()))


def measured_rows() -> dict[str, dict[str, FloatArray]]:
    """Return per case and gauge point the row of the inverted matrix: the gauge's reading per F, shape (3,)."""
    rows: dict[str, dict[str, FloatArray]] = {}
    for case in CASES:
        inverse = np.linalg.inv(np.array(MEASURED_MATRICES[case], dtype=np.float64))
        rows[case] = dict(zip(LAYOUTS[case], inverse, strict=True))
    return rows


def shared_gauge_disagreement() -> dict[str, float]:
    """Return per gauge of several cases the difference of its rows, relative to the longest of them.

    The same gauge on the same body must have one row; the largest entry of the difference counts.
    """
    rows = measured_rows()
    result = {}
    for point in ("S_H", "L", "U"):
        found = np.array([rows[case][point] for case in CASES if point in rows[case]])
        result[point] = float(np.ptp(found, axis=0).max() / np.abs(found).max())
    return result


def nearest_common_shifts(
    geometry: Geometry, conditions: dict[str, float], largest_shift_m: float = 6e-3, steps: int = 25
) -> CommonShifts:
    """Return the shifts of K, S, L, R, U, one set for all three cases, that best fit the condition numbers.

    Every combination of `steps` shifts from 0 to largest_shift_m; the largest miss counts. Case I holds K, S and
    U, case II L, S and U, case III L, R and U, so K and R can be chosen last, each alone.
    """
    grid = np.linspace(0.0, largest_shift_m, steps)
    shifts = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1)
    missed = {}
    for case in CASES:
        singular = np.linalg.svd(shifted_matrix(geometry, case, shifts), compute_uv=False)
        missed[case] = np.abs(singular[..., 0] / singular[..., -1] - conditions[case])
    first, third = missed["I"].min(axis=0), missed["III"].min(axis=1)  # [S, U] over K, [L, U] over R
    worst = np.maximum(missed["II"], np.maximum(first[np.newaxis], third[:, np.newaxis]))  # [L, S, U]
    L, S, U = (int(index) for index in np.unravel_index(int(worst.argmin()), worst.shape))
    K, R = int(missed["I"][:, S, U].argmin()), int(missed["III"][L, :, U].argmin())
    chosen = {"K_H": grid[K], "S_H": grid[S], "L": grid[L], "R": grid[R], "U": grid[U]}
    return CommonShifts(
        {point: float(value) for point, value in chosen.items()},
        {
            case: condition_number(shifted_matrix(geometry, case, [chosen[point] for point in LAYOUTS[case]]))
            for case in CASES
        },
        float(worst.min()),
    )
