"""Of layouts and their matrices, for studies: Table 1 and its thin-beam limit, shifted gauges, condition and noise."""

from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.structure.layouts import MIRROR, POINTS, Layout, layout
from tipforce.sensor.structure.strain import GaugePosition, Geometry, nominal_position, place, strain_row, unit_stress


def stress_coefficients(geometry: Geometry) -> dict[str, tuple[float, float, float]]:
    """Return Table 1: per gauge point (g1, g2, g3) in Pa per newton for a beam of unit width (1 m), unit 1/m. The
    paper's signs: compression is positive on the vertical beam. Infinite for a beam too thin for floating point."""
    table = {}
    for point in POINTS:
        beam, side, position_m, face = nominal_position(geometry, point)
        with np.errstate(over="ignore"):
            tension = unit_stress(geometry, beam, side, np.asarray(position_m), face)
        g1, g2, g3 = (float(-g if beam == "V" else g) for g in tension)
        table[point] = g1, g2, g3
    return table


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


def thin_limit_matrix(gauges: Layout) -> FloatArray:
    """Return the strain matrix in the thin-beam limit, (n, 3), tension positive: h1 -> 0 with h2 = sqrt(8/3) h1 and a =
    d = r, in units of 3 a / (2 h1^2 width E) per newton. Raises InputError for an unusable layout."""
    return np.array([_THIN_LIMIT[point] for point in layout(gauges)], dtype=np.float64)


def mirror(name_or_points: Layout) -> tuple[str, ...]:
    """Return the layout mirrored at the y-axis, gauge by gauge. Raises InputError as layout() does. For (F1, F2, F3) a
    mirrored gauge reads what the original does for (F1, -F2, -F3): equal condition number."""
    return tuple(MIRROR[point] for point in layout(name_or_points))


def shifted(geometry: Geometry, gauge: str | GaugePosition, shift_m: Any) -> GaugePosition:
    """Return the position shift_m (or an array of such) inward of a gauge: along its beam, away from the nearer end.
    Raises InputError for an unknown point; strain_row() rejects a shift beyond the beam."""
    spot = place(geometry, gauge)
    length = geometry.a_m if spot.beam == "H" else geometry.d_m
    inward = 1.0 if spot.position_m < 0.5 * length else -1.0
    return spot._replace(position_m=spot.position_m + inward * shift_m)


def shifted_matrix(geometry: Geometry, gauges: Layout, shifts_m: npt.ArrayLike) -> FloatArray:
    """Return the strain matrices (..., n, 3) of a layout, gauges shifted() by shifts_m (..., n), or all by a scalar.
    Raises InputError for an unusable layout, a last axis that is not n, or a gauge shifted off its beam."""
    points = layout(gauges)
    shifts = floats("shifts_m", shifts_m)
    if shifts.ndim == 0:
        shifts = np.full(len(points), float(shifts))
    if shifts.shape[-1] != len(points):
        raise InputError(f"shifts_m has the shape {shifts.shape}: allowed is (..., {len(points)}) or a scalar")
    spots = (shifted(geometry, point, shifts[..., index]) for index, point in enumerate(points))
    return np.stack([strain_row(geometry, *spot) for spot in spots], axis=-2)


def condition_number(matrix: npt.ArrayLike) -> float:
    """Return the 2-norm condition number, (n, 3) or (3, n), equal for strain matrix and C; it depends on the units of F
    and the scale of rows. inf: singular; NaN: an entry is not finite. Raises InputError for other shapes."""
    entries = floats("matrix", matrix)
    if entries.ndim != 2 or 3 not in entries.shape or not entries.size:
        raise InputError(f"the matrix has the shape {entries.shape}: allowed are (n, 3) and (3, n)")
    if not np.isfinite(entries).all():
        return float("nan")
    singular = np.linalg.svd(entries, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")


def row_equilibrated_condition_number(matrix: npt.ArrayLike) -> float:
    """Return condition_number() of rows of unit length (inf: a zero row): noise is a share of each range."""
    rows = floats("matrix", matrix)
    largest = np.abs(rows).max(axis=-1, keepdims=True, initial=0.0)
    with np.errstate(invalid="ignore"):
        rows = rows / np.where(largest > 0.0, largest, 1.0)  # squares stay in range
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return condition_number(rows / lengths) if lengths.all() or not rows.size else float("inf")


def noise_gain(C: npt.ArrayLike) -> float:
    """Return sqrt(trace(C C^T)) for C (3, n), in its unit: root sum square of the noise of F per equal gauge noise."""
    entries = floats("C", C)
    largest = float(np.abs(entries).max(initial=0.0))
    return largest * float(np.linalg.norm(entries / largest)) if 0.0 < largest < np.inf else largest
