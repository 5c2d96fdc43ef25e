"""`tipforce nmt start|stop|preop|reset-node|reset-comm IDS`."""

from __future__ import annotations

import argparse
import threading

from tipforce.errors import InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice

ALL = "all"
COMMANDS = {
    "start": "enter operational: PDOs and SDO",
    "stop": "enter stopped: neither PDOs nor SDO, only heartbeat and NMT",
    "preop": "enter pre-operational: SDO, no PDOs",
    "reset-node": "reset the node to its stored parameters",
    "reset-comm": "reset only the communication objects",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce nmt`."""
    parser.epilog = (
        "  tipforce nmt start 1-5 --wait -i socketcan -c can0      (exit code 5 if one does not report the state)\n"
        "  tipforce nmt preop all -i socketcan -c can0             (one frame, for every node on the bus)"
    )
    add_choice(parser, "command", COMMANDS)
    parser.add_argument("ids", type=_ids, metavar="IDS", help="10, 0x0A, 1,2,5-9 or all")
    parser.add_argument(
        "--wait",
        nargs="?",
        type=float,
        const=10.0,
        metavar="S",
        help="repeat the command until each heartbeat confirms it, for this long (%(const)s s unless given)",
    )
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Send the command; with --wait print the state of each node.

    Raises NoResponseError for a node that does not report the state in time, after printing those that do.
    """
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.nmt import NotReachedError, command_and_wait

    common.set_up_logging(args)
    if args.wait is not None and not args.ids:
        raise InputError("nmt all --wait: needs node-ids, for example 1-5")
    if args.wait is not None and not 0 < args.wait < threading.TIMEOUT_MAX:
        raise InputError(f"--wait {args.wait:g}: allowed is a time over 0 s")
    with Bus(common.open_bus(args)) as connection:
        if args.wait is None:
            for node_id in args.ids or [0]:
                connection.nmt(args.command, node_id)
            return 0
        try:
            states = command_and_wait(connection, args.command, args.ids, args.wait)
            connection.check_duplicates(args.ids)
        except NotReachedError as error:
            _print(args, error.reached)
            raise
    _print(args, states)
    return 0


def _print(args: argparse.Namespace, states: dict[int, str]) -> None:
    for node_id, state in sorted(states.items()):
        if args.json:
            common.print_json({"node_id": node_id, "state": state})
        else:
            print(f"{common.shown_id(node_id):>11}  {state}")


def _ids(text: str) -> list[int]:
    """Parse node-ids; an empty list means all."""
    return [] if text == ALL else common.node_ids(text)
