"""`tipforce doctor`: what this machine lacks for a working CAN bus, with the next step for each."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce_tools.doctor import Check

_STYLES = {"ok": "green", "note": "yellow", "fail": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce doctor`."""
    parser.epilog = (
        "Checks the kernel, the interfaces, the source of the bus name, and the installed packages. With a bus it\n"
        "also opens it and listens; it never sends. It listens 5 s longer where a node sends a few heartbeats: two\n"
        "nodes with one node-id may send them. Without a bus it tries `tipforce vcan`, which can take seconds.\n"
        "Exit code 1 if a check failed.\n"
        "  tipforce doctor\n"
        "  tipforce doctor -i socketcan -c can0"
    )
    parser.add_argument("--listen", type=float, default=1.2, metavar="S", help="listen for S (default %(default)s s)")
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the findings; return 1 if a check failed."""
    if not 0 <= args.listen <= 3600:
        raise InputError(f"--listen {args.listen:g}: allowed are 0 to 3600 s")
    failed = False
    out = None if args.json else common.console(args)
    for check in _checks(args):
        failed |= check.state == "fail"
        if out is None:
            common.print_json(asdict(check))
            continue
        step = f"\n      -> {check.next_step}" if check.next_step else ""
        style = _STYLES[check.state]
        out.print(f"{check.state:4}", style=style, end=" ", highlight=False)
        out.print(f"{check.topic}: {check.finding}{step}", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _checks(args: argparse.Namespace) -> Iterator[Check]:
    from tipforce_tools.doctor import machine
    from tipforce_tools.doctor.bus import bus_checks, configuration_check

    options = common.bus_options(args)
    configuration = configuration_check(options)
    named = configuration.state == "ok"
    for check in machine.kernel_checks():
        # If no bus of this kernel is wanted, a kernel without CAN is only a note.
        wanted = options.get("interface") == "socketcan"
        yield check if wanted or check.state != "fail" else replace(check, state="note")
    yield configuration
    if named:
        yield from bus_checks(options, args.listen)
    else:
        yield from machine.vcan_checks()
        yield from machine.multicast_checks()
    yield from machine.iio_checks()
    yield from machine.software_checks()
