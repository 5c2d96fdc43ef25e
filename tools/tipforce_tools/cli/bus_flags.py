"""The bus of a command line: python-can's flags, and the bus that they, a file or the environment name. Python-can, a
fifth of a second of each `--help`, is not imported for the flags alone. They accept the values of
``can.cli.add_bus_arguments`` (the tests compare them); values that need more than a conversion python-can parses.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

from tipforce.errors import DuplicateNodeError, EnvironmentLackError, InputError, TipforceError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    import can

    from tipforce.host.network.bus import Bus
    from tipforce.host.network.interfaces import Link

BUILT_IN_INTERFACES = (
    "canalystii", "cantact", "etas", "gs_usb", "iscan", "ixxat", "kvaser", "neousys", "neovi", "nican", "nixnet",
    "pcan", "robotell", "seeedstudio", "serial", "slcan", "socketcan", "socketcand", "systec", "udp_multicast",
    "usb2can", "vector", "virtual",
)  # fmt: skip
"""Interfaces included in python-can 4.6; plug-ins add more."""


class Interfaces:
    """The choices of -i; plug-ins are looked for only when a name is not included, or all are listed."""

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN_INTERFACES or name in tuple(self)

    def __iter__(self) -> Iterator[str]:
        from importlib.metadata import entry_points

        return iter(sorted({*BUILT_IN_INTERFACES, *entry_points(group="can.interface").names}))


class _PythonCanAction(argparse.Action):
    """Parse as the action of the same name in can.cli; its output goes to stderr, because stdout is for data."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:  # fmt: skip
        import can.cli

        real = argparse.ArgumentParser(add_help=False)
        can.cli.add_bus_arguments(real)
        (action,) = (action for action in real._actions if action.dest == self.dest)
        with redirect_stdout(sys.stderr):
            action(parser, namespace, values, option_string)


