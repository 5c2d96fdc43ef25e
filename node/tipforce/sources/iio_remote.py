"""Converters of another board through libiio's network daemon (iiod), with the package ``pylibiio`` (extra ``iio``).

Polled like local ones. Every exchange is a round trip over the network, so a reading of three channels takes
milliseconds; libiio's own time-out bounds how long a lost connection blocks the node's loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sources.iio_sysfs import UNKNOWN_TEMPERATURE

TIMEOUT_MS = 50


class RemoteDevice:
    """Channels of one device of a remote context. Raises EnvironmentLackError without pylibiio or a response."""

    polled = True

    def __init__(self, uri: str, device: str, channels: Sequence[str]) -> None:
        self.name = f"{uri}/{device}"
        self._uri, self._device, self.channels = uri, device, tuple(channels)
        self._open: list[Any] = []
        self._temperature: Any = None
        try:
            self._connect()
        except OSError as error:
            raise EnvironmentLackError(
                f"iio {uri}: {error.strerror or error}; check that iiod runs there: `iio_info -u {uri}`"
            ) from error

    def reopen(self) -> None:
        """Connect again. Raises OSError while that fails, or while the device or a channel is missing."""
        try:
            self._connect()
        except InputError as error:
            raise FileNotFoundError(2, str(error)) from None

    def _connect(self) -> None:
        context = _library().Context(self._uri)
        context.set_timeout(TIMEOUT_MS)
        device = context.find_device(self._device)
        if device is None:
            there = ", ".join(str(one.name or one.id) for one in context.devices) or "none"
            raise InputError(f"iio {self.name}: no such device; allowed: {there}")
        inputs = {channel.id: channel for channel in device.channels if not channel.output}
        names = self.channels or tuple(sorted(name for name in inputs if name.startswith("voltage")))
        missing = [name for name in names if name not in inputs]
        if missing or not names:
            raise InputError(f"iio {self.name}: no channel {missing or 'voltage'}; allowed: {', '.join(inputs)}")
        self.channels = names
        self._open = [inputs[name] for name in names]
        self._temperature = next((one for name, one in sorted(inputs.items()) if name.startswith("temp")), None)

    def read(self, _now_us: int) -> tuple[int, ...] | None:
        """Return the counts of all channels. Raises OSError."""
        return tuple([int(channel.attrs["raw"].value) for channel in self._open])

    def attribute(self, k: int, name: str) -> float | None:
        """Return ``scale`` or ``offset`` of channel ``k``; None if there is none. Raises OSError."""
        attrs = self._open[k].attrs
        return float(attrs[name].value) if name in attrs else None

    def temperature(self) -> int:
        """Return the temperature in 0.01 degC, or unknown."""
        if self._temperature is None:
            return UNKNOWN_TEMPERATURE
        attrs = self._temperature.attrs
        try:
            if "input" in attrs:
                thousandths = float(attrs["input"].value)
            else:
                scale = float(attrs["scale"].value) if "scale" in attrs else 1.0
                offset = float(attrs["offset"].value) if "offset" in attrs else 0.0
                thousandths = (float(attrs["raw"].value) + offset) * scale
        except (OSError, ValueError):
            return UNKNOWN_TEMPERATURE
        hundredths = 0.1 * thousandths
        return round(hundredths) if -32767.5 < hundredths < 32767.5 else UNKNOWN_TEMPERATURE

    def close(self) -> None:
        """Close the connection."""
        self._open, self._temperature = [], None


def _library() -> Any:
    try:
        import iio
    except (ImportError, OSError) as error:  # the binding raises OSError without the C library
        raise EnvironmentLackError(
            "iio:ip:...: needs pylibiio and libiio: `pip install 'tipforce[iio]'` and `apt-get install libiio0`"
        ) from error
    return iio
