"""`tipforce scan`, `read`, `tare`, `nmt`, `lss`, `firmware`: nodes of a bus, with a line or a JSON record for each."""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from tipforce.dictionary import table
from tipforce.errors import DuplicateNodeError, InputError, NoResponseError
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.actions import add_choice

if TYPE_CHECKING:
    from tipforce.host.network.finger import Identity
    from tipforce.host.network.firmware import NodeProgram
    from tipforce.host.network.lss import LssMaster

_CONTACT = (
    "node_id", "t_s", "counter", "P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg",
    "status", "reason", "microstrain",
)  # fmt: skip
NMT_COMMANDS = {
    "start": "enter operational: PDOs and SDO",
    "stop": "enter stopped: neither PDOs nor SDO, only heartbeat and NMT",
    "preop": "enter pre-operational: SDO, no PDOs",
    "reset-node": "reset the node to its stored parameters",
    "reset-comm": "reset only the communication objects",
}

LSS_ACTIONS = {
    "scan": "find an unconfigured node by fastscan and print its address",
    "assign": "assign node-ids",
    "store": "store the node-id and bit rate of a node in its non-volatile memory",
}
NO_UNCONFIGURED_NODE = (
    "no unconfigured node responded. Configured nodes take no part in a fastscan: "
    "`tipforce scan` lists them, and `tipforce lss assign ID --serial N --product P` changes a node-id"
)


def add_scan_arguments(parser: argparse.ArgumentParser) -> None:
    """Exit code 1 if two nodes use one node-id: both respond to each request."""
    every = list(range(1, 128))
    parser.add_argument("--nodes", type=common.node_ids, default=every, metavar="IDS", help="1,2,5-9 (default: all)")
    wait = common.number_within(0.0, threading.TIMEOUT_MAX, "is 0 s or more")
    common.add_number(parser, "--wait", 1.2, "S", "wait for responses and heartbeats (default %(default)s s)", wait)
    bus_flags.add_bus_arguments(parser, sdo=True)


def run_scan(args: argparse.Namespace) -> int:
    """Print a line for each node; return 5 if there is none. Raises DuplicateNodeError for two with one node-id."""
    from tipforce.host.network.find import find_nodes
    from tipforce.watching.findings import Observed, findings

    with bus_flags.open_connection(args) as connection:
        begun_s = time.monotonic()
        seen = Observed(duplicates=connection.duplicates)
        nodes = find_nodes(connection, args.nodes, args.wait, seen.count)
        seen.heard_s = time.monotonic() - begun_s
        for node in nodes:
            line = node.device
            if not node.duplicate:
                faults = f"  faults: {node.faults}" if node.faults else ""
                line = f"{line:24}  serial {node.serial:<10}  {node.calibration:28}  EDS {node.eds}{faults}"
            _print(asdict(node), f"{node.state:15}  {line}")
        seen.add_nodes(nodes)
        seen.link = bus_flags.link_of(args)
        duplicates = [node.duplicate for node in nodes if node.duplicate]
        said = findings(seen)
        for finding in said:
            if finding.topic != "faults" and str(finding) not in duplicates:
                common.note(str(finding))
        if duplicates:
            raise DuplicateNodeError("; ".join(duplicates))
    if not nodes:
        why = "" if said else ": is the bus powered and terminated, is the bit rate right?"
        common.note(f"no node responded{why}")
    return 0 if nodes else 5


def add_read_arguments(parser: argparse.ArgumentParser) -> None:
    """A finger that is pre-operational is started. An unknown value prints as nan (JSON: null), with its reason;
    where a command ends it, stderr names that once.
      tipforce read 1-5 -n 100 --json -i socketcan -c can0 | jq .P_newtons
    """
    _add_ids(parser)
    parser.add_argument("-n", "--count", type=common.count, default=1, metavar="N", help="samples of each (default 1)")
    common.add_number(parser, "--wait", 5.0, "S", "for each sample (default %(default)g s)", common.timeout)
    bus_flags.add_bus_arguments(parser, sdo=True)


