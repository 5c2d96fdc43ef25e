"""Gauges at points of Table 1 or anywhere along the beams: their strain, Table 1 made continuous, and rules for a set.

Between its ends a beam carries no load, so the strain on its surface varies linearly along it. A gauge of finite
length therefore reads the strain at its middle, exactly; one of 1 mm that begins at a corner reads 0.5 mm from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import MAX_GAUGES, MIN_GAUGES, POINTS, Layout, layout
from tipforce.sensor.structure.strain import strain_matrix

Beam = Literal["H", "V"]
Side = Literal["left", "right"]
Face = Literal["lower", "upper"]

_SLACK = 1e-9  # relative: a position of 15 mm in other units is still the end of a beam of 15 mm


class GaugePosition(NamedTuple):
    """Position of the middle of one gauge."""

    beam: Beam
    """H: the horizontal beam, which carries the tip. V: the vertical beam, which is fixed to the fixture."""
    side: Side
    """H: the arm at negative x (left) or positive x (right). V: the face at negative or positive x."""
    position_m: float
    """Distance from the joint along the beam: 0 to a on H (L and R are at a), 0 to d on V (T and U are at d)."""
    face: Face = "lower"
    """H only: the face towards the fixture (lower, position of the paper's gauges) or towards the tip (upper)."""


def nominal_position(geometry: Geometry, point: str) -> GaugePosition:
    """Return the position of a point of Table 1. Raises InputError for an unknown point."""
    places: dict[str, GaugePosition] = {
        "L": GaugePosition("H", "left", geometry.a_m),
        "R": GaugePosition("H", "right", geometry.a_m),
        "T": GaugePosition("V", "left", geometry.d_m),
        "U": GaugePosition("V", "right", geometry.d_m),
        "K_H": GaugePosition("H", "left", 0.0),
        "S_H": GaugePosition("H", "right", 0.0),
        "K_V": GaugePosition("V", "left", 0.0),
        "S_V": GaugePosition("V", "right", 0.0),
    }
    if point not in places:
        raise InputError(f"gauge point {point!r} is not known: allowed are {', '.join(POINTS)}")
    return places[point]


def strain_row(
    geometry: Geometry, beam: Beam, side: Side, position_m: npt.ArrayLike, face: Face = "lower"
) -> FloatArray:
    """Return the strain per newton of F = (F1, F2, F3), shape (..., 3), tension positive, at positions (...).

    The arguments are the fields of GaugePosition. Equals Table 1 (as strain_matrix() returns it) at the eight
    points; between them it is linear: equations (5) and (6) with the lever arm in place of d, and for the
    horizontal beam the straight line from equation (4) to (3) and from (11) to (10). Raises InputError for an
    unknown beam, side or face, or a position off the beam.
    """
    if beam not in ("H", "V") or side not in ("left", "right") or face not in ("lower", "upper"):
        raise InputError(
            f"gauge place beam {beam!r}, side {side!r}, face {face!r}: allowed are H or V, left or right, "
            "lower or upper"
        )
    length = geometry.a_m if beam == "H" else geometry.d_m
    s = floats("position_m", position_m)
    if not bool(np.all((s >= -_SLACK * length) & (s <= (1.0 + _SLACK) * length))):
        raise InputError(f"position_m = {position_m!r} on beam {beam}: allowed is 0 to {length!r} m from the joint")
    sign = -1.0 if side == "left" else 1.0
    stress = _horizontal(geometry, sign, s, face) if beam == "H" else _vertical(geometry, sign, s)
    result: FloatArray = np.stack(stress, axis=-1) / geometry.width_m / geometry.youngs_modulus_pascals
    return result


def position_matrix(geometry: Geometry, positions: list[GaugePosition]) -> FloatArray:
    """Return the strain matrix (n, 3) of gauges at these positions, tension positive. Raises as strain_row() does."""
    return np.array([strain_row(geometry, *position) for position in positions], dtype=np.float64).reshape(-1, 3)


def shifted(geometry: Geometry, gauge: str | GaugePosition, shift_m: float) -> GaugePosition:
    """Return the position shift_m from a point of Table 1, or another position, along its beam.

    Positive is inward: away from the nearer end of the beam. Raises InputError for an unknown point; a shift
    beyond the beam is rejected by strain_row().
    """
    spot = place(geometry, gauge)
    return spot._replace(position_m=spot.position_m + _inward(geometry, spot) * shift_m)


def shifted_matrix(geometry: Geometry, gauges: Layout, shifts_m: npt.ArrayLike) -> FloatArray:
    """Return the strain matrices (..., n, 3) of a layout with gauges shifts_m (..., n) inward of their points.

    shifts_m: sign as in shifted(), one number per gauge in the last axis, or a scalar for all. Raises
    InputError for an unusable layout, a last axis that is not n, or a gauge shifted off its beam.
    """
    points = layout(gauges)
    shifts = floats("shifts_m", shifts_m)
    if shifts.ndim == 0:
        shifts = np.full(len(points), float(shifts))
    if shifts.shape[-1] != len(points):
        raise InputError(f"shifts_m has the shape {shifts.shape}: allowed is (..., {len(points)}) or a scalar")
    rows = []
    for index, point in enumerate(points):
        spot = nominal_position(geometry, point)
        position_m = spot.position_m + _inward(geometry, spot) * shifts[..., index]
        rows.append(strain_row(geometry, spot.beam, spot.side, position_m, spot.face))
    return np.stack(rows, axis=-2)


def _inward(geometry: Geometry, spot: GaugePosition) -> float:
    length = geometry.a_m if spot.beam == "H" else geometry.d_m
    return 1.0 if spot.position_m < 0.5 * length else -1.0


def _horizontal(
    geometry: Geometry, sign: float, s: FloatArray, face: Face
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return stress for unit width: each arm is clamped to the joint at s = 0 and to the rigid tip at s = a."""
    a, r, h1 = geometry.a_m, geometry.r_m, geometry.h1_m
    bend = 1.0 if face == "lower" else -1.0
    shear = bend * (1.5 * a / h1 / h1) * (1.0 - 2.0 * s / a)
    moment = bend * sign * (3.0 * r / h1 / h1) * (1.0 - 1.5 * s / a)
    # Half of the force along x reaches the joint through either arm: one in tension, one in compression.
    axial = np.full_like(s, sign * 0.5 / h1)
    return shear, moment, axial


def _vertical(geometry: Geometry, sign: float, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return stress for unit width, tension positive: a cantilever that carries the whole load at its top."""
    r, h1, h2 = geometry.r_m, geometry.h1_m, geometry.h2_m
    axial = np.full_like(s, 1.0 / h2)
    moment = np.full_like(s, sign * 6.0 * r / h2 / h2)
    return axial, moment, -sign * 6.0 * (s + 0.5 * h1) / h2 / h2


Gauge = str | GaugePosition
"""A point of Table 1 by its name, or a place along a beam."""


def place(geometry: Geometry, gauge: Gauge) -> GaugePosition:
    """Return the position of a gauge. Raises InputError for an unknown point."""
    return nominal_position(geometry, gauge) if isinstance(gauge, str) else gauge


def check_gauges(geometry: Geometry, gauges: Sequence[Gauge]) -> tuple[Gauge, ...]:
    """Return the gauges, SG1 first, if they are valid.

    Raises InputError for fewer than 3 or more than 8, an unknown point, beam, side or face, a position off its
    beam, or two gauges at one place.
    """
    if not MIN_GAUGES <= len(gauges) <= MAX_GAUGES:
        raise InputError(f"a layout of {len(gauges)} gauge points: allowed are {MIN_GAUGES} to {MAX_GAUGES}")
    seen: dict[GaugePosition, Gauge] = {}
    for gauge in gauges:
        spot = place(geometry, gauge)
        strain_row(geometry, *spot)
        if spot.beam == "V":
            spot = spot._replace(face="lower")  # the face has no effect there
        if spot in seen:
            raise InputError(f"gauge point {gauge_name(gauge)} is given more than once: each place is allowed once")
        seen[spot] = gauge
    return tuple(gauges)


def gauge_matrix(geometry: Geometry, gauges: Sequence[Gauge]) -> FloatArray:
    """Return the strain per newton of F, shape (n, 3), tension positive: Table 1, made continuous.

    The points' rows are bit-identical to strain_matrix(). Raises InputError as check_gauges() does, and for
    a beam too thin for floating point.
    """
    check_gauges(geometry, gauges)
    table = dict(zip(POINTS, strain_matrix(geometry, POINTS), strict=True))
    rows = [table[gauge] if isinstance(gauge, str) else strain_row(geometry, *gauge) for gauge in gauges]
    return np.array(rows, dtype=np.float64)


def gauge_name(gauge: Gauge) -> str:
    """Return the gauge for display: `K_H`, or `H right 1.33` (beam, side, millimetres from the joint)."""
    if isinstance(gauge, str):
        return gauge
    upper = " upper" if gauge.beam == "H" and gauge.face == "upper" else ""
    return f"{gauge.beam} {gauge.side}{upper} {1e3 * gauge.position_m:.2f}"
