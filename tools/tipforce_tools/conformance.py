"""`tipforce conformance`: raw-frame checks of a CANopen device on a bus, by clause of the standard."""

import argparse

from tipforce.errors import InputError, NoResponseError
from tipforce_tools.cli import bus_flags, common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A reset follows each case that changes the node; nothing stays stored. A node that starts by itself is put into
    PRE-OPERATIONAL first; where reset node is slow, reset communication takes its place. SYNC, NMT to all nodes and LSS
    reach every device on the bus: run it with this device alone on the bus, or with others that may be disturbed.
    --persistent also stores parameters, restores defaults and changes the node-id temporarily; afterwards the stored
    parameters are the defaults.

    A required frame is awaited for 200 ms (an SDO response 1 s, a boot-up 5 s), a forbidden one for 30 ms. A case about
    a feature that the device lacks, or with a precondition that it may refuse, is "not applicable". Exit code 1: one
    failed.
      tipforce conformance --node-id 5 -i socketcan -c can0 --case 'sdo_block*' --json
      tipforce conformance --list --case 'CiA 305*'
    """
    from canopen_conformance.__main__ import add_arguments as add_case_arguments

    add_case_arguments(parser, common.node_id)
    bus_flags.add_bus_arguments(parser, confirm=True)


def run(args: argparse.Namespace) -> int:
    """Run the cases and print the report; 1 if any failed. Raises NoResponseError if the node does not boot."""
    from canopen_conformance.case import LostDeviceError, all_cases, by_clause, matching
    from canopen_conformance.dut import Dut
    from canopen_conformance.run import listing, run_and_print
    from canopen_conformance.wire import MOST_TOLERANCE_MS, BusLink
    from tipforce_tools import fingertip_cases

    cases = by_clause(matching(args.case, all_cases(fingertip_cases)))
    if not cases:
        raise InputError(f"--case {args.case!r}: matches no case; `tipforce conformance --list` shows all")
    if args.list:
        print(listing(cases))
        return 0
    if not 0 <= args.tolerance <= MOST_TOLERANCE_MS:
        raise InputError(f"--tolerance {args.tolerance}: allowed are 0 to {MOST_TOLERANCE_MS} ms")
    node = common.shown_node(args.node_id)
    if args.persistent:
        bus_flags.confirm(args, f"{node}: stored parameters return to defaults, node-id and bit rate are written")
    with bus_flags.open_bus(args) as bus:
        dut = Dut(BusLink(bus, args.tolerance), args.node_id, fingertip_cases.FINGERTIP)
        try:
            passed = run_and_print(dut, cases, args.persistent, common.OUTPUT.json, common.note)
        except LostDeviceError as error:
            raise NoResponseError(str(error)) from error
    return 0 if passed else 1