def run_read(args: argparse.Namespace) -> int:
    """Print ``count`` new samples of each finger: 0. Raises NoResponseError for a finger that gives none in time."""
    from tipforce.samples.reasons import NOT_CALIBRATED
    from tipforce.watching.findings import not_calibrated

    bare: set[int] = set()
    with bus_flags.open_connection(args) as connection:
        for _ in range(args.count):
            for node_id in args.ids:
                contact = connection.finger(node_id).read(args.wait)
                record = {name: getattr(contact, name) for name in _CONTACT}
                u = f"  u(P) {contact.u_P_newtons:.3f} N" if math.isfinite(contact.u_P_newtons) else ""
                _print(record, f"{contact}{u}")
                if NOT_CALIBRATED in contact.reason and node_id not in bare:
                    bare.add(node_id)
                    common.note(str(not_calibrated(node_id)))
                sys.stdout.flush()
    return 0


def add_tare_arguments(parser: argparse.ArgumentParser) -> None:
    """Tare the unloaded fingertip: a tare under load hides that load. It is not stored, and ends with a reset or
    a new calibration. A node without a calibration refuses (exit code 11).
      tipforce tare 1-5 --show -i socketcan -c can0
    """
    _add_ids(parser)
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--clear", action="store_true", help="clear the tare")
    group.add_argument("--show", action="store_true", help="change nothing")
    bus_flags.add_bus_arguments(parser, sdo=True)


def run_tare(args: argparse.Namespace) -> int:
    """Act on each node and print its tare afterwards. Raises NoResponseError and SdoAbortError."""
    with bus_flags.open_connection(args) as connection:
        for node_id in args.ids:
            client = connection.finger(node_id)
            if args.clear:
                client.clear_tare()
            elif not args.show:
                client.tare()
            tare = client.tare_state()
            forces = [(f"F{k}", newtons) for k, newtons in enumerate(tare.force_newtons, 1)]
            text = ", ".join(f"{name} {newtons:+.4f} N" for name, newtons in forces)
            since = f"since {tare.age_s} s" if any(tare.force_newtons) else "no tare"
            record = {"node_id": node_id, **{f"{name}_N": newtons for name, newtons in forces}, "age_s": tare.age_s}
            _print(record, f"{text}  {since}")
    return 0


def _print(record: dict[str, Any], text: str) -> None:
    common.print_record(record, f"{common.shown_id(record['node_id']):>11}  {text}")


def _add_ids(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("ids", type=common.node_ids, metavar="IDS", help="10, 0x0A or 1,2,5-9")


def add_nmt_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "  tipforce nmt start 1-5 --wait -i socketcan -c can0      (exit code 5 if one does not report the state)\n"
        "  tipforce nmt preop all -i socketcan -c can0             (one frame, for every node on the bus)"
    )
    add_choice(parser, "command", NMT_COMMANDS)
    ids = lambda text: [] if text == "all" else common.node_ids(text)  # noqa: E731
    parser.add_argument("ids", type=ids, metavar="IDS", help="10, 0x0A, 1,2,5-9 or all")
    parser.add_argument(
        "--wait", nargs="?", type=common.timeout, const=10.0, metavar="S",
        help="repeat the command until each heartbeat confirms it, for this long (%(const)s s unless given)",
    )  # fmt: skip
    bus_flags.add_bus_arguments(parser)


def run_nmt(args: argparse.Namespace) -> int:
    """Send the command; with --wait print the states. Raises NoResponseError after printing those that are reached."""
    from tipforce.host.network.find import NotReachedError, command_and_wait

    if args.wait is not None and not args.ids:
        raise InputError("nmt all --wait: needs node-ids, for example 1-5")
    with bus_flags.open_connection(args) as connection:
        if args.wait is None:
            for node_id in args.ids or [0]:
                connection.nmt(args.command, node_id)
            return 0
        try:
            states = command_and_wait(connection, args.command, args.ids, args.wait)
            connection.check_duplicates(args.ids)
        except NotReachedError as error:
            _print_states(error.reached)
            raise
    _print_states(states)
    return 0


