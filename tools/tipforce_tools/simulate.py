"""`tipforce simulate`: devices from their EDS or DCF, or a machine in TOML, on a bus."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common

if TYPE_CHECKING:
    from canopen_device.machine.device import SimulatedDevice

EPILOG = """\
  tipforce simulate cia402 --node-id 5 -i socketcan -c vcan0          the drive that tipforce ships
  tipforce simulate drive.eds io.eds --node-id 5,10 --set 10:0x6000:01=0x0F -i socketcan -c vcan0
  tipforce simulate press.toml -i socketcan -c vcan0                  a machine: values, signals, faults, applications

Where an EDS leaves CiA 306 or contradicts itself, a warning names the line and how it is read. docs/simulate.md
describes the TOML file and applications in Python.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce simulate`."""
    parser.epilog = EPILOG
    parser.add_argument("files", nargs="+", metavar="FILE", help="EDS, DCF or XDD files, cia402, or one TOML file")
    parser.add_argument("--node-id", type=common.node_ids, metavar="IDS", help="5, or 1,2,5-9: one for each file")
    parser.add_argument("--application", default="", metavar="NAME", help="cia402, or FILE:CLASS")
    parser.add_argument("--store", metavar="FILE", default="", help="file of stored parameters, for one node")
    metavar = "[ID:]OBJECT=VALUE"
    parser.add_argument("--set", action="append", default=[], metavar=metavar, dest="values", help="initial value")
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the devices until Ctrl-C or SIGTERM; return 0."""
    from tipforce.host.network.open_bus import open_port
    from tipforce_tools.cli.service import serve

    devices = _devices(args)
    for device in devices:
        for warning in device.description.warnings:
            common.note(f"warning: {warning}")
    port, place = open_port(**bus_flags.find_bus(args))
    shown = ", ".join(f"{common.shown_id(device.node_id)} {device.description.product_name}" for device in devices)
    serve(f"node {shown}", f"on {place}", devices, [device.core for device in devices], port)
    return 0


def _devices(args: argparse.Namespace) -> list[SimulatedDevice]:
    from canopen_device.machine.file import check_node_ids, read_machine
    from canopen_device.machine.running import made_device

    if any(file.endswith(".toml") for file in args.files):
        if len(args.files) > 1 or args.node_id or args.values or args.application or args.store:
            raise InputError("a machine in TOML stands alone: its devices have their node-ids, values and applications")
        return read_machine(args.files[0])
    files, ids = args.files, args.node_id
    if ids is None:  # a DCF names its own
        pairs: list[tuple[str, int | None]] = [(file, None) for file in files]
    else:  # one file may have many node-ids
        files = files * len(ids) if len(files) == 1 else files
        if len(files) != len(ids):
            raise InputError(f"--node-id: {len(ids)} for {len(files)} files; give one for each")
        pairs = list(zip(files, ids, strict=True))
    if args.store and len(pairs) > 1:
        raise InputError("--store: one file belongs to one node; use a TOML file for several")
    values = _values(args.values, [node_id for _, node_id in pairs])
    made = [made_device(file, each, args.application, values.get(each), store=args.store) for file, each in pairs]
    check_node_ids(made)
    return made


def _values(given: list[str], node_ids: list[int | None]) -> dict[int | None, dict[str, str]]:
    """Return the values of --set by node-id."""
    by_node: dict[int | None, dict[str, str]] = {}
    for text in given:
        place, equal, value = text.partition("=")
        head, colon, rest = place.partition(":")
        own = head.isdigit() and bool(colon)
        if not equal or not (rest if own else place):
            raise InputError(f"--set {text!r}: the form is OBJECT=VALUE, or ID:OBJECT=VALUE")
        if own and int(head) not in node_ids:
            raise InputError(f"--set {text!r}: no node {head} here")
        if not own and len(node_ids) > 1:
            raise InputError(f"--set {text!r}: several nodes; write ID:OBJECT=VALUE")
        by_node.setdefault(int(head) if own else node_ids[0], {})[rest if own else place] = value
    return by_node
