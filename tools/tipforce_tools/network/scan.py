"""`tipforce scan`: the nodes on a bus, with identity and state."""

from __future__ import annotations

import argparse
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING

from tipforce.errors import DuplicateNodeError, InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.network.find import FoundNode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce scan`."""
    parser.epilog = (
        "Exit code 1 if two nodes use one node-id: both respond to each request.\n  tipforce scan -i socketcan -c can0"
    )
    parser.add_argument(
        "--nodes", type=common.node_ids, default=list(range(1, 128)), metavar="IDS", help="1,2,5-9 (default: all)"
    )
    parser.add_argument(
        "--wait", type=float, default=1.2, metavar="S", help="wait for responses and heartbeats (default %(default)s s)"
    )
    common.add_sdo_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print a line for each node; return 5 if there is none. Raises DuplicateNodeError for two with one node-id."""
    from tipforce.host.network.find import find_nodes

    common.set_up_logging(args)
    if not 0 <= args.wait < threading.TIMEOUT_MAX:
        raise InputError(f"--wait {args.wait:g}: allowed is 0 s or more")
    with common.open_connection(args) as connection:
        found = find_nodes(connection, args.nodes, args.wait)
        _print(args, found)
        if duplicates := [node.duplicate for node in found if node.duplicate]:
            raise DuplicateNodeError("; ".join(duplicates))
    if not found:
        common.note(args, "no node responded: is the bus powered and terminated, is the bit rate right?")
    return 0 if found else 5


def _print(args: argparse.Namespace, found: list[FoundNode]) -> None:
    for node in found:
        if args.json:
            common.print_json(asdict(node))
        elif node.duplicate:
            print(f"{common.shown_id(node.node_id):>11}  {node.state:15}  {node.device}")
        else:
            faults = f"  faults: {node.faults}" if node.faults else ""
            print(
                f"{common.shown_id(node.node_id):>11}  {node.state:15}  {node.device:24}  serial {node.serial:<10}  "
                f"{node.calibration:28}  EDS {node.eds}{faults}"
            )