def _print_states(states: dict[int, str]) -> None:
    for node_id, state in sorted(states.items()):
        _print({"node_id": node_id, "state": state}, state)


def add_lss_arguments(parser: argparse.ArgumentParser) -> None:
    """assign gives IDS to unconfigured nodes, in the order in which they are found, or with --serial to the node
    with that address, whose node-id changes at its next reset. Without --store they are lost at a power cycle.
      tipforce lss assign 7 --serial 1005 --store -i socketcan -c can0
    """
    add_choice(parser, "action", LSS_ACTIONS)
    parser.add_argument("ids", nargs="?", type=common.node_ids, metavar="IDS", help="assign: 7, or 1,2,5-9")
    parser.add_argument("--store", action="store_true", help="assign: also store the node-id in the node")
    group = parser.add_argument_group("LSS address of one node (1018h)")
    group.add_argument("--serial", type=common.unsigned32, metavar="N")
    product = table.product_code(table.MIN_GAUGES, simulated=False)
    group.add_argument("--product", type=common.unsigned32, default=product, metavar="N", help="default 0x%(default)X")
    group.add_argument("--vendor", type=common.unsigned32, default=0, metavar="N", help="default %(default)s")
    group.add_argument("--revision", type=common.unsigned32, metavar="N", help="default: this release's")
    timeout_help = "timeout of each response (default %(default)s s)"
    common.add_number(parser, "--lss-timeout", 0.1, "S", timeout_help, common.timeout)
    bus_flags.add_bus_arguments(parser, confirm=True)


def run_lss(args: argparse.Namespace) -> int:
    """Run the action; return 0, or 5 if no node responded. Raises RefusedError if a node refuses."""
    from tipforce.host.network.finger import Identity
    from tipforce.host.network.lss import LssMaster

    if args.action == "assign" and not args.ids:
        raise InputError("lss assign: IDS missing; for example tipforce lss assign 1-5 --store")
    if args.action == "assign" and args.serial is not None and len(args.ids) != 1:
        raise InputError(f"lss assign --serial: allowed is one node-id, {len(args.ids)} given")
    if args.action == "store" and args.serial is None:
        raise InputError("lss store: add --serial N (and --product, --vendor, --revision for other products)")
    if args.action == "store" or args.store:
        bus_flags.confirm(args, "this replaces the stored node-id")
    with bus_flags.open_connection(args) as connection, LssMaster(connection, args.lss_timeout) as master:
        if args.action == "scan":
            _configure_found(master, [None], store=False)
            common.note("there may be more: a fastscan finds one at a time; `tipforce lss assign IDS` configures all")
        elif args.serial is None:
            _configure_found(master, args.ids, store=args.store)
        else:
            revision = table.REVISION if args.revision is None else args.revision
            address = Identity(args.vendor, args.product, revision, args.serial)
            _configure_addressed(master, address, args.ids[0] if args.action == "assign" else None, args.store)
    return 0


def _configure_found(master: LssMaster, node_ids: Sequence[int | None], *, store: bool) -> None:
    """Give the node-ids to the nodes that fastscan finds, one after the other; None: the node keeps none."""
    for number, node_id in enumerate(node_ids):
        address = master.fastscan()
        if address is None and not number:
            raise NoResponseError(NO_UNCONFIGURED_NODE)
        if address is None:
            left = ", ".join(map(str, node_ids[number:]))
            raise NoResponseError(f"{number} of {len(node_ids)} nodes were found and configured; not assigned: {left}")
        if node_id is not None:
            master.configure_node_id(node_id)
        if store:
            master.store()
        _print_lss(address, node_id, store)


