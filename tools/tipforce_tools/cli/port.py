"""Open the bus of the flags for a device."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.running.loop import Port


def open_port(args: argparse.Namespace) -> tuple[Port, str]:
    """Return the port and its name: kernel sockets for SocketCAN, python-can for every other interface."""
    from tipforce.errors import EnvironmentLackError
    from tipforce.running.ports import PythonCanPort, SocketCanPort

    options = common.bus_options(args)
    if sys.platform == "linux" and options.get("interface") == "socketcan" and "channel" in options:
        try:
            return SocketCanPort(options["channel"]), options["channel"]
        except OSError as error:
            raise EnvironmentLackError(
                f"interface socketcan, channel {options['channel']}: {error.strerror}; `ip -br link` lists interfaces; "
                "`tipforce vcan -- ...` provides vcan"
            ) from error
    bus = common.open_bus(args)
    return PythonCanPort(bus), str(bus.channel_info)