def add_bus_name_arguments(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add -c -i -b, which name a bus; flags not given stay unset, as with python-can."""
    group = parser.add_argument_group(
        "bus arguments", "those of python-can; defaults from CAN_INTERFACE, CAN_CHANNEL, CAN_BITRATE, or ~/.canrc"
    )
    unset = argparse.SUPPRESS
    group.add_argument("-c", "--channel", default=unset, metavar="CHANNEL", help="can0, vcan0, /dev/ttyACM0, ...")
    known, rate = Interfaces(), "if the interface sets it; for SocketCAN use `ip link`"
    group.add_argument(
        "-i", "--interface", default=unset, choices=known, metavar="INTERFACE", help="one of %(choices)s"
    )
    group.add_argument("-b", "--bitrate", type=int, default=unset, metavar="BIT/S", help=rate)
    return group


def add_bus_arguments(parser: argparse.ArgumentParser, *, sdo: bool = False, confirm: bool = False) -> None:
    """Add the bus and output flags of a command; ``sdo``: also timeout and retries; ``confirm``: also --yes."""
    if confirm:
        common.add_confirm_argument(parser)
    add_bus_flags(parser)
    if sdo:
        group, after = parser.add_argument_group("SDO"), "after a timeout (%(default)s)"
        common.add_number(group, "--timeout", 0.5, "S", "timeout of a response (default %(default)s s)", common.timeout)
        group.add_argument("--retries", type=common.whole_number, default=2, metavar="N", help=after)
    common.add_output_arguments(parser)


def add_bus_flags(parser: argparse.ArgumentParser) -> None:
    """Add python-can's bus flags alone, -i -c -b --fd --data-bitrate --timing --bus-kwargs."""
    group, unset = add_bus_name_arguments(parser), argparse.SUPPRESS
    group.add_argument("--fd", default=unset, action="store_true", help="CAN FD")
    group.add_argument("--data-bitrate", type=int, default=unset, metavar="BIT/S", help="of the CAN FD data phase")
    timing = "bit timing instead of a bit rate: f_clock=8_000_000 tseg1=5 tseg2=2 sjw=2 brp=2 nof_samples=1"
    further = "further options of the interface, for example app_name=MyCanApp serial=1234"
    for flag, metavar, text in (("--timing", "NAME=N", timing), ("--bus-kwargs", "NAME=VALUE", further)):
        group.add_argument(flag, action=_PythonCanAction, nargs="+", default=unset, metavar=metavar, help=text)


def bus_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the bus flags that the command line contains, as keywords of ``can.Bus``. Raises InputError."""
    names = ("interface", "channel", "bitrate", "fd", "data_bitrate", "timing")
    options = {name: getattr(args, name) for name in names if hasattr(args, name)}
    for name in ("bitrate", "data_bitrate"):
        if options.get(name, 1) <= 0:
            raise InputError(f"--{name.replace('_', '-')} {options[name]}: allowed is a rate over 0 bit/s")
    return options | getattr(args, "bus_kwargs", {})


def find_bus(
    args: argparse.Namespace, of_file: Mapping[str, Any] | None = None, *, named: bool = False
) -> dict[str, Any]:
    """Return the bus of the flags, of a file, or of python-can's files and environment, as keywords of ``can.Bus``.

    Without any, that of the only SocketCAN interface that is up, which a line on stderr names. A channel alone is such
    an interface, also one ``named`` without a flag: `dump vcan0`. Raises EnvironmentLackError naming the interfaces."""
    options = {**(of_file or {}), **bus_options(args)}
    if "interface" in options and (named or "channel" in options):
        return options
    import can.util

    configured: Mapping[str, Any] = {}
    try:
        configured = can.util.load_config(config=dict(options))
    except can.CanInterfaceNotImplementedError as error:
        if "interface" in options or 'type "None"' not in str(error):  # open_bus says why
            return options
    options |= {key: configured[key] for key in ("interface", "channel") if configured.get(key) is not None}
    if "interface" in options or not (named or sys.platform == "linux"):
        return options
    if not named and "channel" not in options:
        options["channel"] = args.channel = _only_interface()
    options["interface"] = "socketcan"
    if not named:
        args.interface = "socketcan"
    return options


def _only_interface() -> str:
    from tipforce.host.network.interfaces import interfaces

    known = interfaces()
    up = [name for name, is_up in known.items() if is_up]
    if len(up) == 1:
        common.note(f"bus: -i socketcan -c {up[0]}, the only CAN interface that is up")
        return up[0]
    reason = (
        "no CAN interface here; use -i and -c, as in -i slcan -c /dev/ttyACM0, or set CAN_INTERFACE and "
        "CAN_CHANNEL; `tipforce vcan` has buses without hardware"
    )
    if up:
        reason = f"{', '.join(up)} are up: add -i socketcan -c {up[0]}"
    elif known:
        reason = f"{', '.join(known)} down; `sudo ip link set {next(iter(known))} up type can bitrate 1000000`"
    raise EnvironmentLackError(f"no bus given: {reason}")


def open_bus(args: argparse.Namespace) -> can.BusABC:
    """Open the bus that ``find_bus`` returns."""
    from tipforce.host.network import interfaces

    return interfaces.open_bus(**find_bus(args))


@contextmanager
def open_connection(args: argparse.Namespace) -> Iterator[Bus]:
    """Return a host connection on that bus. At its end raises DuplicateNodeError if two nodes have responded as one.
    After another error, but of a wrong input, a line on stderr says what is wrong with the bus as a whole."""
    from tipforce.host.network.bus import Bus

    patience = (args.timeout, args.retries) if hasattr(args, "retries") else ()
    with Bus(open_bus(args), *patience) as connection:
        begun_s = time.monotonic()
        try:
            yield connection
        except (DuplicateNodeError, InputError):
            raise
        except TipforceError:
            from tipforce.watching.findings import Observed, of_the_wire

            connection.check_reception()  # a cause of the error, as the next
            connection.check_duplicates()
            seen = Observed(heard_s=time.monotonic() - begun_s, link=link_of(args))
            seen.count(connection.buffer.take_all())
            for finding in of_the_wire(seen):
                common.note(str(finding))
            raise
        connection.check_duplicates()


def link_of(args: argparse.Namespace) -> Link | None:
    """Return what the kernel says of the interface of the bus."""
    from tipforce.host.network.interfaces import links

    options = find_bus(args)
    return links().get(str(options.get("channel"))) if options.get("interface") == "socketcan" else None


def confirm(args: argparse.Namespace, what: str) -> None:
    """Ask before a persistent change on a bus that is not virtual, without --yes. Raises InputError without a yes."""
    options = bus_options(args)
    virtual = options.get("interface") in ("virtual", "udp_multicast") or "vcan" in str(options.get("channel", ""))
    if getattr(args, "yes", False) or virtual:
        return
    if not sys.stdin.isatty():
        raise InputError(f"{what}; stdin is not a terminal: add --yes to confirm")
    print(f"{what}. Continue? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise InputError("not done")
