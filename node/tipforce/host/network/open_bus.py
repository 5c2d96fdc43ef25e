"""Open a bus of python-can, with errors that name the commands which help."""

from __future__ import annotations

from typing import Any

import can

from canopen_device.running import open_bus as devices_bus


def open_bus(**options: Any) -> can.BusABC:
    """Return python-can's bus. Raises as canopen_device's open_bus does."""
    return devices_bus.open_bus(
        options,
        "use -i and -c, as in -i socketcan -c can0, or set CAN_INTERFACE and CAN_CHANNEL; "
        "`tipforce doctor` lists the interfaces of this machine",
        "check -i and -c (`ip -br link` lists interfaces), run on a kernel with vcan: `tipforce vcan -- ...`, "
        "or use -i udp_multicast",
    )
