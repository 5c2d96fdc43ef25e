"""Beyond the paper's tables: comparators on one scale, materials and the largest load, smaller fingertips."""

from __future__ import annotations

from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.published import CALIBRATION_WEIGHT_NEWTONS, CASES
from tipforce_lab.design.comparators import (
    COMPARATORS,
    MOMENT_UNITS,
    best_length,
    condition_at_length,
    condition_range,
    lengths_of_condition,
)
from tipforce_lab.design.materials import MATERIALS, Figures, figures_of, scaled
from tipforce_lab.design.section import Record, Section

MM, MICRO = 1e3, 1e6
SCALES = (1.0, 0.75, 0.5, 1.0 / 3.0, 0.25)


def comparators_section(geometry: Geometry) -> Section:
    """Return the condition numbers of the cases and of [5] and [11], with moments as M / r, in N mm and in N m."""
    units = {"M/r": geometry.r_m, **MOMENT_UNITS}
    records: list[Record] = []
    for case in CASES:
        best = best_length(geometry, case)
        records.append(
            {
                "sensor": f"case {case}", "axes": 3, "printed": None,
                **{f"in {unit}": condition_at_length(geometry, case, length) for unit, length in units.items()},
                "smallest": condition_at_length(geometry, case, best), "smallest_at_mm": best * MM,
                "equal_at_mm": [
                    [length * MM for length in lengths_of_condition(geometry, case, one.condition)]
                    for one in COMPARATORS
                ],
            }
        )  # fmt: skip
    for one in COMPARATORS:
        printed_in = {
            unit: list(condition_range(one.condition, length, geometry.r_m)) for unit, length in units.items()
        }
        records.append(
            {
                "sensor": one.reference, "axes": one.axes, "printed": one.condition, "at_M_r_if_printed_in": printed_in,
                **{f"if in {unit}": values for unit, values in printed_in.items()},
            }
        )  # fmt: skip
    return Section("comparators", _COMPARATORS_TITLE, _COMPARATORS_COLUMNS, records, _comparators_notes(geometry))


_COMPARATORS_TITLE = "Section 1. The comparators [5] and [11] beside Table 3, moments as M / r with r = 15 mm"
_COMPARATORS_COLUMNS = {
    "sensor": "sensor",
    "axes": "axes",
    "printed": "paper",
    "in M/r": "in M/r",
    "in N mm": "in N mm",
    "in N m": "in N m",
    "smallest": "smallest",
    "smallest_at_mm": "at (mm)",
    "if in N mm": "M/r, if N mm printed",
    "if in N m": "M/r, if N m printed",
}


def _comparators_notes(geometry: Geometry) -> list[str]:
    ranges = []
    for one in COMPARATORS:
        low, high = lengths_of_condition(geometry, "I", one.condition)
        ranges.append(f"{one.condition:g} with M / {low * MM:.2g} mm or M / {high * MM:.0f} mm")
    return [
        "The paper prints one number for each comparator, no matrix and no unit. Another unit of the moment changes a "
        "condition number by at most the ratio of the lengths, up or down; the last two columns are these ranges.",
        f"Case I itself has {' and '.join(ranges)}, and 8.1 in N mm, 158 in N m: with moments in N mm it is above 4.2, "
        "with moments in N m above 20.05. So the claim \"markedly less than 20.05\" holds only if [11] has the scale "
        "M / r; against the six axes of [5] it compares other loads as well.",
        "On its own scale the smallest condition number of case I is 1.65, with M / 7.1 mm: the paper's choice M / r "
        "is not the most favourable one.",
    ]  # fmt: skip


def _figures(found: Figures) -> Record:
    return {
        "strain_ue": found.strain_per_newton * CALIBRATION_WEIGHT_NEWTONS * MICRO,
        "noise_gain_N_per_ue": found.noise_gain_newtons / MICRO,
        "yield_N": found.yield_newtons,
        "slit_N": found.slit_newtons,
        "largest_N": found.largest_newtons,
        "range_over_noise": found.largest_newtons / found.noise_gain_newtons * MICRO,
        "frequency_hz": found.frequency_hz,
    }


_FIGURES_COLUMNS = {
    "strain_ue": "microstrain at 4.4 N",
    "noise_gain_N_per_ue": "noise N/ue",
    "yield_N": "yield (N)",
    "slit_N": "slit closes (N)",
    "largest_N": "largest load (N)",
    "range_over_noise": "load / noise",
    "frequency_hz": "lowest mode (Hz)",
}


def materials_section(geometry: Geometry) -> Section:
    """Return the body of other materials: strain, noise, and the load that yields or closes the slit."""
    records: list[Record] = [
        {
            "material": one.name, "E_GPa": one.youngs_modulus_pascals / 1e9, "yield_MPa": one.yield_pascals / 1e6,
            **_figures(figures_of(geometry, one, "I")),
        }
        for one in MATERIALS
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
    records: list[Record] = []
    for keep in (False, True):
        for scale in SCALES:
            found = scaled(geometry, scale, "I", keep)
            records.append(
                {
                    "beams": "kept" if keep else "scaled", "r_mm": found.geometry.r_m * MM,
                    "h_mm": [found.geometry.h1_m * MM, found.geometry.h2_m * MM],
                    "slenderness": found.geometry.a_m / found.geometry.h1_m,
                    **_figures(found.figures),
                    "condition": found.condition, "condition_of_gauges": found.condition_of_gauges,
                    "condition_of_shift": found.condition_of_shift,
                }
            )  # fmt: skip
    return Section("scaling", "Section 5. Smaller fingertips of AISI 4340, case I", _SCALING_COLUMNS, records, _SCALING)


_SCALING_COLUMNS = {
    "beams": "h1, h2",
    "r_mm": "r = a = d (mm)",
    "h_mm": "h1 h2 (mm)",
    "slenderness": "a/h1",
    "strain_ue": "microstrain at 4.4 N",
    "noise_gain_N_per_ue": "noise N/ue",
    "yield_N": "yield (N)",
    "slit_N": "slit closes (N)",
    "frequency_hz": "lowest mode (Hz)",
    "condition": "cond",
    "condition_of_gauges": "1 mm gauges",
    "condition_of_shift": "U 0.2 mm off",
}
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
