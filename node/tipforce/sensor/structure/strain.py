"""Force to strain: Table 1 of the paper for all eight gauge points, its matrices and their quality.

Every matrix multiplies F = (F1, F2, F3) = P (sin(phi), sin(phi - theta), cos(phi)), equation (16).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import VERTICAL_POINTS, Layout, layout

_THIN_LIMIT = {
    "L": (-1.0, 1.0, 0.0),
    "R": (-1.0, -1.0, 0.0),
    "T": (0.0, -1.5, 1.5),
    "U": (0.0, 1.5, -1.5),
    "K_H": (1.0, -2.0, 0.0),
    "S_H": (1.0, 2.0, 0.0),
    "K_V": (0.0, -1.5, 0.0),
    "S_V": (0.0, 1.5, 0.0),
}


def stress_coefficients(geometry: Geometry) -> dict[str, tuple[float, float, float]]:
    """Return Table 1: per gauge point (g1, g2, g3) in Pa per newton for a beam of unit width (1 m), unit 1/m.

    Signs are the paper's: the horizontal beam counts tension positive, the vertical beam compression.
    strain_matrix() counts tension positive everywhere. A beam too thin for floating point gives infinite
    coefficients.
    """
    a, d, r, h1, h2 = geometry.a_m, geometry.d_m, geometry.r_m, geometry.h1_m, geometry.h2_m
    force_bend = 1.5 * a / h1 / h1
    end_bend = 1.5 * r / h1 / h1
    joint_bend = 3.0 * r / h1 / h1
    pull_1, pull_2 = 0.5 / h1, 1.0 / h2
    tip_bend = 6.0 * r / h2 / h2
    fixture_bend = 6.0 * (d + 0.5 * h1) / h2 / h2
    offset_bend = 3.0 * h1 / h2 / h2
    return {
        "L": (-force_bend, end_bend, -pull_1),
        "R": (-force_bend, -end_bend, pull_1),
        "T": (-pull_2, tip_bend, -fixture_bend),
        "U": (-pull_2, -tip_bend, fixture_bend),
        "K_H": (force_bend, -joint_bend, -pull_1),
        "S_H": (force_bend, joint_bend, pull_1),
        "K_V": (-pull_2, tip_bend, -offset_bend),
        "S_V": (-pull_2, -tip_bend, offset_bend),
    }


def strain_matrix(geometry: Geometry, gauges: Layout) -> FloatArray:
    """Return the strain per newton of F, shape (n, 3), tension positive for every gauge.

    Table 1 divided by width and Young's modulus, its vertical-beam rows with the opposite sign: a gauge reads
    tension as positive wherever it is glued. Raises InputError for an unusable layout, or a beam too thin for
    floating point.
    """
    coefficients = stress_coefficients(geometry)
    points = layout(gauges)
    signs = np.array([-1.0 if point in VERTICAL_POINTS else 1.0 for point in points])
    stress = np.array([coefficients[point] for point in points], dtype=np.float64)
    if not np.isfinite(stress).all():
        raise InputError(f"h1_m = {geometry.h1_m!r}, h2_m = {geometry.h2_m!r}: too thin, the stress is not finite")
    return signs[:, np.newaxis] * stress / geometry.width_m / geometry.youngs_modulus_pascals


def thin_limit_matrix(gauges: Layout) -> FloatArray:
    """Return the strain matrix in the thin-beam limit, shape (n, 3), dimensionless, tension positive.

    h1 -> 0 with h2 = sqrt(8/3) h1 and a = d = r. Strain per newton in units of 3 a / (2 h1^2 width E); the
    "theory" column of Table 3 is its condition number. Raises InputError for an unusable layout.
    """
    return np.array([_THIN_LIMIT[point] for point in layout(gauges)], dtype=np.float64)


def calibration_matrix(geometry: Geometry, gauges: Layout) -> FloatArray:
    """Return C of equation (1), shape (3, n), newtons per unit strain: the pseudo-inverse of strain_matrix().

    Raises InputError for an unusable layout, and if the gauges cannot separate the three forces (rank
    below 3).
    """
    return pseudo_inverse(strain_matrix(geometry, gauges), layout(gauges))


def pseudo_inverse(matrix: FloatArray, names: Iterable[str]) -> FloatArray:
    """Return C (3, n) of a strain matrix (n, 3). Raises InputError with the gauges' names if its rank is below 3."""
    rank = int(np.linalg.matrix_rank(matrix))
    if rank < 3:
        raise InputError(
            f"the gauges {', '.join(names)} have rank {rank} in this geometry: allowed are layouts of rank 3"
        )
    return np.asarray(np.linalg.pinv(matrix), dtype=np.float64)


def condition_number(matrix: npt.ArrayLike) -> float:
    """Return the 2-norm condition number of a matrix (n, 3) or (3, n); inf where it is singular.

    It is the same for the strain matrix and its pseudo-inverse C. It depends on the units of F (the paper's
    F2 is a force, not a moment) and on the scale of every row. NaN where an entry is not finite. Raises InputError for
    another shape.
    """
    entries = floats("matrix", matrix)
    if entries.ndim != 2 or 3 not in entries.shape:
        raise InputError(f"the matrix has the shape {entries.shape}: allowed are (n, 3) and (3, n)")
    if not np.isfinite(entries).all():
        return float("nan")
    singular = np.linalg.svd(entries, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")


def row_equilibrated_condition_number(matrix: npt.ArrayLike) -> float:
    """Return the condition number of a strain matrix (n, 3) with every row (gauge) scaled to unit length.

    This is the figure for gauges whose noise is the same fraction of their own range. A zero row gives inf.
    """
    rows = floats("matrix", matrix)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return condition_number(rows / lengths) if lengths.all() else float("inf")


def noise_gain(C: npt.ArrayLike) -> float:
    """Return sqrt(trace(C C^T)) for C (3, n): root sum square of the noise of F per equal gauge noise.

    In the unit of C: newtons per unit strain. Unlike the condition number it contains the actual noise
    of F.
    """
    entries = floats("C", C)
    largest = float(np.abs(entries).max(initial=0.0))
    return largest * float(np.linalg.norm(entries / largest)) if 0.0 < largest < np.inf else largest
