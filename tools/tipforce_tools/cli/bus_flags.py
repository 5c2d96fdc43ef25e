"""python-can's bus flags without importing python-can, which adds a fifth of a second to each `--help`.

The flags accept the same values as those of ``can.cli.add_bus_arguments`` (the tests compare them). Values that need
more than a conversion are parsed by python-can, imported at that point. The help texts are shorter than python-can's,
which fill two screens for every command that uses a bus.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

BUILT_IN_INTERFACES = (
    "canalystii", "cantact", "etas", "gs_usb", "iscan", "ixxat", "kvaser", "neousys", "neovi", "nican", "nixnet",
    "pcan", "robotell", "seeedstudio", "serial", "slcan", "socketcan", "socketcand", "systec", "udp_multicast",
    "usb2can", "vector", "virtual",
)  # fmt: skip
"""Interfaces included in python-can 4.6; plug-ins add more."""

_PLUGIN_GROUP = b"[can.interface]"  # in a distribution's entry_points.txt


class Interfaces:
    """The choices of -i: python-can is imported only for a name that it does not include."""

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN_INTERFACES or name in _valid_interfaces()

    def __iter__(self) -> Iterator[str]:
        return iter(_valid_interfaces() if "can" in sys.modules or _some_plugin() else BUILT_IN_INTERFACES)


def _valid_interfaces() -> tuple[str, ...]:
    import can

    return tuple(sorted(can.VALID_INTERFACES))


def _some_plugin() -> bool:
    """Return whether an installed distribution declares an interface for python-can."""
    for folder in sys.path:
        for file in Path(folder or ".").glob("*-info/entry_points.txt"):
            try:
                if _PLUGIN_GROUP in file.read_bytes():
                    return True
            except OSError:  # unreadable for python-can, too
                continue
    return False


class _PythonCanAction(argparse.Action):
    """Parse as the action of the same name in can.cli; its output goes to stderr, because stdout is for data."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
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
    group.add_argument(
        "-i", "--interface", default=unset, choices=Interfaces(), metavar="INTERFACE",
        help="one of %(choices)s",
    )  # fmt: skip
    group.add_argument(
        "-b", "--bitrate", type=int, default=unset, metavar="BIT/S",
        help="if the interface sets it; for SocketCAN use `ip link`",
    )  # fmt: skip
    return group


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """Add -i -c -b --fd --data-bitrate --timing --bus-kwargs."""
    group, unset = add_bus_name_arguments(parser), argparse.SUPPRESS
    group.add_argument("--fd", default=unset, action="store_true", help="CAN FD")
    group.add_argument("--data-bitrate", type=int, default=unset, metavar="BIT/S", help="of the CAN FD data phase")
    group.add_argument(
        "--timing", action=_PythonCanAction, nargs=argparse.ONE_OR_MORE, default=unset, metavar="NAME=N",
        help="bit timing instead of a bit rate: f_clock=8_000_000 tseg1=5 tseg2=2 sjw=2 brp=2 nof_samples=1",
    )  # fmt: skip
    group.add_argument(
        "--bus-kwargs", action=_PythonCanAction, nargs=argparse.ONE_OR_MORE, default=unset, metavar="NAME=VALUE",
        help="further options of the interface, for example app_name=MyCanApp serial=1234",
    )  # fmt: skip
