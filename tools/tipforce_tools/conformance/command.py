"""`tipforce conformance`: raw-frame checks of a CANopen device on a bus, by clause of the standard."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tipforce.errors import InputError, NoResponseError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    import can

    from tipforce_tools.conformance.case import Case
    from tipforce_tools.conformance.dut import Dut
    from tipforce_tools.conformance.run import Result

EPILOG = """\
Each case starts with a reset of the node and leaves nothing stored. SYNC, NMT to all nodes and LSS reach every device
on the bus: run it where the others may be disturbed, best with this one alone. --persistent also stores, restores
defaults and changes the node-id for a while; afterwards the stored parameters are the defaults.

A frame that must come is waited for 200 ms (an SDO answer 1 s, a boot-up 5 s), one that must not come 30 ms. A time
that is measured may be off by --tolerance. A case about something the device does not have is "not applicable".

examples:
  tipforce conformance --node-id 5 -i socketcan -c can0
  tipforce conformance --node-id 5 -i socketcan -c can0 --case 'sdo_block*' --json
  tipforce conformance --list --case 'CiA 305*'
exit codes: 0 all that apply passed, 1 a case failed, 2 usage, 5 the node does not answer
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `tipforce conformance`."""
    parser.epilog = EPILOG
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--node-id", type=common.node_id, metavar="ID", help="the device, 1 to 127")
    what.add_argument("--list", action="store_true", help="the cases; nothing is run")
    parser.add_argument("--case", default="*", metavar="PATTERN", help="names or clauses: 'nmt.*', 'CiA 305*'")
    parser.add_argument("--persistent", action="store_true", help="also the cases that store or change the node-id")
    parser.add_argument(
        "--tolerance", type=int, default=20, metavar="MS", help="of measured times (default %(default)s ms)"
    )
    common.add_confirm_argument(parser)
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the cases and print the report; 1 if any failed. Raises NoResponseError if the node does not boot."""
    from tipforce_tools.conformance.case import matching
    from tipforce_tools.conformance.report import by_clause

    cases = matching(args.case)
    if not cases:
        raise InputError(f"--case {args.case!r}: no case is named so; `tipforce conformance --list` shows all")
    if args.list:
        for case in by_clause(cases):
            print(f"{case.clause:22} {case.name:36} {case.title}")
        return 0
    if args.tolerance < 0:
        raise InputError(f"--tolerance {args.tolerance}: allowed is 0 or more")
    common.set_up_logging(args)
    if args.persistent:
        what = "stored parameters return to defaults, node-id and bit rate are written"
        common.confirm(args, f"node {common.shown_id(args.node_id)}: {what}")
    return _run(args, cases)


def _run(args: argparse.Namespace, cases: Sequence[Case]) -> int:
    from tipforce_tools.conformance import report
    from tipforce_tools.conformance.run import FAIL, run_on

    results: list[Result] = []
    with common.open_bus(args) as bus:
        dut = _device(bus, args)
        try:
            with _progress(args, len(cases)) as advance:
                for result in run_on(dut, cases, args.persistent):
                    results.append(result)
                    if args.json:
                        common.print_json(report.record(result))
                    advance()
        finally:  # what was found counts, also when Ctrl-C or a device that died ends the run
            if args.json:
                common.note(args, report.summary(results))
            else:
                print("\n".join(report.lines(results)))
    return 1 if any(result.verdict == FAIL for result in results) else 0


def _device(bus: can.BusABC, args: argparse.Namespace) -> Dut:
    """The device, which must boot when it is told to."""
    from tipforce_tools.conformance.case import CheckError
    from tipforce_tools.conformance.dut import Dut
    from tipforce_tools.conformance.links import BusLink

    dut = Dut(BusLink(bus, args.tolerance), args.node_id)
    try:
        dut.reset()
    except CheckError as failure:
        raise NoResponseError(
            f"node {common.shown_id(args.node_id)}: no boot-up message after NMT reset node; is it on this bus, "
            "is the bit rate right?"
        ) from failure
    return dut


@contextmanager
def _progress(args: argparse.Namespace, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on stderr, on a terminal alone; yields what advances it."""
    if args.quiet or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.progress import Progress

    with Progress(console=common.console(args, stderr=True), transient=True) as progress:
        task = progress.add_task("conformance", total=total)
        yield lambda: progress.advance(task)
