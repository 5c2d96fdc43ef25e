"""`python -m canopen_conformance`: test a CANopen device on a bus of python-can, by clause of the standards."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence

from canopen_conformance.case import LostDeviceError, all_cases, by_clause, matching
from canopen_conformance.dut import Dut
from canopen_conformance.run import listing, run_and_print
from canopen_conformance.wire import DEFAULT_TOLERANCE_MS, BusLink

EPILOG = """\
SYNC, NMT to all nodes and LSS reach every device on the bus. --persistent also stores parameters, restores defaults and
changes the node-id temporarily; afterwards the stored parameters are the defaults.

examples:
  python -m canopen_conformance --node-id 5 -i socketcan -c can0
  python -m canopen_conformance --list --case 'CiA 305*'
exit codes: 0 all applicable cases passed, 1 a case failed, 2 usage, no bus, 5 no response from the device,
130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    arguments = argparse.ArgumentParser(
        "canopen_conformance", description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    action = arguments.add_mutually_exclusive_group(required=True)
    action.add_argument("--node-id", type=int, choices=range(1, 128), metavar="ID", help="of the device, 1 to 127")
    action.add_argument("--list", action="store_true", help="list the cases without running them")
    arguments.add_argument("--case", default="*", metavar="PATTERN", help="names or clauses: 'nmt.*', 'CiA 305*'")
    arguments.add_argument("--persistent", action="store_true", help="include cases that store, or change the node-id")
    arguments.add_argument("--tolerance", type=int, default=DEFAULT_TOLERANCE_MS, metavar="MS", help="of times")
    arguments.add_argument("--json", action="store_true", help="print a JSON record a line")
    arguments.add_argument("-i", "--interface", help="of python-can; default: its configuration file and environment")
    arguments.add_argument("-c", "--channel", help="of the interface")
    arguments.add_argument("-b", "--bitrate", type=int, help="in bit/s, where the interface sets it")
    return arguments


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    args = parser().parse_args(words)
    cases = by_clause(matching(args.case, all_cases()))
    if not cases:
        print(f"--case {args.case!r}: matches no case; --list shows all", file=sys.stderr)
        return 2
    if args.list:
        print(listing(cases))
        return 0
    if args.tolerance < 0:
        print(f"--tolerance {args.tolerance}: allowed is 0 or more", file=sys.stderr)
        return 2
    import can

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    options = {name: getattr(args, name) for name in ("interface", "channel", "bitrate") if getattr(args, name)}
    try:
        bus = can.Bus(**options)
    except (can.CanError, OSError, ValueError, ImportError) as error:
        print(f"the bus cannot be opened: {error}", file=sys.stderr)
        return 2
    try:
        with bus:
            dut = Dut(BusLink(bus, args.tolerance), args.node_id)
            passed = run_and_print(
                dut, cases, args.persistent, args.json, lambda counts: print(counts, file=sys.stderr)
            )
    except LostDeviceError as error:
        print(error, file=sys.stderr)
        return 5
    except KeyboardInterrupt:
        return 130
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