def _configure_addressed(master: LssMaster, address: Identity, node_id: int | None, store: bool) -> None:
    """Give the node with this address another node-id; without one store the one that it has."""
    if not master.select(address):
        raise NoResponseError(f"no node with {address} responded; `tipforce scan --json` shows the nodes' identities")
    before = master.node_id()
    if node_id is not None:
        master.configure_node_id(node_id)
    if store or node_id is None:
        master.store()
    _print_lss(address, before if node_id is None else node_id, store or node_id is None)
    if node_id is not None and before not in (255, node_id):
        common.note(f"node-id {common.shown_id(before)} remains active until: tipforce nmt reset-comm {before}")


def _print_lss(address: Identity, node_id: int | None, stored: bool) -> None:
    given = "" if node_id is None else f": node-id {common.shown_id(node_id)}{', stored' if stored else ''}"
    common.print_record({**asdict(address), "node_id": node_id, "stored": stored}, f"{address}{given}")


def add_firmware_show_arguments(parser: argparse.ArgumentParser) -> None:
    _add_ids(parser)
    bus_flags.add_bus_arguments(parser, sdo=True)


def run_firmware_show(args: argparse.Namespace) -> int:
    """Print the version of each node, and why its last update failed: 0. Raises NoResponseError and RefusedError."""
    from tipforce.host.network.firmware import node_program

    with bus_flags.open_connection(args) as connection:
        for node_id in args.ids:
            program = node_program(connection.sdo(node_id))
            _print_program(node_id, program, program.version)
    return 0


def add_firmware_install_arguments(parser: argparse.ArgumentParser) -> None:
    """Installs on one node after the other. The node enters pre-operational and receives the image in blocks with
    CRC into the slot that does not run. It checks product, CRC-32 and signature, and restarts with the image.
    After five seconds of communication it confirms the program. Otherwise, and after a power cut at any time
    before, it runs the previous program. `tipforce nmt start` starts measurement again.

    An image for another product, with a wrong signature, or older than the installed program (without
    --allow-downgrade) is refused with exit code 12, as is every image by a node without program slots. The
    nodes after it are not touched.
      tipforce firmware install 1-5 program.bin -i socketcan -c can0
    """
    _add_ids(parser)
    parser.add_argument("file", type=common.InputFile(), metavar="FILE", help="program image")
    parser.add_argument("--allow-downgrade", action="store_true", help="install an image older than the program")
    bus_flags.add_bus_arguments(parser, sdo=True, confirm=True)
    parser.set_defaults(timeout=3.0)  # a node checks the complete image before it responds to the last block


def run_firmware_install(args: argparse.Namespace) -> int:
    """Install: 0. Raises InputError for the file, RefusedError and NoResponseError of a node."""
    from tipforce.host.network.firmware import Firmware, install, node_program

    firmware = Firmware.read(args.file)
    with bus_flags.open_connection(args) as connection:
        nodes = ", ".join(map(common.shown_id, args.ids))
        bus_flags.confirm(args, f"node {nodes}: this replaces the program by {firmware.header.version_text()}")
        for node_id in args.ids:
            before = node_program(connection.sdo(node_id))
            with common.progress(common.shown_node(node_id), len(firmware.content), absolute=True) as arrived:
                program = install(connection, node_id, firmware, allow_downgrade=args.allow_downgrade, progress=arrived)
            change = f"{before.version} -> {program.version}"
            _print_program(node_id, program, change, version_before=before.version)
    return 0


def _print_program(node_id: int, program: NodeProgram, change: str, **further: str) -> None:
    identification = f"0x{program.identification:08X}"
    record = {"node_id": node_id, "version": program.version, "identification": identification, **further}
    reason = f"  last update: {program.reason}" if program.reason else ""
    _print(record | {"reason": program.reason}, f"{change}  {identification}{reason}")
