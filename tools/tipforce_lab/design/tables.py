"""Tables 1, 2 and 3 of the paper, recomputed. Tension is positive, except in table_1(); angles are in degrees."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import atan2, cos, degrees, hypot, inf, pi, radians, sin
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.sensor import Geometry, force_vector
from tipforce.sensor.structure import quality, strain
from tipforce.sensor.structure.layouts import CASES, LAYOUTS, POINTS, VERTICAL_POINTS, Layout

Record = dict[str, Any]
MM, MICRO = 1e3, 1e6


@dataclass(frozen=True, slots=True)
class Section:
    """A table with its notes. Records have the same keys; some may be missing."""

    name: str
    """Name in `tipforce design table`."""
    title: str
    columns: dict[str, str]
    """Heading per key of a record, in order; keys that are not here are for JSON only. "key.2" is an item of a list."""
    records: list[Record]
    notes: list[str] = field(default_factory=list)
    """Differences from the paper's numbers, with reasons."""


class PrintedMaximum(NamedTuple):
    """One row of Table 2, in units of a P / h1^2 with h2 = 1.633 h1 (its last column)."""

    theta_deg: float
    phi_deg: float
    maximum: float


TABLE_2 = {
    "L": PrintedMaximum(180.0, 90.0, 3.0),
    "R": PrintedMaximum(180.0, -90.0, 3.0),
    "T": PrintedMaximum(0.0, 90.0, 4.5),
    "U": PrintedMaximum(0.0, -90.0, 4.5),
    "K_H": PrintedMaximum(180.0, 90.0, 4.5),
    "S_H": PrintedMaximum(0.0, 90.0, 4.5),
    "K_V": PrintedMaximum(0.0, 90.0, 2.25),
    "S_V": PrintedMaximum(0.0, -90.0, 2.25),
}

TABLE_3_THEORY = {"I": 2.55, "II": 2.62, "III": 2.69}
TABLE_3_SIMULATION = {"I": 2.53, "II": 3.36, "III": 3.94}
"""Finite elements (ANSYS)."""
TABLE_3_MEASUREMENT = {"I": 3.50, "II": 3.50, "III": 3.34}

MEASURED_MATRICES = {
    "I": ((0.673, 0.594, -0.019), (-0.280, 0.238, 0.002), (-0.379, 0.317, 0.997)),
    "II": ((-0.909, 0.373, -0.021), (0.377, 0.349, 0.003), (0.513, 0.471, 1.102)),
    "III": ((-0.658, -0.813, -0.023), (0.608, -0.755, -0.011), (0.825, -1.016, 1.093)),
}
"""Section 4.3: C of equation (1) "without scaling", hence in a unit of its own; three decimals."""
HALF_DIGIT = 0.0005
CALIBRATION_THETA_DEG = (0.0, 90.0)
"""Section 4.3: the grooves between which the matrices were fitted."""


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
    strains = strain.strain_matrix(geometry, POINTS).tolist()
    stresses = quality.stress_coefficients(geometry)
    return [
        Table1Row(point, SYMBOLS[point], stresses[point], (row[0], row[1], row[2]))
        for point, row in zip(POINTS, strains, strict=True)
    ]


def maximum_over_contacts(g: tuple[float, float, float]) -> Maximum:
    """Return the largest reading over theta in [0, 180] and all phi, in closed form: the squared amplitude over phi,
    g1^2 + g2^2 + g3^2 + 2 g2 (g1 cos(theta) - g3 sin(theta)), is a cosine of theta."""
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
    for point, thin, row in zip(POINTS, quality.thin_limit_matrix(POINTS).tolist(), table_1(geometry), strict=True):
        sign = -unit if point in VERTICAL_POINTS else unit
        g1, g2, g3 = row.per_metre
        rows.append(Table2Row(
            point, maximum_over_contacts((thin[0] * THIN_UNIT, thin[1] * THIN_UNIT, thin[2] * THIN_UNIT)),
            maximum_over_contacts((sign * g1, sign * g2, sign * g3)),
            maximum_over_contacts(row.strain_per_newton).value,
        ))  # fmt: skip
    return rows


def table_3(geometry: Geometry, gauges: Layout) -> Table3Row:
    """Return the theory of one layout. Raises InputError for an unusable layout or one of rank below 3."""
    matrix = strain.strain_matrix(geometry, gauges)
    return Table3Row(
        quality.condition_number(quality.thin_limit_matrix(gauges)), quality.condition_number(matrix),
        quality.row_equilibrated_condition_number(matrix),
        quality.noise_gain(strain.calibration_matrix(geometry, gauges)),
    )  # fmt: skip


def condition_numbers_by_unit(geometry: Geometry, gauges: Layout) -> dict[str, float]:
    """Return the condition number with F2 as M / r (the paper's), and as moment in N mm and N m. Raises InputError."""
    return {unit: condition_at_length(geometry, gauges, u) for unit, u in moment_units(geometry).items()}


def moment_units(geometry: Geometry) -> dict[str, float]:
    """Return the units in which moments are stated, as lengths in metres."""
    return {"M/r": geometry.r_m, "N mm": 1e-3, "N m": 1.0}


def condition_at_length(geometry: Geometry, gauges: Layout, length_m: float) -> float:
    """Return the condition number with F2 as the force M / length."""
    return quality.condition_number(
        strain.strain_matrix(geometry, gauges) * np.array([1.0, length_m / geometry.r_m, 1.0])
    )


