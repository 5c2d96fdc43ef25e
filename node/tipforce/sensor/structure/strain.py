"""The body (two thin beams in a T, a rigid half-cylinder tip, a rigid fixture), gauges at points of Table 1 or anywhere
along its beams, and their strain per force: linear along a beam, so that a gauge reads the strain at its middle."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.structure.layouts import MAX_GAUGES, MIN_GAUGES, POINTS, VERTICAL_POINTS, Layout, layout

THIN_BEAM_RATIO = math.sqrt(8.0 / 3.0)
"""h2 / h1 that makes the largest stresses of both beams equal for a = d = r (section 3.1: 1.633)."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """One body, symbols of figure 2: the horizontal beam of 2 a carries the tip at its ends, the vertical beam joins
    its middle to the fixture. Raises InputError, naming the field, unless positive and finite."""

    a_m: float
    """Half the length of the horizontal beam: from the joint to one outer end."""
    d_m: float
    """Length of the vertical beam."""
    r_m: float
    """Radius of the tip, whose centre is the middle of the horizontal beam."""
    h1_m: float
    """Thickness of the horizontal beam."""
    h2_m: float
    """Thickness of the vertical beam."""
    width_m: float
    """Width of both beams, normal to the plane of the forces."""
    youngs_modulus_pascals: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0.0 < value < math.inf:
                raise InputError(f"geometry {field.name} = {value!r}: allowed is a positive finite number in SI units")

    def thin(self, h1_m: float) -> Geometry:
        """Return the same body with h1_m and h2 = sqrt(8/3) h1 (section 3.1); h1_m -> 0 is the thin limit."""
        return replace(self, h1_m=h1_m, h2_m=THIN_BEAM_RATIO * h1_m)


FABRICATED = Geometry(
    a_m=15e-3, d_m=15e-3, r_m=15e-3, h1_m=0.4e-3, h2_m=0.653e-3, width_m=10e-3, youngs_modulus_pascals=205e9
)
"""The body of section 4.2 (its "b" is d); Young's modulus is assumed, for steel AISI 4340."""

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
    if point not in POINTS:
        raise InputError(f"gauge point {point!r} is not known: allowed are {', '.join(POINTS)}")
    beam: Beam = "V" if point in VERTICAL_POINTS else "H"
    outer = geometry.d_m if beam == "V" else geometry.a_m
    return GaugePosition(beam, "left" if point[0] in "LTK" else "right", 0.0 if point[0] in "KS" else outer)


def strain_row(
    geometry: Geometry, beam: Beam, side: Side, position_m: npt.ArrayLike, face: Face = "lower"
) -> FloatArray:
    """Return the strain per newton of F, (..., 3), tension positive, at positions (...): Table 1 at the eight points,
    linear between them. Raises InputError for an unknown beam, side or face, or a position off the beam."""
    if beam not in ("H", "V") or side not in ("left", "right") or face not in ("lower", "upper"):
        raise InputError(
            f"gauge place beam {beam!r}, side {side!r}, face {face!r}: allowed are H or V, left or right, "
            "lower or upper"
        )
    length = geometry.a_m if beam == "H" else geometry.d_m
    s = floats("position_m", position_m)
    if not bool(np.all((s >= -_SLACK * length) & (s <= (1.0 + _SLACK) * length))):
        raise InputError(f"position_m = {position_m!r} on beam {beam}: allowed is 0 to {length!r} m from the joint")
    with np.errstate(over="ignore"):
        stress = np.stack(unit_stress(geometry, beam, side, s, face), axis=-1)
        return stress / geometry.width_m / geometry.youngs_modulus_pascals


def unit_stress(
    geometry: Geometry, beam: Beam, side: Side, s: FloatArray, face: Face
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the stress per newton of F1, F2, F3 for unit width, tension positive, at distances s from the joint."""
    a, r, h1, h2 = geometry.a_m, geometry.r_m, geometry.h1_m, geometry.h2_m
    sign = -1.0 if side == "left" else 1.0
    if beam == "V":  # a cantilever that carries the whole load at its top
        moment = np.full_like(s, sign * 6.0 * r / h2 / h2)
        return np.full_like(s, 1.0 / h2), moment, -sign * 6.0 * (s + 0.5 * h1) / h2 / h2
    # Each arm is clamped to the joint at s = 0 and to the rigid tip at s = a.
    bend = 1.0 if face == "lower" else -1.0
    shear = bend * (1.5 * a / h1 / h1) * (1.0 - 2.0 * s / a)
    moment = bend * sign * (3.0 * r / h1 / h1) * (1.0 - 1.5 * s / a)
    # Half of the force along x reaches the joint through either arm: one in tension, one in compression.
    return shear, moment, np.full_like(s, sign * 0.5 / h1)


def position_matrix(geometry: Geometry, positions: Sequence[GaugePosition]) -> FloatArray:
    """Return the strain matrix (n, 3) of gauges at these positions, tension positive. Raises as strain_row() does."""
    return np.array([strain_row(geometry, *position) for position in positions], dtype=np.float64).reshape(-1, 3)


Gauge = str | GaugePosition
"""A point of Table 1 by its name, or a place along a beam."""


def place(geometry: Geometry, gauge: Gauge) -> GaugePosition:
    """Return the position of a gauge. Raises InputError for an unknown point."""
    return nominal_position(geometry, gauge) if isinstance(gauge, str) else gauge


def check_gauges(geometry: Geometry, gauges: Sequence[Gauge]) -> tuple[Gauge, ...]:
    """Return the gauges, SG1 first: 3 to 8 places, known, on their beams, no two the same; else raises InputError."""
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
    """Return the strain per newton of F, (n, 3), tension positive: Table 1, continuous. Raises as check_gauges()."""
    A = position_matrix(geometry, [place(geometry, gauge) for gauge in check_gauges(geometry, gauges)])
    if not np.isfinite(A).all():
        raise InputError(f"h1_m = {geometry.h1_m!r}, h2_m = {geometry.h2_m!r}: too thin, the strain is not finite")
    return A


def gauge_name(gauge: Gauge) -> str:
    """Return the gauge for display: `K_H`, or `H right 1.33` (beam, side, millimetres from the joint)."""
    if isinstance(gauge, str):
        return gauge
    upper = " upper" if gauge.beam == "H" and gauge.face == "upper" else ""
    return f"{gauge.beam} {gauge.side}{upper} {1e3 * gauge.position_m:.2f}"


def strain_matrix(geometry: Geometry, gauges: Layout) -> FloatArray:
    """Return the strain per newton of F, shape (n, 3), tension positive for every gauge: Table 1 over width and E.
    Raises InputError for an unusable layout, or a beam too thin for floating point."""
    return gauge_matrix(geometry, layout(gauges))


def calibration_matrix(geometry: Geometry, gauges: Layout) -> FloatArray:
    """Return C of equation (1), (3, n), N per unit strain: pinv of strain_matrix(). Raises InputError below rank 3."""
    return pseudo_inverse(strain_matrix(geometry, gauges), layout(gauges))


def pseudo_inverse(matrix: FloatArray, names: Iterable[str]) -> FloatArray:
    """Return C (3, n) of a strain matrix (n, 3). Raises InputError with the gauges' names if its rank is below 3."""
    rank = int(np.linalg.matrix_rank(matrix))
    if rank < 3:
        raise InputError(
            f"the gauges {', '.join(names)} have rank {rank} in this geometry: allowed are layouts of rank 3"
        )
    return np.asarray(np.linalg.pinv(matrix), dtype=np.float64)
