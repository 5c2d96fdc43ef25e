"""Opening a bus: python-can's, with errors that say what to do."""

from __future__ import annotations

from typing import Any

import can

from tipforce.errors import EnvironmentLackError


def open_bus(**options: Any) -> can.BusABC:
    """python-can's bus, with an error that says what to do when it cannot be opened."""
    given = {key: value for key, value in options.items() if value is not None}
    try:
        return can.Bus(**given)
    except (can.CanError, OSError, ImportError, ValueError) as error:
        if "interface" not in given and 'type "None"' in str(error):  # nothing names one
            raise EnvironmentLackError(
                "no bus is named: give -i and -c, as -i socketcan -c can0, or set CAN_INTERFACE and CAN_CHANNEL; "
                "`tipforce doctor` says what this machine has"
            ) from None
        interface = given.get("interface", "from python-can's configuration")
        raise EnvironmentLackError(
            f"interface {interface}, channel {given.get('channel', '(default)')}: {error}; "
            "check -i and -c (`ip -br link` lists interfaces), or run on a kernel with vcan: `tipforce vcan -- ...`"
        ) from None
