"""`python -m canopen_conformance`: test a CANopen device on a bus of python-can, by clause of the standards."""

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress

from canopen_conformance.case import Case, LostDeviceError, all_cases, by_clause, matching
from canopen_conformance.dut import Dut
from canopen_conformance.run import listing, run_and_print
from canopen_conformance.wire import DEFAULT_TOLERANCE_MS, MOST_TOLERANCE_MS, BusLink

EPILOG = """\
SYNC, NMT to all nodes and LSS reach every device on the bus. --persistent also stores parameters, restores defaults and
changes the node-id temporarily; afterwards the stored parameters are the defaults.

examples:
  python -m canopen_conformance --node-id 5 -i socketcan -c can0
  python -m canopen_conformance --list --case 'CiA 305*'
exit codes: 0 all applicable cases passed, 1 a case failed, 2 usage, no bus, 5 no response from the device,
130 interrupted
"""


def add_arguments(parser: argparse.ArgumentParser, node_id: Callable[[str], int]) -> None:
    """Add the flags that choose the device and the cases; ``node_id`` parses a node-id."""
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--node-id", type=node_id, metavar="ID", help="node-id of the device, 1 to 127")
    action.add_argument("--list", action="store_true", help="list the cases without running them")
    parser.add_argument("--case", default="*", metavar="PATTERN", help="names or clauses: 'nmt.*', 'CiA 305*'")
    parser.add_argument("--persistent", action="store_true", help="include cases that store, or change the node-id")
    parser.add_argument(
        "--tolerance", type=int, default=DEFAULT_TOLERANCE_MS, metavar="MS",
        help="of measured times (default %(default)s ms)",
    )  # fmt: skip


def _node_id(text: str) -> int:
    with suppress(ValueError):
        if 1 <= (value := int(text, 0)) <= 127:
            return value
    raise argparse.ArgumentTypeError(f"{text}: allowed is 1 to 127")


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(
        "canopen_conformance", description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_arguments(parser, _node_id)
    parser.add_argument("--json", action="store_true", help="print a JSON record a line")
    parser.add_argument("-i", "--interface", help="of python-can; default: its configuration file and environment")
    parser.add_argument("-c", "--channel", help="of the interface")
    parser.add_argument("-b", "--bitrate", type=int, help="in bit/s, where the interface sets it")
    args = parser.parse_args(words)
    cases = by_clause(matching(args.case, all_cases()))
    if not cases:
        print(f"--case {args.case!r}: matches no case; --list shows all", file=sys.stderr)
        return 2
    if args.list:
        print(listing(cases))
        return 0
    if not 0 <= args.tolerance <= MOST_TOLERANCE_MS:
        print(f"--tolerance {args.tolerance}: allowed are 0 to {MOST_TOLERANCE_MS} ms", file=sys.stderr)
        return 2
    return _run(args, cases)


def _run(args: argparse.Namespace, cases: Sequence[Case]) -> int:
    try:
        import can
    except ImportError:
        print("python-can is missing: pip install python-can", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    options = {name: getattr(args, name) for name in ("interface", "channel", "bitrate") if getattr(args, name)}
    try:
        bus = can.Bus(**options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
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
