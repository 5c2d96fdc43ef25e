"""Tables 1, 2 and 3 of the paper, recomputed: coefficients, largest stresses and places, condition numbers by unit.

Tension is positive everywhere, except in table_1(), which keeps the paper's signs. Angles are in degrees here, because
the tables print degrees.
"""

from __future__ import annotations

from math import atan2, cos, degrees, hypot, pi, radians, sin
from typing import NamedTuple

import numpy as np

from tipforce.sensor.contact.force import force_vector
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import POINTS, VERTICAL_POINTS, Layout
from tipforce.sensor.structure.strain import (
    calibration_matrix,
    condition_number,
    noise_gain,
    row_equilibrated_condition_number,
    strain_matrix,
    stress_coefficients,
    thin_limit_matrix,
)

SYMBOLS = {
    "L": ("-3/2 * a/h1^2", "3/2 * r/h1^2", "-1/(2*h1)"),
    "R": ("-3/2 * a/h1^2", "-3/2 * r/h1^2", "1/(2*h1)"),
    "T": ("-1/h2", "6*r/h2^2", "-6/h2^2 * (d + h1/2)"),
    "U": ("-1/h2", "-6*r/h2^2", "6/h2^2 * (d + h1/2)"),
    "K_H": ("3/2 * a/h1^2", "-3*r/h1^2", "-1/(2*h1)"),
    "S_H": ("3/2 * a/h1^2", "3*r/h1^2", "1/(2*h1)"),
    "K_V": ("-1/h2", "6*r/h2^2", "-3*h1/h2^2"),
    "S_V": ("-1/h2", "-6*r/h2^2", "3*h1/h2^2"),
}
"""Table 1 as formulas for (g1, g2, g3), stress times width per newton; ^ is a power."""

THIN_UNIT = 1.5
"""thin_limit_matrix() has the unit 3/2 a / h1^2, Table 2 the unit a / h1^2."""


class Table1Row(NamedTuple):
    """One gauge point of Table 1."""

    point: str
    symbols: tuple[str, str, str]
    per_metre: tuple[float, float, float]
    """g1, g2, g3 in 1/m, the paper's signs."""
    strain_per_newton: tuple[float, float, float]
    """Tension positive, divided by width and Young's modulus."""


class Maximum(NamedTuple):
    """Largest value of P (g1 sin(phi) + g2 sin(phi - theta) + g3 cos(phi)) for P = 1, and its angles."""

    value: float
    theta_deg: float
    """0 to 180. NaN: reached at every theta."""
    phi_deg: float
    """In (-180, 180]; phi + 180 gives the same with the opposite sign. For theta = NaN: phi - theta."""


class Table2Row(NamedTuple):
    """One gauge point of Table 2, all stresses in units of a P / h1^2."""

    point: str
    thin: Maximum
    fabricated: Maximum
    strain_per_newton: float
    """The largest, in the actual dimensions."""


class Table3Row(NamedTuple):
    """The theory column of Table 3 for one layout."""

    thin: float
    """Condition number in the thin-beam limit, as printed in the paper."""
    actual: float
    row_equilibrated: float
    noise_gain_newtons: float
    """sqrt(trace(C C^T)), newtons per unit strain, in the actual dimensions."""


def table_1(geometry: Geometry) -> list[Table1Row]:
    """Return Table 1 for all eight gauge points. Raises InputError for beams too thin for floating point."""
    strains = strain_matrix(geometry, POINTS).tolist()
    stresses = stress_coefficients(geometry)
    return [
        Table1Row(point, SYMBOLS[point], stresses[point], (row[0], row[1], row[2]))
        for point, row in zip(POINTS, strains, strict=True)
    ]


def maximum_over_contacts(g: tuple[float, float, float]) -> Maximum:
    """Return the largest reading over theta in [0, 180] and all phi, in closed form.

    For fixed theta the reading is a sine of phi with the squared amplitude g1^2 + g2^2 + g3^2 + 2 g2 (g1
    cos(theta) - g3 sin(theta)): a cosine of theta, largest at one angle, or at an end of the range.
    """
    g1, g2, g3 = g
    if g2 == 0.0 or hypot(g1, g3) < 1e-12 * abs(g2):
        value = abs(g2) if g2 != 0.0 else hypot(g1, g3)
        return Maximum(value, float("nan"), (90.0 if g2 > 0.0 else -90.0) if g2 else degrees(atan2(g1, g3)))
    theta = atan2(-g2 * g3, g2 * g1)
    if not 0.0 <= theta <= pi:
        theta = 0.0 if abs(theta) < 0.5 * pi else pi
    up, along = g1 + g2 * cos(theta), g3 - g2 * sin(theta)
    # Rounded: sin(180 degrees) is not exactly zero, and -0 or 180 - 1e-14 degrees print badly.
    return Maximum(hypot(up, along), round(degrees(theta), 9) + 0.0, round(degrees(atan2(up, along)), 9) + 0.0)


def reading(g: tuple[float, float, float], theta_deg: float, phi_deg: float) -> float:
    """Return g1 sin(phi) + g2 sin(phi - theta) + g3 cos(phi)."""
    return float(np.dot(g, force_vector(1.0, radians(phi_deg), radians(theta_deg))))


def table_2(geometry: Geometry) -> list[Table2Row]:
    """Return the largest stress at every gauge point, thin limit and actual. Raises InputError as table_1()."""
    unit = geometry.h1_m**2 / geometry.a_m
    rows = []
    for point, thin, row in zip(POINTS, thin_limit_matrix(POINTS).tolist(), table_1(geometry), strict=True):
        sign = -unit if point in VERTICAL_POINTS else unit
        g1, g2, g3 = row.per_metre
        rows.append(
            Table2Row(
                point,
                maximum_over_contacts((thin[0] * THIN_UNIT, thin[1] * THIN_UNIT, thin[2] * THIN_UNIT)),
                maximum_over_contacts((sign * g1, sign * g2, sign * g3)),
                maximum_over_contacts(row.strain_per_newton).value,
            )
        )
    return rows


def table_3(geometry: Geometry, gauges: Layout) -> Table3Row:
    """Return the theory of one layout. Raises InputError for an unusable layout or one of rank below 3."""
    matrix = strain_matrix(geometry, gauges)
    return Table3Row(
        condition_number(thin_limit_matrix(gauges)),
        condition_number(matrix),
        row_equilibrated_condition_number(matrix),
        noise_gain(calibration_matrix(geometry, gauges)),
    )


def condition_numbers_by_unit(geometry: Geometry, gauges: Layout) -> dict[str, float]:
    """Return the condition number with F2 as the force M / r (the paper's), and with the moment in N mm and N m.

    A number in the unit M / u is F2 r / u, so its column of the strain matrix shrinks by r / u. Raises InputError
    for an unusable layout.
    """
    matrix = strain_matrix(geometry, gauges)
    metres = {"M/r": geometry.r_m, "N mm": 1e-3, "N m": 1.0}
    return {unit: condition_number(matrix * np.array([1.0, u / geometry.r_m, 1.0])) for unit, u in metres.items()}
