"""The converters of `tipforce node --source iio:...` as one gauge source: local devices, remote boards, the supply."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sources import iio_buffer, iio_sysfs
from tipforce.sources.iio import IioSource, Part
from tipforce.sources.iio_buffer import BufferedDevice
from tipforce.sources.iio_sysfs import Device, PolledDevice
from tipforce.sources.layout_file import BridgeTable, ChannelScale, converter_of, ends_fit

_LOG = logging.getLogger(__name__)
_HRTIMER = "tipforce"


class Place(NamedTuple):
    """One DEVICE of the flag: the device, and its channel (empty for all)."""

    uri: str
    """``ip:HOST`` of a remote board, empty for this machine."""
    device: str
    channel: str


class Capture(NamedTuple):
    """How local devices are read: ``mode`` "poll", "buffer", or "auto", a buffer if there is a trigger."""

    mode: str = "auto"
    trigger: str | None = None
    """Name of the buffer's trigger; None: the device's own, else a timer of ``timer_hz``."""
    timer_hz: float = 1000.0


def parse_devices(text: str) -> list[Place]:
    """Parse ``iio:device0/voltage1,0-0051,ip:192.168.0.5/adc/voltage0``. Raises InputError for an empty part."""
    places = []
    for part in text.split(","):
        uri, rest = "", part.strip()
        if rest.startswith("ip:"):
            uri, _, rest = rest.partition("/")
        device, _, channel = rest.removeprefix("iio:").partition("/")
        if not device or "/" in channel or not (not uri or uri[3:]):
            raise InputError(
                f"--source iio:{text}: {part!r} is not a device; write device0, a name, 0-0050, or device0/voltage1, "
                "or ip:HOST/DEVICE for another board"
            )
        places.append(Place(uri, device, channel))
    return places


def open_iio(
    devices: str,
    layout_name: str,
    gauges: int,
    bridge: BridgeTable | None,
    capture: Capture = Capture(),  # noqa: B008 - immutable
    root: Path | None = None,
) -> IioSource:
    """Return the ``devices`` (text as for ``parse_devices``) as one source of ``gauges`` gauges.

    Raises InputError and EnvironmentLackError for devices that are missing, incompatible or not readable.
    """
    if bridge is None:
        raise InputError(
            f"--layout {layout_name}: the gauges of a real converter need a [bridge] table: a layout file with "
            'points = ["K_H", "S_H", "U"] and [bridge] gauge_factor, excitation_volts, gain'
        )
    root = iio_sysfs.ROOT if root is None else root
    opened = _Parts(capture, root)
    opened.open(parse_devices(devices), bridge)
    names, ends = opened.names, opened.ends
    if len(set(names)) != len(names):
        raise InputError(f"--source iio:{devices}: a channel is named twice")
    if len(names) != gauges:
        raise InputError(
            f"--source iio:{devices}: {len(names)} channels ({', '.join(names)}), but layout {layout_name} has "
            f"{gauges} gauges; select channels: device0/voltage0"
        )
    if bridge.count_range is not None:
        ends = [bridge.count_range]
    if len(set(ends)) != 1:
        shown = ", ".join(f"{low} to {high}" for low, high in dict.fromkeys(ends)) or "not stated by the driver"
        raise InputError(
            f"--source iio:{devices}: the range of counts is {shown}; all gauges need one range, and the layout file "
            "can state it: [bridge] count_range = [lowest, highest]"
        )
    converter = converter_of(bridge, opened.scales, names, ends_fit(ends[0]))
    period_us = round(1e6 / capture.timer_hz) if capture.mode != "poll" else 0
    return IioSource(opened.parts, gauges, converter, ends[0], _supply(bridge, root), period_us)


class _Parts:
    """The parts of the source in the order of the gauges; of each channel its scale, name and range of counts."""

    def __init__(self, capture: Capture, root: Path) -> None:
        self._capture, self._root = capture, root
        self._local: dict[Device, list[str]] = {}
        """The channels of a local device, until all of its neighbours in the list are known."""
        self.parts: list[Part] = []
        self.scales: list[ChannelScale] = []
        self.names: list[str] = []
        self.ends: list[tuple[int, int]] = []

    def open(self, places: list[Place], bridge: BridgeTable) -> None:
        for place in places:
            if place.uri:
                self._flush()
                self._add_remote(place)
                continue
            device = iio_sysfs.find(place.device, self._root)
            if self._local and device not in self._local:
                self._flush()
            for channel in _channels(device, place.channel):
                self._local.setdefault(device, []).append(channel)
                self.names.append(f"{device.number}/{channel}")
                self.scales.append(_scale(device.path, channel))
                kind = iio_sysfs.scan_type(device.path, channel)
                if kind is not None:
                    self.ends.append(kind.ends)
                elif bridge.count_range is None:
                    raise InputError(
                        f"{device.number}/{channel}: the driver does not state its range of counts; state it in the "
                        "layout file: [bridge] count_range = [lowest, highest]"
                    )
        self._flush()

    def _flush(self) -> None:
        for device, channels in self._local.items():
            self.parts.append(self._part(device, channels))
        self._local.clear()

    def _part(self, device: Device, channels: list[str]) -> Part:
        """Open buffered capture; if it is optional and the kernel refuses it, poll and log a warning."""
        trigger = None if self._capture.mode == "poll" else self._trigger(device)
        if trigger is None:
            return PolledDevice(device, channels)
        try:
            return BufferedDevice(device, channels, trigger)
        except EnvironmentLackError as error:
            if self._capture.mode == "buffer":
                raise
            _LOG.warning("%s; it is polled instead", error)
            return PolledDevice(device, channels)

    def _trigger(self, device: Device) -> str | None:
        """Return the trigger for buffered capture: the one named, the device's own, or a timer; None for polling."""
        mode, name, timer_hz = self._capture
        if name:
            known = iio_buffer.triggers(self._root)
            if name not in known:
                raise InputError(f"--trigger {name}: no such trigger; there are {', '.join(known) or 'none'}")
            return name
        own = iio_buffer.own_trigger(device, self._root)
        if own is not None:
            return own
        try:
            return iio_buffer.make_hrtimer(_HRTIMER, timer_hz, self._root, iio_buffer.HRTIMER)
        except EnvironmentLackError:
            if mode == "buffer":
                raise
            return None

    def _add_remote(self, place: Place) -> None:
        from tipforce.sources.iio import RemoteDevice

        remote = RemoteDevice(place.uri, place.device, [place.channel] if place.channel else [])
        self.parts.append(remote)
        for k, channel in enumerate(remote.channels):
            self.names.append(f"{remote.name}/{channel}")
            try:
                scale, offset = remote.attribute(k, "scale"), remote.attribute(k, "offset") or 0.0
                self.scales.append(
                    ChannelScale(scale, offset, "" if scale is not None else "the driver states no scale")
                )
            except OSError as error:
                why = f"the board does not state its scale ({error.strerror})"
                self.scales.append(ChannelScale(None, 0.0, why))


