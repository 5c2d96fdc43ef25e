"""`tipforce design sweep`: condition number and noise gain against one dimension, or against a gauge shift."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common
from tipforce_tools.design.print_section import print_section

if TYPE_CHECKING:
    from tipforce.sensor.structure.gauge_shift import GaugePosition
    from tipforce.sensor.structure.geometry import Geometry
    from tipforce_lab.design.tables import Record, Section

DIMENSIONS = ("a", "d", "r", "h1", "h2", "width")
DEFAULT_SHIFT_MM = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce design sweep`."""
    parser.epilog = (
        "Dimensions are in millimetres; the others and the load are constant. SG1, SG2, ... shift one gauge, all\n"
        "shifts all gauges, in millimetres inward along their beams: away from the nearer end.\n"
        "  tipforce design sweep h2\n"
        "  tipforce design sweep SG3 --layout III --to 4 --steps 9\n"
        "  tipforce design sweep r --from 8 --to 20 -o r.svg"
    )
    parser.add_argument("what", metavar="WHAT", help=f"{', '.join(DIMENSIONS)}, SG1, SG2, ..., or all")
    parser.add_argument("--from", type=float, dest="start", metavar="MM", help="default: half the dimension, or 0")
    parser.add_argument("--to", type=float, dest="stop", metavar="MM", help="default: 1.5 times it, or 5")
    parser.add_argument("--steps", type=int, default=21, metavar="N", help="number of values (default %(default)s)")
    parser.add_argument(
        "--layout", default="I", metavar="I|II|III|FILE", help="gauges and dimensions (default %(default)s)"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="also write a plot, .svg or .png")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the sweep, then draw it; return 0."""
    from tipforce.output_file import check_output, figure_kind
    from tipforce_tools.cli.layout_file import read_layout

    common.set_up_logging(args)
    if args.output is not None:
        check_output(args.output, figure_kind(args.output), [args.layout])
    geometry, gauges = read_layout(args.layout)
    section = sweep_section(args, geometry, gauges)
    print_section(args, section)
    if args.output is not None:
        from tipforce_lab.design.plots import draw_sweep

        draw_sweep(args.output, section)
        common.note(args, f"wrote {args.output}")
    return 0


def sweep_section(args: argparse.Namespace, geometry: Geometry, gauges: Sequence[str | GaugePosition]) -> Section:
    """Return one record per value. Raises InputError for an unknown name or an impossible range."""
    import numpy as np

    from tipforce_lab.design.tables import Section

    names = [f"SG{index + 1}" for index in range(len(gauges))]
    if args.what in DIMENSIONS:
        nominal_mm = 1e3 * getattr(geometry, f"{args.what}_m")
        first, last = 0.5 * nominal_mm, 1.5 * nominal_mm
    elif args.what in (*names, "all"):
        nominal_mm, first, last = 0.0, 0.0, DEFAULT_SHIFT_MM
    else:
        raise InputError(f"sweep {args.what!r}: allowed are {', '.join((*DIMENSIONS, *names, 'all'))}")
    first, last = (default if value is None else value for value, default in ((args.start, first), (args.stop, last)))
    if not (-1e6 < first < last < 1e6 and 2 <= args.steps <= 100_000):
        raise InputError(
            f"--from {first:g} --to {last:g} --steps {args.steps}: allowed are a rising range and 2 to 100000 steps"
        )
    body = _changed(args.what, names, geometry, gauges)
    values = np.linspace(first, last, args.steps).tolist()
    records = [{args.what + "_mm": value, **_figures(*body(value * 1e-3))} for value in values]
    columns = {
        args.what + "_mm": f"{args.what} (mm)",
        "condition": "condition number",
        "row_equilibrated": "unit rows",
        "noise_gain_N_per_ue": "noise gain (N/ue)",
        "largest_strain_ue_per_N": "largest strain (ue/N)",
    }
    return Section("sweep", f"Layout {args.layout}, nominal {args.what} = {nominal_mm:g} mm", columns, records, _NOTES)


_NOTES = [
    "noise gain: sqrt(trace(C C^T)), newtons of noise in F per microstrain of equal noise on every gauge. largest "
    "strain: of the gauges, over all contacts, per newton."
]


def _changed(
    what: str, names: list[str], geometry: Geometry, gauges: Sequence[str | GaugePosition]
) -> Callable[[float], tuple[Geometry, list[GaugePosition]]]:
    """Return a function from the value in metres to the body and the positions of its gauges."""
    from tipforce.sensor.structure.gauge_shift import shifted

    def resized(value_m: float) -> tuple[Geometry, list[GaugePosition]]:
        body = replace(geometry, **{f"{what}_m": value_m})
        return body, [shifted(body, gauge, 0.0) for gauge in gauges]

    def moved(value_m: float) -> tuple[Geometry, list[GaugePosition]]:
        return geometry, [
            shifted(geometry, gauge, value_m if what in ("all", name) else 0.0)
            for name, gauge in zip(names, gauges, strict=True)
        ]

    return resized if what in DIMENSIONS else moved


def _figures(geometry: Geometry, places: list[GaugePosition]) -> Record:
    import numpy as np

    from tipforce.sensor.structure.gauge_shift import position_matrix
    from tipforce.sensor.structure.strain import condition_number, noise_gain, row_equilibrated_condition_number
    from tipforce_lab.design.tables import maximum_over_contacts

    matrix = position_matrix(geometry, places)
    regular = int(np.linalg.matrix_rank(matrix)) == 3
    return {
        "condition": condition_number(matrix) if regular else float("inf"),
        "row_equilibrated": row_equilibrated_condition_number(matrix) if regular else float("inf"),
        "noise_gain_N_per_ue": noise_gain(np.linalg.pinv(matrix)) * 1e-6 if regular else float("inf"),
        "largest_strain_ue_per_N": 1e6
        * max(maximum_over_contacts((g1, g2, g3)).value for g1, g2, g3 in matrix.tolist()),
    }
