"""`tipforce design table|sweep`: the paper's tables and figures, recomputed; condition number over a dimension."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipforce.errors import InputError
from tipforce_tools.cli import common, tables

if TYPE_CHECKING:
    from tipforce.sensor.structure.strain import GaugePosition, Geometry
    from tipforce_lab.design.tables import Record, Section

TABLES = ("1", "2", "3", "comparators", "fig6", "fig9", "off-axis", "materials", "scaling")
DIMENSIONS = ("a", "d", "r", "h1", "h2", "width")
_NOTES = [
    "noise gain: sqrt(trace(C C^T)), newtons of noise in F per microstrain of equal noise on every gauge. largest "
    "strain: of the gauges, over all contacts, per newton."
]


def add_table_arguments(parser: argparse.ArgumentParser) -> None:
    """1, 2, 3: the tables (3 with the ranking of all layouts). comparators: the sensors [5] and [11] on one scale.
    fig6: condition number against gauge shift. fig9: errors in the paper's grooves, simulated. off-axis:
    section 3.3. materials: other materials and the largest load. scaling: smaller fingertips. Explained in
    docs/mechanics.md.
      tipforce design table all -o figures
    """
    parser.add_argument("what", nargs="?", choices=(*TABLES, "all"), default="all", help="default: all")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="also write the figures (needs matplotlib)")
    parser.add_argument("--format", choices=("svg", "png"), default="svg", help="of the figures (default: svg)")
    group = parser.add_argument_group("figure 9")
    group.add_argument("--noise", type=float, default=5.0, metavar="UE", help="of a gauge, microstrain (%(default)s)")
    group.add_argument("--repeats", type=int, default=400, metavar="N", help="calibrations (default %(default)s)")
    group.add_argument("--seed", type=common.whole_number, default=9, help="of the noise (default %(default)s)")
    common.add_output_arguments(parser)


def run_table(args: argparse.Namespace) -> int:
    """Print the sections, each computed when it is printed, then draw; return 0."""
    from tipforce.sensor.structure.strain import FABRICATED
    from tipforce_lab.design import other_bodies as bodies
    from tipforce_lab.design import sections

    figure_9 = partial(sections.figure_9_section, noise_ue=args.noise, repeats=args.repeats, seed=args.seed)
    makers: dict[str, tuple[Callable[[Geometry], Section], ...]] = {
        "1": (sections.table_1_section,), "2": (sections.table_2_section,),
        "3": (sections.table_3_section, sections.ranking_section), "comparators": (bodies.comparators_section,),
        "fig6": (sections.figure_6_section,), "fig9": (figure_9,), "off-axis": (sections.off_axis_section,),
        "materials": (bodies.materials_section,), "scaling": (bodies.scaling_section,),
    }  # fmt: skip
    for name in TABLES if args.what == "all" else (args.what,):
        for make in makers[name]:
            _print(make(FABRICATED))
    if args.output is not None:
        from tipforce_lab.design.plots import draw

        for path in draw(args.what, args.output, args.format, args.noise, args.repeats, args.seed):
            common.note(f"wrote {path}")
    return 0


def add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    """Dimensions are in millimetres; the others and the load are constant. SG1, SG2, ... shift one gauge, all
    shifts all gauges, in millimetres inward along their beams: away from the nearer end.
      tipforce design sweep SG3 --layout III --to 4 --steps 9
      tipforce design sweep r --from 8 --to 20 -o r.svg
    """
    parser.add_argument("what", metavar="WHAT", help=f"{', '.join(DIMENSIONS)}, SG1, SG2, ..., or all")
    parser.add_argument("--from", type=float, dest="start", metavar="MM", help="default: half the dimension, or 0")
    parser.add_argument("--to", type=float, dest="stop", metavar="MM", help="default: 1.5 times it, or 5")
    parser.add_argument("--steps", type=int, default=21, metavar="N", help="number of values (default %(default)s)")
    parser.add_argument("--layout", default="I", metavar="I|II|III|FILE", help="gauges, dimensions (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="also write a plot, .svg or .png")
    common.add_output_arguments(parser)


def run_sweep(args: argparse.Namespace) -> int:
    """Print the sweep, then draw it; return 0."""
    from tipforce.output_file import check_output, figure_kind
    from tipforce.sources.layout_file import read_layout

    if args.output is not None:
        check_output(args.output, figure_kind(args.output), [args.layout])
    geometry, gauges = read_layout(args.layout)
    section = sweep_section(args, geometry, gauges)
    _print(section)
    if args.output is not None:
        from tipforce_lab.design.plots import draw_sweep

        draw_sweep(args.output, section)
        common.note(f"wrote {args.output}")
    return 0


def sweep_section(args: argparse.Namespace, geometry: Geometry, gauges: Sequence[str | GaugePosition]) -> Section:
    """Return one record per value. Raises InputError for an unknown name or an impossible range."""
    import numpy as np

    from tipforce.sensor.structure.quality import shifted
    from tipforce.sensor.structure.strain import position_matrix
    from tipforce_lab.design.tables import Section, figures, maximum_over_contacts

    names = [f"SG{index + 1}" for index in range(len(gauges))]
    if args.what in DIMENSIONS:
        nominal_mm = 1e3 * getattr(geometry, f"{args.what}_m")
        first, last = 0.5 * nominal_mm, 1.5 * nominal_mm
    elif args.what in (*names, "all"):
        nominal_mm, first, last = 0.0, 0.0, 5.0
    else:
        raise InputError(f"sweep {args.what!r}: allowed are {', '.join((*DIMENSIONS, *names, 'all'))}")
    first, last = (default if value is None else value for value, default in ((args.start, first), (args.stop, last)))
    if not (-1e6 < first < last < 1e6 and 2 <= args.steps <= 100_000):
        raise InputError(
            f"--from {first:g} --to {last:g} --steps {args.steps}: allowed are a rising range and 2 to 100000 steps"
        )
    records: list[Record] = []
    for value_mm in np.linspace(first, last, args.steps).tolist():
        value_m, resized = value_mm * 1e-3, args.what in DIMENSIONS
        body = replace(geometry, **{f"{args.what}_m": value_m}) if resized else geometry
        moved_m = [value_m if not resized and args.what in ("all", name) else 0.0 for name in names]
        matrix = position_matrix(body, [shifted(body, *of) for of in zip(gauges, moved_m, strict=True)])
        largest = max(maximum_over_contacts((g1, g2, g3)).value for g1, g2, g3 in matrix.tolist())
        records.append({f"{args.what}_mm": value_mm, **figures(matrix), "largest_strain_ue_per_N": 1e6 * largest})
    columns = {
        args.what + "_mm": f"{args.what} (mm)",
        "condition": "condition number",
        "row_equilibrated": "unit rows",
        "noise_gain_N_per_ue": "noise gain (N/ue)",
        "largest_strain_ue_per_N": "largest strain (ue/N)",
    }
    return Section("sweep", f"Layout {args.layout}, nominal {args.what} = {nominal_mm:g} mm", columns, records, _NOTES)


def _print(section: Section) -> None:
    if common.OUTPUT.json:
        for record in section.records:
            common.print_json({"table": section.name, **record})
        if section.notes:
            common.print_json({"table": section.name, "notes": section.notes})
        return
    from rich import box
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    table = Table(title=section.title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for key, heading in section.columns.items():
        numeric = all(isinstance(_cell(record, key), (int, float, type(None))) for record in section.records)
        table.add_column(heading, justify="right" if numeric else "left", overflow="fold")
    for record in section.records:
        table.add_row(*(_shown(_cell(record, key)) for key in section.columns))
    tables.print_table(table)
    console = tables.console()
    for note in section.notes:
        console.print(Padding(Text(note), (0, 0, 1, 2)), highlight=False)


def _cell(record: Record, key: str) -> Any:
    name, _, index = key.partition(".")
    return record[name][int(index)] if index else record.get(name)


def _shown(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return " ".join(_shown(item) for item in value)
    if isinstance(value, float):
        if math.isnan(value):
            return "any"
        return f"{value + 0.0:.4g}" if abs(value) >= 1e-12 else "0"
    return str(value)
