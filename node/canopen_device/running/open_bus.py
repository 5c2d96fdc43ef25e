"""Open a bus of python-can, with errors that say what to do."""

from collections.abc import Mapping
from typing import Any

import can

from canopen_device.errors import EnvironmentLackError, InputError

_UNNAMED = "name an interface and a channel, or set CAN_INTERFACE and CAN_CHANNEL"
_FAILED = "`ip -br link` lists the interfaces of this machine"


def open_bus(options: Mapping[str, Any], unnamed: str = _UNNAMED, failed: str = _FAILED) -> can.BusABC:
    """Return the bus that keywords of ``can.Bus`` name; None is as if not given.

    ``unnamed`` and ``failed`` say what to do without a name and without success. Raises EnvironmentLackError with them,
    and InputError for a channel that pyserial's spy:// would record: the name of a log or a hand names a file.
    """
    given = {key: value for key, value in options.items() if value is not None}
    if str(given.get("channel", "")).lower().startswith("spy:"):
        raise InputError(f"channel {given['channel']}: it writes a file; name the port without spy://")
    try:
        configuration = can.util.load_config(config=dict(given))
        if configuration["interface"] != "udp_multicast":
            return can.Bus(**given)
        from canopen_device.running.udp_multicast import OwnEchoFreeBus

        keywords = {key: value for key, value in configuration.items() if key != "interface" and value is not None}
        return OwnEchoFreeBus(**keywords)
    except (can.CanError, OSError, ImportError, ValueError) as error:
        if "interface" not in given and 'type "None"' in str(error):  # no interface is given anywhere
            raise EnvironmentLackError(f"no bus given: {unnamed}") from None
        interface = given.get("interface", "from python-can's configuration")
        if "serial module is not installed" in str(error):
            raise EnvironmentLackError(f"{interface} needs pyserial: pip install pyserial") from None
        channel = given.get("channel", "(default)")
        raise EnvironmentLackError(f"interface {interface}, channel {channel}: {error}; {failed}") from None
