"""`tipforce design table`: the paper's tables and figures, recomputed."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce_tools.cli import common
from tipforce_tools.design.print_section import print_section

if TYPE_CHECKING:
    from tipforce_lab.design.tables import Section

NAMES = ("1", "2", "3", "comparators", "fig6", "fig9", "off-axis", "materials", "scaling")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce design table`."""
    parser.epilog = (
        "1, 2, 3: the tables (3 with the ranking of all layouts). comparators: the sensors [5] and [11] on one scale.\n"
        "fig6: condition number against gauge shift. fig9: errors in the paper's grooves, simulated. off-axis:\n"
        "section 3.3. materials: other materials and the largest load. scaling: smaller fingertips. Explained in\n"
        "docs/mechanics.md.\n"
        "  tipforce design table 3\n"
        "  tipforce design table all --json > tables.jsonl\n"
        "  tipforce design table all -o figures"
    )
    parser.add_argument("what", nargs="?", choices=(*NAMES, "all"), default="all", help="default: all")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="also write the figures to this directory (needs matplotlib)"
    )
    parser.add_argument("--format", choices=("svg", "png"), default="svg", help="of the figures (default: svg)")
    group = parser.add_argument_group("figure 9")
    group.add_argument(
        "--noise", type=float, default=5.0, metavar="UE", help="gauge noise in microstrain (default %(default)s)"
    )
    group.add_argument("--repeats", type=int, default=400, metavar="N", help="calibrations (default %(default)s)")
    group.add_argument("--seed", type=common.seed, default=9, help="of the noise (default %(default)s)")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the sections, then draw; return 0."""
    common.set_up_logging(args)
    for section in sections(args):
        print_section(args, section)
    if args.output is not None:
        from tipforce_lab.design.plots import draw

        for path in draw(args.what, args.output, args.format, args.noise, args.repeats, args.seed):
            common.note(args, f"wrote {path}")
    return 0


def sections(args: argparse.Namespace) -> Iterator[Section]:
    """Yield the requested sections, each computed when it is needed."""
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce_lab.design import other_bodies
    from tipforce_lab.design import paper_figures as figures
    from tipforce_lab.design import table_sections as tables

    makers: dict[str, list[Callable[[], Section]]] = {
        "1": [lambda: tables.table_1_section(FABRICATED)],
        "2": [lambda: tables.table_2_section(FABRICATED)],
        "3": [lambda: tables.table_3_section(FABRICATED), lambda: tables.ranking_section(FABRICATED)],
        "comparators": [lambda: other_bodies.comparators_section(FABRICATED)],
        "fig6": [lambda: figures.figure_6_section(FABRICATED)],
        "fig9": [lambda: figures.figure_9_section(FABRICATED, args.noise, args.repeats, args.seed)],
        "off-axis": [lambda: figures.off_axis_section(FABRICATED)],
        "materials": [lambda: other_bodies.materials_section(FABRICATED)],
        "scaling": [lambda: other_bodies.scaling_section(FABRICATED)],
    }
    for name in NAMES if args.what == "all" else (args.what,):
        for make in makers[name]:
            yield make()
