"""The converters of `tipforce node --source iio:...` as one gauge source: local devices, remote boards, the supply."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sources import iio_buffer, iio_sysfs
from tipforce.sources.iio import IioSource, Part, RemoteDevice
from tipforce.sources.iio_buffer import BufferedDevice
from tipforce.sources.iio_sysfs import Device, PolledDevice
from tipforce.sources.layout_file import BridgeTable, ChannelScale, converter_of, ends_fit

_LOG = logging.getLogger(__name__)
_HRTIMER = "tipforce"
_NO_SCALE = "the driver states no scale"


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
    parts: list[Part] = []
    channels: list[_Channel] = []
    # Neighbours in the list that are channels of one local device are read together.
    for key, group in groupby(parse_devices(devices), lambda at: at if at.uri else iio_sysfs.find(at.device, root)):
        places = list(group)
        if isinstance(key, Place):
            remotes = [RemoteDevice(at.uri, at.device, [at.channel] if at.channel else []) for at in places]
            parts += remotes
            channels += [channel for remote in remotes for channel in _remote_channels(remote)]
        else:
            names = [name for at in places for name in _names(key, at.channel)]
            channels += [_local_channel(key, name, bridge) for name in names]
            parts.append(_part(key, names, capture, root))
    names, ends = [channel.name for channel in channels], [channel.ends for channel in channels if channel.ends]
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
    converter = converter_of(bridge, [channel.scale for channel in channels], names, ends_fit(ends[0]))
    period_us = round(1e6 / capture.timer_hz) if capture.mode != "poll" else 0
    return IioSource(parts, gauges, converter, ends[0], _supply(bridge, root), period_us)


class _Channel(NamedTuple):
    name: str
    scale: ChannelScale
    ends: tuple[int, int] | None
    """The lowest and the highest count, if the driver states them."""


def _part(device: Device, channels: list[str], capture: Capture, root: Path) -> Part:
    """Open buffered capture; if it is optional and the kernel refuses it, poll and log a warning."""
    trigger = None if capture.mode == "poll" else _trigger(device, capture, root)
    if trigger is None:
        return PolledDevice(device, channels)
    try:
        return BufferedDevice(device, channels, trigger)
    except EnvironmentLackError as error:
        if capture.mode == "buffer":
            raise
        _LOG.warning("%s; it is polled instead", error)
        return PolledDevice(device, channels)


def _trigger(device: Device, capture: Capture, root: Path) -> str | None:
    """Return the trigger for buffered capture: the one named, the device's own, or a timer; None for polling."""
    if capture.trigger:
        known = iio_buffer.triggers(root)
        if capture.trigger not in known:
            raise InputError(f"--trigger {capture.trigger}: no such trigger; there are {', '.join(known) or 'none'}")
        return capture.trigger
    own = iio_buffer.own_trigger(device, root)
    if own is not None:
        return own
    try:
        return iio_buffer.make_hrtimer(_HRTIMER, capture.timer_hz, root, iio_buffer.HRTIMER)
    except EnvironmentLackError:
        if capture.mode == "buffer":
            raise
        return None


def _remote_channels(remote: RemoteDevice) -> Iterator[_Channel]:
    for k, channel in enumerate(remote.channels):
        try:
            scale, offset = remote.attribute(k, "scale"), remote.attribute(k, "offset") or 0.0
            why = "" if scale is not None else _NO_SCALE
        except OSError as error:
            scale, offset, why = None, 0.0, f"the board does not state its scale ({error.strerror})"
        yield _Channel(f"{remote.name}/{channel}", ChannelScale(scale, offset, why), None)


def _names(device: Device, channel: str) -> list[str]:
    """Return the channel that is named, or all voltage channels of a device."""
    present = iio_sysfs.voltage_channels(device.path)
    if channel and channel not in present:
        raise InputError(f"{device}: no channel {channel!r}; it has {', '.join(present) or 'no voltage channel'}")
    if not present:
        raise InputError(f"{device}: has no voltage channel")
    return [channel] if channel else present


def _local_channel(device: Device, channel: str, bridge: BridgeTable) -> _Channel:
    path, name, kind = device.path, f"{device.number}/{channel}", iio_sysfs.scan_type(device.path, channel)
    try:
        offset = iio_sysfs.attribute(path, channel, "offset") or 0.0
        scale = iio_sysfs.attribute(path, channel, "scale")
        why = "" if scale is not None else _NO_SCALE
    except PermissionError:
        raise
    except OSError as error:
        offset, scale = 0.0, None
        why = f"the kernel does not state its scale ({error.strerror}: no regulator)"
    if kind is None and bridge.count_range is None:
        raise InputError(
            f"{name}: the driver does not state its range of counts; state it in the layout file: [bridge] "
            "count_range = [lowest, highest]"
        )
    return _Channel(name, ChannelScale(scale, offset, why), kind.ends if kind else None)


def _supply(bridge: BridgeTable, root: Path) -> Callable[[], bool] | None:
    """Return a check whether the measured excitation is out of tolerance; None without a measurement."""
    if bridge.supply is None:
        return None
    (place,) = parse_devices(bridge.supply)
    device = iio_sysfs.find(place.device, root)
    channel = _names(device, place.channel)[0]
    allowed = bridge.supply_tolerance * bridge.excitation_volts

    def off() -> bool:
        try:
            volts = 1e-3 * iio_sysfs.millivolts(device.path, channel) * bridge.supply_divider
        except OSError:
            return True
        return not abs(volts - bridge.excitation_volts) <= allowed

    return off
