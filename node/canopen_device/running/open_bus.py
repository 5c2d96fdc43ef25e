"""A bus of python-can: open it, with errors that say what to do, and the port of devices on it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from canopen_device.can_frame import raw_can_id
from canopen_device.errors import EnvironmentLackError, InputError, cause

if TYPE_CHECKING:
    import can  # slow to import: imported where a bus is used

    from canopen_device.running.loop import Frame

_LOG = logging.getLogger(__name__)
_AFTER_ERROR_S = 0.05
_REOPEN_S = 1.0
_UNNAMED = "name an interface and a channel, or set CAN_INTERFACE and CAN_CHANNEL"
_FAILED = "`ip -br link` lists the interfaces of this machine"


def open_bus(options: Mapping[str, Any], unnamed: str = _UNNAMED, failed: str = _FAILED) -> can.BusABC:
    """Return the bus of ``can.Bus`` keywords (None: not given). Raises EnvironmentLackError, saying what to do by
    ``unnamed`` or ``failed``, and InputError for a channel that pyserial's spy:// would record to a file."""
    import can

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


class PythonCanPort:
    """Any python-can bus. The port retries a bus that fails; it logs this once, until a frame passes again. ``reopen``
    returns another bus for one that has failed for a second, as a TCP link or a USB adapter that went."""

    def __init__(self, bus: can.BusABC, reopen: Callable[[], can.BusABC] | None = None) -> None:
        self._bus: can.BusABC | None = bus
        self._reopen = reopen
        self._reopen_s = 0.0
        self._failing = False

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next classic frame, or None."""
        message = self._received(timeout_s)
        if message is None or message.is_fd:
            return None
        self._failing = False
        return raw_can_id(message), bytes(message.data)

    def _received(self, timeout_s: float) -> can.Message | None:
        import can

        if self._bus is not None:
            try:
                return self._bus.recv(timeout_s)
            except (can.CanError, OSError) as error:
                self._fail("receive failed", error)
        time.sleep(_AFTER_ERROR_S)
        if self._reopen is not None and time.monotonic() >= self._reopen_s:
            self._reopen_s = time.monotonic() + _REOPEN_S
            self.close()  # before: an adapter may open once
            with suppress(EnvironmentLackError):
                self._bus = self._reopen()
        return None

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames; drop one that the bus rejects."""
        import can

        for can_id, data in frames:
            try:
                if self._bus is not None:
                    self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
                    self._failing = False
            except (can.CanError, OSError) as error:
                self._fail("a frame was not sent", error)

    def request(self, what: str, value: int, delay_ms: int) -> None:
        """Log the request: python-can has no call for it on every interface."""
        if what == "bit-rate":
            _LOG.warning("LSS requests %d bit/s after %d ms: restart the node with -b %d", value, delay_ms, value)
        elif what == "bus-restart":
            _LOG.warning("the controller is bus-off: restart it, or enable the restart in its driver")

    def close(self) -> None:
        """Close the bus."""
        import can

        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(can.CanError, OSError):  # of a link that has ended
                bus.shutdown()

    def _fail(self, what: str, error: Exception) -> None:
        if not self._failing:
            self._failing = True
            self._reopen_s = time.monotonic() + _REOPEN_S
            _LOG.warning("%s: %s; the node continues when the bus works again", what, cause(error))
