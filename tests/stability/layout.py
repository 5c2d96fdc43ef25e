"""Extreme bodies and gauge layouts: beams from a nanometre to 10 mm, stiffness ratios, and layouts without rank."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np

from stability.case import Observed, refusal, shortened
from tipforce.sensor.contact import scalar_condition
from tipforce.sensor.structure.layouts import LAYOUTS, POINTS
from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, EULER_BERNOULLI, TIMOSHENKO, Frame
from tipforce.sensor.structure.quality import condition_number, thin_limit_matrix
from tipforce.sensor.structure.strain import FABRICATED, THIN_BEAM_RATIO, Geometry, calibration_matrix, strain_matrix
from tipforce_lab.design.merit import merit

_THICKNESSES_M = 10.0 ** np.arange(-9.0, -1.9, 0.5)


def _off(geometry: Geometry) -> float:
    """Return the largest difference of frame and Table 1, relative to each gauge's largest coefficient."""
    table = strain_matrix(geometry, POINTS)
    frame = Frame(geometry, EULER_BERNOULLI).strain_matrix(POINTS)
    return float((np.abs(frame - table).max(axis=1) / np.abs(table).max(axis=1)).max())


def layout_thickness() -> Observed:
    """h1 from 1e-6 mm to 10 mm, h2 = 1.63 h1, all 8 gauge points -> pass: the frame, solved by stiffness, equals Table
    1 within 1e-10 of each gauge's largest coefficient"""
    worst = max(_off(FABRICATED.thin(float(h1))) for h1 in _THICKNESSES_M)
    return worst <= 1e-10, f"largest difference {worst:.1e} over {len(_THICKNESSES_M)} thicknesses"


def layout_stiffness_ratio() -> Observed:
    """h2 / h1 from 1/464 to 464: bending stiffnesses to 1 : 1e8 -> pass: the frame equals Table 1 within 1e-10 of each
    gauge's largest coefficient"""
    worst = 0.0
    for power in np.arange(-8.0, 8.1, 1.0):
        ratio = 10.0 ** (power / 3.0)
        h1 = 1e-5 if power > 0.0 else 5e-3
        worst = max(worst, _off(replace(FABRICATED, h1_m=h1, h2_m=h1 * ratio)))
    return worst <= 1e-10, f"largest difference {worst:.1e} over stiffness ratios 1e-8 to 1e8"


def layout_models() -> Observed:
    """the same with shear and elastic roots, h1 from 1e-6 to 10 mm -> bounded: strains are finite and differ from beam
    theory by less as the beams get thinner, to 1e-5 at 1e-6 mm"""
    figures, held = [], True
    for name, model in (("shear", TIMOSHENKO), ("elastic roots", ELASTIC_ROOTS)):
        offs = []
        for h1 in _THICKNESSES_M:
            geometry = FABRICATED.thin(float(h1))
            table, frame = strain_matrix(geometry, POINTS), Frame(geometry, model).strain_matrix(POINTS)
            held &= bool(np.isfinite(frame).all())
            offs.append(float(np.abs(frame - table).max() / np.abs(table).max()))
        # Below 1e-12 is rounding.
        held &= offs[0] <= 1e-5 and all(a <= b + 1e-12 for a, b in itertools.pairwise(offs))
        figures.append(f"{name} {offs[0]:.0e} to {offs[-1]:.0e}")
    return held, "; ".join(figures)


def layout_thin_limit() -> Observed:
    """cases I, II, III and their mirrors at h1 = 1e-6 mm, in the limit's units -> pass: their condition numbers equal
    those of the thin limit within 1e-5"""
    worst = 0.0
    for name in LAYOUTS:
        exact = condition_number(thin_limit_matrix(name))
        worst = max(worst, abs(condition_number(strain_matrix(FABRICATED.thin(1e-9), name)) / exact - 1.0))
    return worst <= 1e-5, f"{len(LAYOUTS)} layouts, largest difference {worst:.1e}"


def layout_too_thin() -> Observed:
    """h1 = 1e-160 m, 1e-300 m and 5e-324 m, or 1e200 m -> refused: InputError says too thin or too thick; no infinity
    or NaN comes out"""
    said = []
    for h1 in (1e-160, 1e-300, 5e-324, 1e200):
        geometry = replace(FABRICATED, h1_m=h1, h2_m=THIN_BEAM_RATIO * h1)
        said.append(refusal(strain_matrix, geometry, "III") if h1 < 1.0 else "too thick")
        said.append(refusal(Frame, geometry))
    return all("too thin" in text or "too thick" in text for text in said), shortened(said[1], 90)


def layout_impossible() -> Observed:
    """0, negative, NaN, infinite or boolean dimensions in each of 7 fields -> refused: InputError names the field"""
    impossible = (0.0, -1e-3, math.nan, math.inf, -math.inf, True)
    tried = [(name, partial(replace, FABRICATED, **{name: value}))
             for name in FABRICATED.__dataclass_fields__ for value in impossible]  # fmt: skip
    named = sum(name in refusal(change) for name, change in tried)
    return len(tried) == named == 42, f"{named} of {len(tried)} refused by name"


