"""`tipforce export eds|dbc|dcf|xdd|ros2|c|mjcf`: files for other tools, C firmware and simulators."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice

if TYPE_CHECKING:
    from tipforce.dictionary.eds import Values
    from tipforce.dictionary.table import Converter


FORMATS = {
    "eds": "objects of a node, for configuration tools",
    "dbc": "PDOs of the nodes, for log and bus tools",
    "dcf": "EDS with the settings of one node",
    "xdd": "objects of a node, or of --eds FILE, in XML (CiA 311)",
    "ros2": "bus configuration of ros2_canopen for a hand, and its EDS files, in one folder",
    "c": "C99 sources of the dictionary and the estimator, in one folder",
    "mjcf": "body of the fingertip for MuJoCo: outline, mass, tip site, beams as springs",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce export`."""
    parser.epilog = (
        "examples: tipforce export dbc --nodes 1-5 -o hand.dbc; tipforce export c --gauges 4 -o firmware/; "
        "tipforce export ros2 --hand hand.toml -o bus/"
    )
    add_choice(parser, "format", FORMATS)
    parser.add_argument("-o", "--output", metavar="PATH", help="default: stdout; c, ros2: a folder, required")
    what = "eds, dcf: REAL32 as decimals, or as hexadecimal bits for Lely's dcfgen (default %(default)s)"
    parser.add_argument("--dialect", choices=("decimal", "lely"), default="decimal", help=what)
    parser.add_argument("--eds", type=common.InputFile(), metavar="FILE", help="xdd: the EDS, DCF or XDD of any device")
    parser.add_argument("--hand", type=common.InputFile(), metavar="FILE", help="ros2: the hand in TOML, required")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="gauges, 3 to 8 (default %(default)s)")
    ids = list(range(1, 16))
    parser.add_argument("--nodes", type=common.node_ids, default=ids, metavar="IDS", help="dbc: 1,2,5-9 (default 1-15)")
    parser.add_argument("--node-id", type=common.node_id, metavar="ID", help="dcf: 1 to 127, required")
    what = "dcf: TOML or DCF with the settings that are not at their default, as for `config apply`"
    parser.add_argument("--settings", type=common.InputFile(), metavar="FILE", help=what)
    parser.add_argument("--bits", type=int, choices=(16, 24), default=16, help="converter resolution (default 16)")
    parser.add_argument("--simulated", action="store_true", help="eds, dcf: add 2200h and 2201h of a simulated node")
    what = "eds, dcf, xdd: add 1F50h to 1F57h of firmware with program slots"
    parser.add_argument("--programs", action="store_true", help=what)
    parser.add_argument("--prefix", default="", metavar="TEXT", help="mjcf: in front of every name")
    parser.add_argument("--rigid", action="store_true", help="mjcf: no springs, the tip is fixed to the fixture")
    what = "mjcf: of the lowest mode (default 0.05)"
    parser.add_argument("--damping-ratio", type=float, default=0.05, metavar="RATIO", help=what)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write the file or files; return 0."""
    from tipforce.dictionary import table
    from tipforce.output_file import DBC, EDS, MJCF, XDD, new_file

    if args.programs and args.format not in ("eds", "dcf", "xdd"):
        others = "the exported C has no program slots, and other formats list no objects"
        raise InputError(f"export {args.format}: --programs is for eds, dcf and xdd; {others}")
    if args.programs and args.eds:
        raise InputError("--programs: the objects are those of the file of --eds; leave one out")
    converter = table.CONVERTER_24 if args.bits == 24 else table.CONVERTER_16
    if args.format in ("c", "ros2"):
        return _write_folder(args, converter)
    text = _text(args, converter)
    if not args.output or args.output == "-":
        print(text, end="")
        return 0
    kind = {"dbc": DBC, "xdd": XDD, "mjcf": MJCF}.get(args.format, EDS)
    inputs = [name for name in (args.settings, args.eds) if name]
    with new_file(args.output, kind, inputs) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
    common.note(f"{args.output}: {len(text.splitlines())} lines")
    return 0


def _text(args: argparse.Namespace, converter: Converter) -> str:
    if args.format == "mjcf":
        from tipforce_robots.mujoco.models import fingertip_mjcf

        return fingertip_mjcf(args.prefix, rigid=args.rigid, damping_ratio=args.damping_ratio)
    if args.format == "dbc":
        from tipforce.dictionary.dbc import dbc_text

        return dbc_text(args.nodes, args.gauges)
    from tipforce.dictionary.eds import dcf_text, eds_text, lely_dialect

    if args.format == "xdd":
        return _xdd(args, converter)
    if args.format == "eds":
        text = eds_text(args.gauges, args.simulated, converter, args.programs)
    elif args.node_id is None:
        raise InputError("--node-id: a DCF belongs to one node; add it, for example --node-id 5")
    else:
        values: Values = {}  # without --settings the DCF has no ParameterValue: all defaults apply
        if args.settings:
            from tipforce.host.configuration.configuration_file import read_configuration

            wanted = read_configuration(args.settings, args.node_id, args.gauges)
            values = {place: value for place, (_entry, value) in wanted.items()}
        text = dcf_text(args.gauges, args.node_id, values, args.simulated, converter=converter, programs=args.programs)
    return lely_dialect(text) if args.dialect == "lely" else text


def _xdd(args: argparse.Namespace, converter: Converter) -> str:
    from canopen_device.eds.reader import describe, read_eds
    from canopen_device.eds.sections import parse
    from canopen_device.eds.xdd import xdd_text
    from tipforce.dictionary.eds import eds_text, file_name

    if args.eds:
        described = read_eds(args.eds, args.node_id or 1)
        for warning in described.warnings:
            common.note(f"warning: {warning}")
        return xdd_text(described, "tipforce")
    text = eds_text(args.gauges, args.simulated, converter, args.programs)
    path = Path(file_name(args.gauges, args.simulated, bits=converter[0]))
    return xdd_text(describe(parse(text.encode(), path), 1), "tipforce")


def _write_folder(args: argparse.Namespace, converter: Converter) -> int:
    if args.format == "ros2" and not args.hand:
        raise InputError("--hand: `export ros2` needs the hand; add its file, for example --hand hand.toml")
    if not args.output or args.output == "-":
        raise InputError(f"--output: `export {args.format}` writes several files; name a folder")
    if args.format == "ros2":
        from tipforce.host.hand.file import read_hand
        from tipforce_robots.ros2.bridge import write_ros2_bus

        paths = write_ros2_bus(read_hand(args.hand), Path(args.output))
    else:
        from tipforce_tools.export.c_sources import write_c_files

        paths = write_c_files(Path(args.output), args.gauges, converter)
    for path in paths:
        common.note(str(path))
    return 0
