"""`tipforce config apply|verify`: a TOML or DCF file to a node, and the comparison with what a node has."""

from __future__ import annotations

import argparse

from tipforce_tools import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `tipforce config`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "A TOML file has a table [objects] of names (docs/objects.md) or indices, and values:\n"
        "  [objects]\n"
        '  "heartbeat.producer_ms" = 500\n'
        '  "0x6114:01" = 1000\n'
        '  "tpdo1.mapping" = ["process_value_int16:7", "status", "counter"]\n'
        "PDOs are changed by the procedure of CiA 301: made invalid, remapped, made valid again.\n"
        "  tipforce config apply 5 hand.toml -i socketcan -c can0 --store"
    )
    parser.add_argument("action", choices=("apply", "verify"))
    parser.add_argument("node", type=common.node_id, metavar="ID")
    parser.add_argument("file", metavar="FILE", help="*.dcf, or TOML")
    parser.add_argument("--store", action="store_true", help="apply: store all parameters on the node afterwards")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="of the node (default 3)")
    common.add_confirm_argument(parser)
    common.add_sdo_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Apply (0) or verify (0 equal, 1 different); each difference is a line."""
    from tipforce.host.configuration import apply_configuration, read_configuration, verify_configuration
    from tipforce.host.fingertip import FingertipClient

    common.set_up_logging(args)
    wanted = read_configuration(args.file, args.node, args.gauges)
    if args.action == "apply" and args.store:
        common.confirm(args, f"node {common.shown_id(args.node)}: this replaces its stored parameters")
    with common.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        if args.action == "apply":
            apply_configuration(sdo, wanted)
        differences = verify_configuration(sdo, wanted)
        if args.action == "apply" and args.store and not differences:
            FingertipClient(sdo).store()
    for difference in differences:
        if args.json:
            common.print_json(difference)
        else:
            print(f"{difference['object']}: expected {difference['expected']}, the node has {difference['found']}")
    common.note(args, f"node {common.shown_id(args.node)}: {len(wanted)} objects, {len(differences)} different")
    return 1 if differences else 0
