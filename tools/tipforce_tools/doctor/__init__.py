"""`tipforce doctor`: what this machine and its bus lack, with the next step for each."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from tipforce.errors import EnvironmentLackError
from tipforce_tools.cli import bus_flags, common, tables

if TYPE_CHECKING:
    from tipforce.watching.findings import Finding

_STYLES = {"ok": "green", "note": "yellow", "fail": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Checks the kernel, the interfaces, the source of the bus name, and the installed packages. On a bus (of the
    flags, or the only CAN interface that is up) it listens, requests the identity of every node as `tipforce
    scan` does, and says what stands between it and forces; with HAND.toml also swapped serial numbers. Without
    a bus it tries `tipforce vcan`. Exit code 1: something is wrong.
    """
    parser.add_argument("hand", nargs="?", type=common.InputFile(), metavar="HAND.toml", help="compare the bus with it")
    an_hour = common.number_within(0.0, 3600.0, "are 0 to 3600 s")
    common.add_number(parser, "--listen", 1.2, "S", "listen for S (default %(default)s s)", an_hour)
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the findings; return 1 if something is wrong."""
    failed = False
    out = None if common.OUTPUT.json else tables.console()
    for check in _findings(args):
        failed |= check.state == "fail"
        if out is None:
            common.print_json(asdict(check))
            continue
        step = f" -> {check.next_step}" if check.next_step else ""
        out.print(f"{check.state:4}", style=_STYLES[check.state], end=" ", highlight=False)
        out.print(f"{check.topic}: {check.finding}{step}", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _findings(args: argparse.Namespace) -> Iterator[Finding]:
    from tipforce.host.hand.file import read_hand
    from tipforce.watching.findings import Finding
    from tipforce_tools.doctor import machine

    hand = read_hand(args.hand) if args.hand else None
    flags = bus_flags.bus_options(args)
    options: dict[str, Any] = {}
    try:
        options = bus_flags.find_bus(args, hand.bus if hand else None)
        configuration = machine.configuration_check(options, flags)
    except EnvironmentLackError as error:
        configuration = Finding("configuration", "note", *str(error).split(": ", 1))
    for check in machine.kernel_checks():
        # Of the kernel, only what the wanted bus needs is wrong.
        topics = ("kernel", f"interface {options.get('channel')}")
        wanted = options.get("interface") == "socketcan" and check.topic in topics
        yield check if wanted or check.state != "fail" else replace(check, state="note")
    yield configuration
    if configuration.state != "ok":
        yield from machine.vcan_checks()
        yield from machine.multicast_checks()
    yield from machine.iio_checks()
    yield from machine.software_checks()
    if configuration.state == "ok":
        yield from machine.bus_findings(options, args.listen, hand.finger if hand else ())
