"""Open a bus of python-can, with errors that name the commands which help."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import can

from canopen_device.running import open_bus as devices_bus
from tipforce.errors import EnvironmentLackError

if TYPE_CHECKING:
    from canopen_device.running.ports import PythonCanPort, SocketCanPort


def open_bus(**options: Any) -> can.BusABC:
    """Return python-can's bus. Raises as canopen_device's open_bus does."""
    return devices_bus.open_bus(
        options,
        "use -i and -c, as in -i socketcan -c can0, or set CAN_INTERFACE and CAN_CHANNEL; "
        "`tipforce doctor` lists the interfaces of this machine",
        "check -i and -c (`ip -br link` lists interfaces), run on a kernel with vcan: `tipforce vcan -- ...`, "
        "or use -i udp_multicast",
    )


def open_port(**options: Any) -> tuple[SocketCanPort | PythonCanPort, str]:
    """Return a port for nodes, and its name: kernel sockets for SocketCAN, python-can for every other interface."""
    from canopen_device.running.ports import PythonCanPort, SocketCanPort

    channel = options.get("channel")
    if sys.platform == "linux" and options.get("interface") == "socketcan" and channel:
        try:
            return SocketCanPort(channel), channel
        except OSError as error:
            raise EnvironmentLackError(
                f"interface socketcan, channel {channel}: {error.strerror}; `ip -br link` lists interfaces; "
                "`tipforce vcan -- ...` provides vcan"
            ) from error
    bus = open_bus(**options)
    return PythonCanPort(bus), str(bus.channel_info)