def _channels(device: Device, channel: str) -> list[str]:
    present = iio_sysfs.voltage_channels(device.path)
    if channel and channel not in present:
        raise InputError(f"{device}: no channel {channel!r}; it has {', '.join(present) or 'no voltage channel'}")
    if not present:
        raise InputError(f"{device}: has no voltage channel")
    return [channel] if channel else present


def _scale(path: Path, channel: str) -> ChannelScale:
    try:
        offset = iio_sysfs.attribute(path, channel, "offset") or 0.0
        scale = iio_sysfs.attribute(path, channel, "scale")
    except PermissionError:
        raise
    except OSError as error:
        return ChannelScale(None, 0.0, f"the kernel does not state its scale ({error.strerror}: no regulator)")
    return ChannelScale(scale, offset, "" if scale is not None else "the driver states no scale")


def _supply(bridge: BridgeTable, root: Path) -> Callable[[], bool] | None:
    """Return a check whether the measured excitation is out of tolerance; None without a measurement."""
    if bridge.supply is None:
        return None
    (place,) = parse_devices(bridge.supply)
    device = iio_sysfs.find(place.device, root)
    (channel,) = _channels(device, place.channel)[:1]
    allowed = bridge.supply_tolerance * bridge.excitation_volts

    def off() -> bool:
        try:
            volts = 1e-3 * iio_sysfs.millivolts(device.path, channel) * bridge.supply_divider
        except OSError:
            return True
        return not abs(volts - bridge.excitation_volts) <= allowed

    return off