def figures(matrix: FloatArray) -> Record:
    """Return the figures of merit of a strain matrix (n, 3); infinite if it cannot separate the three forces."""
    if int(np.linalg.matrix_rank(matrix)) < 3:
        return dict.fromkeys(("condition", "row_equilibrated", "noise_gain_N_per_ue"), inf)
    return {
        "condition": quality.condition_number(matrix),
        "row_equilibrated": quality.row_equilibrated_condition_number(matrix),
        "noise_gain_N_per_ue": quality.noise_gain(np.linalg.pinv(matrix)) / MICRO,
    }


def ranked_layouts(geometry: Geometry, by: str = "condition") -> list[Record]:
    """Return the 28 mirrored pairs of layouts of three points, which share every figure, best first: case (I, II, III,
    or empty), gauges, mirror, and what ``by`` may be: the keys of figures(), and thin, the limit of the condition."""
    names = {frozenset(LAYOUTS[name]): name.rstrip("'") for name in LAYOUTS}
    rows: list[Record] = []
    seen: set[frozenset[str]] = set()
    for chosen in itertools.combinations(POINTS, 3):
        if frozenset(quality.mirror(chosen)) in seen:
            continue
        seen.add(frozenset(chosen))
        case = names.get(frozenset(chosen), "")
        points = LAYOUTS[case] if case else chosen
        thin = quality.condition_number(quality.thin_limit_matrix(points))
        rows.append({
            "case": case, "gauges": points, "mirror": quality.mirror(points),
            **figures(strain.strain_matrix(geometry, points)),
            "thin": thin if thin < 1e12 else inf,  # singular: rounding makes it barely regular
        })  # fmt: skip
    return sorted(rows, key=lambda row: (round(row[by], 9), row["condition"]))


def ties(rows: list[Record], by: str) -> list[list[Record]]:
    """Return the groups of rows whose figures agree to 1e-6, in order; infinite ones left out."""
    groups: list[list[Record]] = []
    for row in rows:
        if not groups or not abs(row[by] - groups[-1][0][by]) <= 1e-6 * groups[-1][0][by]:
            groups.append([])
        groups[-1].append(row)
    return [group for group in groups if len(group) > 1]


class RoundingRange(NamedTuple):
    """Condition number of the printed entries themselves, and its range for matrices that print as they do."""

    printed: float
    low: float
    high: float


def rounding_range(matrix: npt.ArrayLike) -> RoundingRange:
    """Return the condition numbers of all (3, 3) that round to the given one, by the 512 corners of the entries."""
    centre = np.asarray(matrix, dtype=np.float64)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=centre.size))).reshape(-1, *centre.shape)
    conditions = np.linalg.cond(centre + HALF_DIGIT * signs)
    return RoundingRange(quality.condition_number(centre), float(conditions.min()), float(conditions.max()))


def shared_gauge_disagreement() -> dict[str, float]:
    """Return per gauge of several cases the difference of its rows, which must be one, relative to the longest."""
    rows: dict[str, list[FloatArray]] = {"S_H": [], "L": [], "U": []}
    for case in CASES:
        for point, row in zip(LAYOUTS[case], np.linalg.inv(np.array(MEASURED_MATRICES[case])), strict=True):
            rows.setdefault(point, []).append(row)
    shared = {point: np.array(of_point) for point, of_point in rows.items() if len(of_point) > 1}
    return {point: float(np.ptp(each, axis=0).max() / np.abs(each).max()) for point, each in shared.items()}


def nearest_common_shifts(
    geometry: Geometry, conditions: dict[str, float], steps: int = 25
) -> tuple[dict[str, float], float]:
    """Return (metres inward of K, S, L, R, U, 0 to 6 mm, that best fit the condition numbers; the largest miss)."""
    grid = np.linspace(0.0, 6e-3, steps)
    points = ("K_H", "S_H", "L", "R", "U")
    rows = quality.shifted_matrix(geometry, points, np.repeat(grid[:, np.newaxis], len(points), axis=1))
    chosen, miss = nearest_common({point: rows[:, k] for k, point in enumerate(points)}, conditions)
    return {point: float(grid[at]) for point, at in chosen.items()}, miss


def nearest_common(rows: Mapping[str, FloatArray], conditions: Mapping[str, float]) -> tuple[dict[str, int], float]:
    """Return (index of the place of each gauge, largest miss) that best fit the condition numbers of the cases. rows:
    strain per newton (m, 3) of K, S, L, R, U at m places each. K (case I) and R (III) are chosen last, each alone."""
    missed = {}
    for case in CASES:
        first, second, third = (rows[point] for point in LAYOUTS[case])
        grids = first[:, None, None], second[None, :, None], third[None, None, :]
        stacked = np.stack(np.broadcast_arrays(*grids), axis=-2)
        missed[case] = np.abs(np.linalg.cond(stacked) - conditions[case])
    one, three = missed["I"].min(axis=0), missed["III"].min(axis=1)  # [S, U] over K, [L, U] over R
    worst = np.maximum(missed["II"], np.maximum(one[np.newaxis], three[:, np.newaxis]))  # [L, S, U]
    L, S, U = (int(index) for index in np.unravel_index(int(worst.argmin()), worst.shape))
    K, R = int(missed["I"][:, S, U].argmin()), int(missed["III"][L, :, U].argmin())
    return {"K_H": K, "S_H": S, "L": L, "R": R, "U": U}, float(worst.min())
