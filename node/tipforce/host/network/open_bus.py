"""Open a bus of python-can, with errors that say what to do."""

from __future__ import annotations

from typing import Any

import can

from tipforce.errors import EnvironmentLackError, InputError


def open_bus(**options: Any) -> can.BusABC:
    """Return python-can's bus; if it cannot be opened, the error says what to do.

    Raises InputError for a channel that pyserial's spy:// would record: its name, as of a log or a hand, names a file.
    """
    given = {key: value for key, value in options.items() if value is not None}
    if str(given.get("channel", "")).lower().startswith("spy:"):
        raise InputError(f"channel {given['channel']}: it writes a file; name the port without spy://")
    try:
        configuration = can.util.load_config(config=dict(given))
        if configuration["interface"] == "udp_multicast":
            return _multicast(configuration)
        return can.Bus(**given)
    except (can.CanError, OSError, ImportError, ValueError) as error:
        if "interface" not in given and 'type "None"' in str(error):  # no interface is given anywhere
            raise EnvironmentLackError(
                "no bus given: use -i and -c, as in -i socketcan -c can0, or set CAN_INTERFACE and CAN_CHANNEL; "
                "`tipforce doctor` lists the interfaces of this machine"
            ) from None
        interface = given.get("interface", "from python-can's configuration")
        raise EnvironmentLackError(
            f"interface {interface}, channel {given.get('channel', '(default)')}: {error}; "
            "check -i and -c (`ip -br link` lists interfaces), run on a kernel with vcan: `tipforce vcan -- ...`, "
            "or use -i udp_multicast"
        ) from None


def _multicast(configuration: can.typechecking.BusConfig) -> can.BusABC:
    """Return a bus of python-can's `udp_multicast` that does not receive its own frames."""
    from tipforce.host.network.udp_multicast import OwnEchoFreeBus

    options = {key: value for key, value in configuration.items() if key != "interface" and value is not None}
    return OwnEchoFreeBus(**options)
