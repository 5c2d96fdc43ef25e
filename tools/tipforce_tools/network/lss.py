"""`tipforce lss scan|assign|store`: node-ids by LSS (CiA 305)."""

from __future__ import annotations

import argparse
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING

from tipforce.dictionary import table
from tipforce.errors import InputError, NoResponseError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice

if TYPE_CHECKING:
    from tipforce.host.network.lss import LssAddress, LssMaster

ACTIONS = {
    "scan": "find an unconfigured node by fastscan and print its address",
    "assign": "assign node-ids",
    "store": "store the node-id and bit rate of a node in its non-volatile memory",
}
NOBODY = (
    "no unconfigured node responded. Configured nodes take no part in a fastscan: "
    "`tipforce scan` lists them, and `tipforce lss assign ID --serial N --product P` changes a node-id"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce lss`."""
    parser.epilog = (
        "assign gives IDS to unconfigured nodes, in the order in which they are found, or with --serial to the node\n"
        "with that address, which may have a node-id already (it changes at its next reset).\n\n"
        "  tipforce lss scan -i socketcan -c can0\n"
        "  tipforce lss assign 1-5 --store -i socketcan -c can0\n"
        "  tipforce lss assign 7 --serial 1005 --store -i socketcan -c can0\n"
        "Node-ids assigned without --store are lost at a power cycle."
    )
    add_choice(parser, "action", ACTIONS)
    parser.add_argument("ids", nargs="?", type=common.node_ids, metavar="IDS", help="assign: 7, or 1,2,5-9")
    parser.add_argument("--store", action="store_true", help="assign: also store the node-id in the node")
    group = parser.add_argument_group("LSS address of one node (1018h)")
    group.add_argument("--serial", type=common.unsigned32, metavar="N")
    product = table.product_code(table.MIN_GAUGES, simulated=False)
    group.add_argument("--product", type=common.unsigned32, default=product, metavar="N", help="default 0x%(default)X")
    group.add_argument("--vendor", type=common.unsigned32, default=0, metavar="N", help="default %(default)s")
    group.add_argument("--revision", type=common.unsigned32, metavar="N", help="default: this release's")
    parser.add_argument(
        "--lss-timeout", type=float, default=0.1, metavar="S", help="timeout of each response (default %(default)s s)"
    )
    common.add_confirm_argument(parser)
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the action; return 0, or 5 if no node responded. Raises RefusedError if a node refuses."""
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.lss import LssMaster

    _check(args)
    if args.action == "store" or args.store:
        common.confirm(args, "this replaces the stored node-id")
    with Bus(common.open_bus(args)) as connection, LssMaster(connection, args.lss_timeout) as master:
        if args.action == "scan":
            address = master.fastscan()
            if address is None:
                raise NoResponseError(NOBODY)
            _print(args, address, None, stored=False)
            common.note(
                args, "there may be more: a fastscan finds one at a time; `tipforce lss assign IDS` configures all"
            )
        elif args.serial is None:
            _assign(args, master)
        else:
            _configure_addressed(args, master)
    return 0


def _check(args: argparse.Namespace) -> None:
    if not 0 < args.lss_timeout < threading.TIMEOUT_MAX:
        raise InputError(f"--lss-timeout {args.lss_timeout:g}: allowed is a time over 0 s")
    if args.action == "assign" and not args.ids:
        raise InputError("lss assign: IDS missing; for example tipforce lss assign 1-5 --store")
    if args.action == "assign" and args.serial is not None and len(args.ids) != 1:
        raise InputError(f"lss assign --serial: allowed is one node-id, {len(args.ids)} given")
    if args.action == "store" and args.serial is None:
        raise InputError("lss store: add --serial N (and --product, --vendor, --revision for other products)")


def _assign(args: argparse.Namespace, master: LssMaster) -> None:
    """Give the node-ids to the nodes that fastscan finds, one after the other."""
    for number, node_id in enumerate(args.ids):
        address = master.fastscan()
        if address is None:
            if not number:
                raise NoResponseError(NOBODY)
            left = ", ".join(str(n) for n in args.ids[number:])
            raise NoResponseError(f"{number} of {len(args.ids)} nodes were found and configured; not assigned: {left}")
        _configure(args, master, address, node_id)
        master.release()


def _configure_addressed(args: argparse.Namespace, master: LssMaster) -> None:
    """Store the node-id of the node with --serial, or give it another one."""
    from tipforce.host.network.lss import LssAddress

    revision = table.REVISION if args.revision is None else args.revision
    address = LssAddress(args.vendor, args.product, revision, args.serial)
    if not master.select(address):
        raise NoResponseError(f"no node with {address} responded; `tipforce scan --json` shows the nodes' identities")
    if args.action == "store":
        master.store()
        _print(args, address, master.node_id(), stored=True)
        return
    before = master.node_id()
    _configure(args, master, address, args.ids[0])
    if before not in (255, args.ids[0]):
        common.note(args, f"node-id {common.shown_id(before)} remains active until: tipforce nmt reset-comm {before}")


def _configure(args: argparse.Namespace, master: LssMaster, address: LssAddress, node_id: int) -> None:
    master.configure_node_id(node_id)
    if args.store:
        master.store()
    _print(args, address, node_id, args.store)


def _print(args: argparse.Namespace, address: LssAddress, node_id: int | None, stored: bool) -> None:
    given = "" if node_id is None else f": node-id {common.shown_id(node_id)}{', stored' if stored else ''}"
    common.print_record(args, {**asdict(address), "node_id": node_id, "stored": stored}, f"{address}{given}")
