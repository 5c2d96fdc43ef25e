"""The comparators [5] and [11], other materials and smaller bodies: strain, noise and largest load, by beam theory.
Material values are assumed (the paper names AISI 4340 alone): replace them by a data sheet's. Yield is static."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.dynamics.model import half_cylinder, modes
from tipforce.sensor.structure import quality, strain
from tipforce.sensor.structure.layouts import CALIBRATION_WEIGHT_NEWTONS, CASES, GAUGE_LENGTH_M, Layout
from tipforce.sensor.structure.plane_frame import PAPER_SLIT_M, slit_closure, worst_stress
from tipforce.sensor.structure.strain import Geometry
from tipforce_lab.design import tables
from tipforce_lab.design.tables import MICRO, MM, Record, Section

COMPARATORS = (("[5]", 6, 4.2), ("[11]", 3, 20.05))
"""Reference, axes and printed condition number of the sensors that the paper compares with (section 1)."""


def condition_range(condition: float, from_length_m: float, to_length_m: float) -> tuple[float, float]:
    """Return the condition numbers possible on another scale: f = to / from changes one by at most max(f, 1 / f)."""
    factor = max(to_length_m / from_length_m, from_length_m / to_length_m)
    return max(1.0, condition / factor), condition * factor


def lengths_of_condition(geometry: Geometry, gauges: Layout, condition: float) -> tuple[float, ...]:
    """Return the lengths (m) at which a layout has a condition number, one to either side of the best, by bisection."""
    best = best_length(geometry, gauges)
    lengths = []
    for end in (-6.0, 6.0):
        near, far = 0.0, end
        for _ in range(60):
            middle = 0.5 * (near + far)
            below = tables.condition_at_length(geometry, gauges, best * 10.0**middle) < condition
            near, far = (middle, far) if below else (near, middle)
        lengths.append(best * 10.0**near)
    return tuple(lengths)


def best_length(geometry: Geometry, gauges: Layout) -> float:
    """Return the length (m) with the smallest condition number, to 1e-4, between r / 100 and 100 r."""
    low, high = -2.0, 2.0
    for _ in range(6):
        steps: FloatArray = np.linspace(low, high, 41)
        values = [tables.condition_at_length(geometry, gauges, geometry.r_m * 10.0**step) for step in steps.tolist()]
        at, width = int(np.argmin(values)), steps[1] - steps[0]
        low, high = float(steps[at] - width), float(steps[at] + width)
    return float(geometry.r_m * 10.0 ** (0.5 * (low + high)))


class Material(NamedTuple):
    """An elastic material, isotropic."""

    name: str
    youngs_modulus_pascals: float
    yield_pascals: float
    density_kg_m3: float


STEEL_4340 = Material("AISI 4340, hardened", 205e9, 1080e6, 7850.0)
MATERIALS = (
    STEEL_4340,
    Material("17-4 PH, H900", 197e9, 1170e6, 7800.0),
    Material("AISI 304, annealed", 193e9, 215e6, 8000.0),
    Material("Ti-6Al-4V, annealed", 114e9, 880e6, 4430.0),
    Material("CuBe C17200, hardened", 128e9, 1000e6, 8250.0),
    Material("Al 7075-T6", 71.7e9, 503e6, 2810.0),
)


def figures_of(geometry: Geometry, material: Material, gauges: Layout) -> Record:
    """Return the figures of a body of a material, keys of _FIGURES_COLUMNS. Raises InputError for the layout."""
    body = replace(geometry, youngs_modulus_pascals=material.youngs_modulus_pascals)
    stress, noise = worst_stress(body, 1.0), quality.noise_gain(strain.calibration_matrix(body, gauges))
    moving = modes(body, 0.0, half_cylinder(body, material.density_kg_m3))
    yield_newtons, slit_newtons = material.yield_pascals / stress, PAPER_SLIT_M / slit_closure(body, 1.0)
    largest = min(yield_newtons, slit_newtons)
    return {
        "strain_ue": stress / material.youngs_modulus_pascals * CALIBRATION_WEIGHT_NEWTONS * MICRO,
        "noise_gain_N_per_ue": noise / MICRO, "yield_N": yield_newtons, "slit_N": slit_newtons, "largest_N": largest,
        "range_over_noise": largest / noise * MICRO, "frequency_hz": float(min(moving.omega_rad_s)) / (2.0 * math.pi),
    }  # fmt: skip


def scaled(geometry: Geometry, scale: float, gauges: Layout, keep_thickness: bool) -> Record:
    """Return the record of a body with lengths and width times ``scale``; thicknesses as well, or kept."""
    g = geometry
    body = replace(g, a_m=scale * g.a_m, d_m=scale * g.d_m, r_m=scale * g.r_m, width_m=scale * g.width_m)
    if not keep_thickness:
        body = replace(body, h1_m=scale * g.h1_m, h2_m=scale * g.h2_m)
    half = 0.5 * GAUGE_LENGTH_M
    matrix = strain.strain_matrix(body, gauges)
    off = [half] * (len(matrix) - 1) + [half + 0.2e-3]
    return {
        "beams": "kept" if keep_thickness else "scaled", "r_mm": body.r_m * MM,
        "h_mm": [body.h1_m * MM, body.h2_m * MM], "slenderness": body.a_m / body.h1_m,
        **figures_of(body, STEEL_4340, gauges), "condition": quality.condition_number(matrix),
        "condition_of_gauges": quality.condition_number(quality.shifted_matrix(body, gauges, half)),
        "condition_of_shift": quality.condition_number(quality.shifted_matrix(body, gauges, off)),
    }  # fmt: skip


SCALES = (1.0, 0.75, 0.5, 1.0 / 3.0, 0.25)


def comparators_section(geometry: Geometry) -> Section:
    """Return the condition numbers of the cases and of [5] and [11], with moments as M / r, in N mm and in N m."""
    units = tables.moment_units(geometry)
    records: list[Record] = []
    for case in CASES:
        best = best_length(geometry, case)
        equal = [lengths_of_condition(geometry, case, condition) for _, _, condition in COMPARATORS]
        records.append({
            "sensor": f"case {case}", "axes": 3, "printed": None,
            **{f"in {unit}": value for unit, value in tables.condition_numbers_by_unit(geometry, case).items()},
            "smallest": tables.condition_at_length(geometry, case, best), "smallest_at_mm": best * MM,
            "equal_at_mm": [[length * MM for length in lengths] for lengths in equal],
        })  # fmt: skip
    for reference, axes, condition in COMPARATORS:
        printed_in = {unit: list(condition_range(condition, length, geometry.r_m)) for unit, length in units.items()}
        records.append({
            "sensor": reference, "axes": axes, "printed": condition, "at_M_r_if_printed_in": printed_in,
            **{f"if in {unit}": values for unit, values in printed_in.items()},
        })  # fmt: skip
    title = "Section 1. The comparators [5] and [11] beside Table 3, moments as M / r with r = 15 mm"
    return Section("comparators", title, _COMPARATORS_COLUMNS, records, _comparators_notes(geometry))


_COMPARATORS_COLUMNS = {
    "sensor": "sensor", "axes": "axes", "printed": "paper", "in M/r": "in M/r", "in N mm": "in N mm",
    "in N m": "in N m", "smallest": "smallest", "smallest_at_mm": "at (mm)", "if in N mm": "M/r, if N mm printed",
    "if in N m": "M/r, if N m printed",
}  # fmt: skip


def _comparators_notes(geometry: Geometry) -> list[str]:
    ranges = []
    for _, _, condition in COMPARATORS:
        low, high = lengths_of_condition(geometry, "I", condition)
        ranges.append(f"{condition:g} with M / {low * MM:.2g} mm or M / {high * MM:.0f} mm")
    return [
        "The paper prints one number for each comparator, no matrix and no unit. Another unit of the moment changes a "
        "condition number by at most the ratio of the lengths, up or down; the last two columns are these ranges.",
        f"Case I itself has {' and '.join(ranges)}, and 8.1 in N mm, 158 in N m: with moments in N mm it is above 4.2, "
        "with moments in N m above 20.05. So the claim \"markedly less than 20.05\" holds only if [11] has the scale "
        "M / r; against the six axes of [5] it compares other loads as well.",
        "On its own scale the smallest condition number of case I is 1.65, with M / 7.1 mm: the paper's choice M / r "
        "is not the most favourable one.",
    ]  # fmt: skip


_FIGURES_COLUMNS = {
    "strain_ue": "microstrain at 4.4 N", "noise_gain_N_per_ue": "noise N/ue", "yield_N": "yield (N)",
    "slit_N": "slit closes (N)", "largest_N": "largest load (N)", "range_over_noise": "load / noise",
    "frequency_hz": "lowest mode (Hz)",
}  # fmt: skip


def materials_section(geometry: Geometry) -> Section:
    """Return the body of other materials: strain, noise, and the load that yields or closes the slit."""
    records: list[Record] = [
        {"material": material.name, "E_GPa": material.youngs_modulus_pascals / 1e9,
         "yield_MPa": material.yield_pascals / 1e6, **figures_of(geometry, material, "I")}
        for material in MATERIALS
    ]  # fmt: skip
    columns = {"material": "material", "E_GPa": "E (GPa)", "yield_MPa": "yield (MPa)", **_FIGURES_COLUMNS}
    return Section(
        "materials", "Materials and largest load, case I, the fabricated dimensions", columns, records, _MATERIALS
    )


_MATERIALS = [
    "Moduli and yield stresses are typical values of data sheets (assumed; the paper names AISI 4340 and no values). "
    "The loads are the smallest over all contacts and directions: the largest stress of the beams at yield, without "
    "stress concentration in the corners and without fatigue; the slit of 0.25 mm closed at one place.",
    "In hardened materials the slit closes long before yield: it is the overload stop, and a wider slit or a stiffer "
    "beam is needed for more load. Annealed 304 yields before the slit closes, at a load near the paper's 4.4 N.",
    "A softer material gives less noise in newtons and a smaller largest load, by the same factor 1/E: load over noise "
    "of one microstrain is the same for all whose slit is the limit. Titanium has the frequency of steel.",
]


def scaling_section(geometry: Geometry) -> Section:
    """Return smaller fingertips (the paper's section 5): all dimensions scaled, and with the thicknesses kept."""
    records = [scaled(geometry, scale, "I", keep) for keep in (False, True) for scale in SCALES]
    return Section("scaling", "Section 5. Smaller fingertips of AISI 4340, case I", _SCALING_COLUMNS, records, _SCALING)


_SCALING_COLUMNS = {
    "beams": "h1, h2", "r_mm": "r = a = d (mm)", "h_mm": "h1 h2 (mm)", "slenderness": "a/h1",
    "strain_ue": "microstrain at 4.4 N", "noise_gain_N_per_ue": "noise N/ue", "yield_N": "yield (N)",
    "slit_N": "slit closes (N)", "frequency_hz": "lowest mode (Hz)", "condition": "cond",
    "condition_of_gauges": "1 mm gauges", "condition_of_shift": "U 0.2 mm off",
}  # fmt: skip
_SCALING = [
    "Width scales with r. All dimensions scaled: strain per newton grows as 1/r^2, so at half the size 4.4 N make 3600 "
    "microstrain, beyond most foil gauges' converters, and at a third they pass the yield load: such a finger is for "
    "a quarter and a ninth of the load.",
    "Thicknesses kept: strain, noise and yield load stay, because the stress goes with a / (width h^2). The beams "
    "become thick, a/h1 falls from 37 to 9, where beam theory is off by some per cent (docs/finite-elements.md), and "
    "the slit no longer closes before yield: another overload stop is needed.",
    "A gauge keeps its length of 1 mm: its middle moves inward relative to the beam, and so the condition number of "
    "the gauges grows while that of the points stays. At r = 3.75 mm a gauge covers a quarter of its beam: shorter "
    "gauges, and with them the other processes that the paper mentions, are needed from there.",
    "At the size of a human fingertip, about 15 mm wide (r = 7.5 mm), the same beams and gauges give the same noise "
    "and nearly the same condition number. The slit of 0.25 mm closes at 61 N and no longer protects (yield: 25 N).",
]
