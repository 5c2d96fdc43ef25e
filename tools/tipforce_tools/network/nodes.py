"""`tipforce scan`, `read`, `tare`, `nmt`: commands for the nodes of a bus, with a line or a JSON record for each."""

from __future__ import annotations

import argparse
import math
import sys
import threading
from dataclasses import asdict

from tipforce.errors import DuplicateNodeError, InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice

_CONTACT = ("P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg")
NMT_COMMANDS = {
    "start": "enter operational: PDOs and SDO",
    "stop": "enter stopped: neither PDOs nor SDO, only heartbeat and NMT",
    "preop": "enter pre-operational: SDO, no PDOs",
    "reset-node": "reset the node to its stored parameters",
    "reset-comm": "reset only the communication objects",
}


def add_scan_arguments(parser: argparse.ArgumentParser) -> None:
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


def run_scan(args: argparse.Namespace) -> int:
    """Print a line for each node; return 5 if there is none. Raises DuplicateNodeError for two with one node-id."""
    from tipforce.host.network.find import find_nodes

    if not 0 <= args.wait < threading.TIMEOUT_MAX:
        raise InputError(f"--wait {args.wait:g}: allowed is 0 s or more")
    with common.open_connection(args) as connection:
        nodes = find_nodes(connection, args.nodes, args.wait)
        for node in nodes:
            line = f"{common.shown_id(node.node_id):>11}  {node.state:15}  "
            if node.duplicate:
                line += node.device
            else:
                faults = f"  faults: {node.faults}" if node.faults else ""
                line += f"{node.device:24}  serial {node.serial:<10}  {node.calibration:28}  EDS {node.eds}{faults}"
            common.print_record(args, asdict(node), line)
        if duplicates := [node.duplicate for node in nodes if node.duplicate]:
            raise DuplicateNodeError("; ".join(duplicates))
    if not nodes:
        common.note(args, "no node responded: is the bus powered and terminated, is the bit rate right?")
    return 0 if nodes else 5


def add_read_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce read`."""
    parser.epilog = (
        "A finger that is pre-operational is started. An unknown value prints as nan (JSON: null), with its reason.\n"
        "  tipforce read 5 -i socketcan -c can0\n"
        "  tipforce read 1-5 -n 100 --json -i socketcan -c can0 | jq .P_newtons"
    )
    _add_ids(parser)
    parser.add_argument("-n", "--count", type=common.count, default=1, metavar="N", help="samples of each (default 1)")
    parser.add_argument("--wait", type=float, default=5.0, metavar="S", help="for each sample (default %(default)g s)")
    common.add_sdo_arguments(parser)


def run_read(args: argparse.Namespace) -> int:
    """Print ``count`` new samples of each finger: 0. Raises NoResponseError for a finger that gives none in time."""
    if not 0.0 < args.wait < math.inf:
        raise InputError(f"--wait {args.wait:g}: allowed is a time over 0 s")
    with common.open_connection(args) as connection:
        for _ in range(args.count):
            for node_id in args.ids:
                contact = connection.finger(node_id).read(args.wait)
                record: dict[str, object] = {"node_id": node_id, "t_s": contact.t_s, "counter": contact.counter}
                record |= {name: getattr(contact, name) for name in _CONTACT}
                record |= {"status": int(contact.status), "reason": contact.reason}
                record["microstrain"] = list(contact.microstrain)
                u = f"u(P) {contact.u_P_newtons:.3f} N"
                common.print_record(args, record, f"{common.shown_id(contact.node_id):>11}  {contact}  {u}")
                if not args.json:
                    sys.stdout.flush()
    return 0


def add_tare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce tare`."""
    parser.epilog = (
        "Tare the unloaded fingertip: a tare under load hides that load. It is not stored, and ends with a reset or\n"
        "a new calibration. A node without a calibration refuses (exit code 11).\n"
        "  tipforce tare 1-5 -i socketcan -c can0\n"
        "  tipforce tare 1-5 --show -i socketcan -c can0"
    )
    _add_ids(parser)
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--clear", action="store_true", help="clear the tare")
    group.add_argument("--show", action="store_true", help="change nothing")
    common.add_sdo_arguments(parser)


def run_tare(args: argparse.Namespace) -> int:
    """Act on each node and print its tare afterwards. Raises NoResponseError and SdoAbortError."""
    from tipforce.host.network.finger import FingertipClient

    with common.open_connection(args) as connection:
        for node_id in args.ids:
            client = FingertipClient(connection.sdo(node_id))
            if args.clear:
                client.clear_tare()
            elif not args.show:
                client.tare()
            tare = client.tare_state()
            record: dict[str, object] = {"node_id": node_id}
            record |= {f"F{k}_N": value for k, value in enumerate(tare.force_newtons, 1)}
            forces = ", ".join(f"F{k} {value:+.4f} N" for k, value in enumerate(tare.force_newtons, 1))
            since = f"since {tare.age_s} s" if any(tare.force_newtons) else "no tare"
            common.print_record(
                args, record | {"age_s": tare.age_s}, f"{common.shown_id(node_id):>11}  {forces}  {since}"
            )
    return 0


def _add_ids(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("ids", type=common.node_ids, metavar="IDS", help="10, 0x0A or 1,2,5-9")


def add_nmt_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce nmt`."""
    parser.epilog = (
        "  tipforce nmt start 1-5 --wait -i socketcan -c can0      (exit code 5 if one does not report the state)\n"
        "  tipforce nmt preop all -i socketcan -c can0             (one frame, for every node on the bus)"
    )
    add_choice(parser, "command", NMT_COMMANDS)
    parser.add_argument("ids", type=_ids_or_all, metavar="IDS", help="10, 0x0A, 1,2,5-9 or all")
    parser.add_argument(
        "--wait",
        nargs="?",
        type=float,
        const=10.0,
        metavar="S",
        help="repeat the command until each heartbeat confirms it, for this long (%(const)s s unless given)",
    )
    common.add_bus_arguments(parser)


def _ids_or_all(text: str) -> list[int]:
    """Parse node-ids; an empty list means all."""
    return [] if text == "all" else common.node_ids(text)


def run_nmt(args: argparse.Namespace) -> int:
    """Send the command; with --wait print the state of each node.

    Raises NoResponseError for a node that does not report the state in time, after printing those that do.
    """
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.nmt import NotReachedError, command_and_wait

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
            _print_states(args, error.reached)
            raise
    _print_states(args, states)
    return 0


def _print_states(args: argparse.Namespace, states: dict[int, str]) -> None:
    for node_id, state in sorted(states.items()):
        common.print_record(args, {"node_id": node_id, "state": state}, f"{common.shown_id(node_id):>11}  {state}")