def layout_condition_1e14() -> Observed:
    """condition numbers known exactly, from 10 to 1e14 -> bounded: both algorithms, numpy's and the node's, are off by
    at most 8 x 2^-52 x the condition number"""
    worst = 0.0
    for power in range(3, 47):
        e = 2.0**-power
        rows = [[1.0, 1.0, 0.0], [1.0, 1.0 + e, 0.0], [0.0, 0.0, 1.0]]
        trace = 2 + (1 + Fraction(e)) ** 2 + 1  # of A A^T without the 1 of the last row: s1^2 + s2^2
        # s1 s2 = e and s1^2 + s2^2 = trace: s1^2 = (trace + sqrt(trace^2 - 4 e^2)) / 2, no cancellation.
        largest_squared = (float(trace) + math.sqrt(float(trace**2 - 4 * Fraction(e) ** 2))) / 2.0
        exact = largest_squared / e
        for found in (condition_number(rows), scalar_condition.condition_number(rows)):
            worst = max(worst, abs(found / exact - 1.0) / (exact * 2.0**-52))
    return worst <= 8.0, f"worst error {worst:.2f} x 2^-52 x condition number, up to {exact:.1e}"


def layout_condition_graded() -> Observed:
    """rows that differ by up to 1e200, orthogonal and nearly so -> bounded: the node's Jacobi keeps every singular
    value to 1e-12"""
    worst = 0.0
    for grade in (1e-14, 1e-50, 1e-150):
        rows = [[1.0, 1.0, 0.0], [grade, -grade, grade], [1.0, -1.0, 1.0]]
        # Rows 2 and 3 are parallel: a third direction makes them independent again.
        rows[2] = [1.0, -1.0, -2.0]
        exact = math.sqrt(6.0) / (math.sqrt(3.0) * grade)
        worst = max(worst, abs(scalar_condition.condition_number(rows) / exact - 1.0))
        tilted = [rows[0], [grade, -grade * 0.5, grade], rows[2]]
        # The part of row 2 across rows 0 and 2, by projection in exact fractions.
        across = _across([[Fraction(x) for x in row] for row in tilted])
        exact = math.sqrt(6.0) / math.sqrt(float(across / Fraction(grade) ** 2)) / grade
        worst = max(worst, abs(scalar_condition.condition_number(tilted) / exact - 1.0))
    return worst <= 1e-12, f"worst relative error {worst:.1e} of condition numbers up to 1e150"


def _across(rows: list[list[Fraction]]) -> Fraction:
    """Return the squared length of row 1 orthogonal to rows 0 and 2, which are orthogonal to each other."""

    def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
        return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))

    return dot(rows[1], rows[1]) - sum((dot(rows[1], row) ** 2 / dot(row, row) for row in (rows[0], rows[2])),
                                       Fraction(0))  # fmt: skip


def layout_singular() -> Observed:
    """a row of zeros, two equal rows, all zero, NaN -> flagged: the condition number is infinite or above 1e15; NaN for
    NaN: no limit accepts it"""
    matrices = {
        "a row of zeros": [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [3.0, 1.0, 2.0]],
        "two equal rows": [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [3.0, 1.0, 2.0]],
        "all zero": [[0.0] * 3] * 3,
    }
    least = min(min(condition_number(rows), scalar_condition.condition_number(rows)) for rows in matrices.values())
    nan = scalar_condition.condition_number([[1.0, 2.0, math.nan], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return least > 1e15 and math.isnan(nan) and not nan <= math.inf, f"least {least:.1e}; with NaN {nan}"


def layout_rank_2() -> Observed:
    """L, R, K_H on one beam: rank 2 in the thin limit, condition to 1e14 before -> refused: calibration_matrix()
    refuses once rank 3 is lost to rounding; before, C A = I within 1e-16 x condition"""
    gauges = ("L", "R", "K_H")
    held, refused, largest = True, 0, 0.0
    for h1 in 10.0 ** np.arange(-17.0, -2.9, 1.0):
        geometry = FABRICATED.thin(float(h1))
        A = strain_matrix(geometry, gauges)
        kappa = condition_number(A)
        said = refusal(calibration_matrix, geometry, gauges)
        if said:
            refused += 1
            held &= "rank" in said and kappa > 1e14
            continue
        off = float(np.abs(calibration_matrix(geometry, gauges) @ A - np.eye(3)).max())
        held &= off <= 8.0 * 2.0**-52 * kappa
        largest = max(largest, kappa)
    return held and refused > 0 and largest > 1e13, f"C up to condition {largest:.1e}, {refused} thinner bodies refused"


def layout_merit_of_rank_2() -> Observed:
    """the design figures of a layout of rank 2 -> flagged: uncertainties and condition number are infinite: it is never
    selected"""
    A = strain_matrix(FABRICATED, "III")
    A[2] = 2.0 * A[0]
    found = merit(A, 0.3, 4.4)
    figures = found.u_P_newtons, found.u_phi_deg, found.u_theta_deg, found.noise_gain_newtons, found.condition_number
    return all(map(math.isinf, figures)), f"u_P {found.u_P_newtons}, condition number {found.condition_number}"
