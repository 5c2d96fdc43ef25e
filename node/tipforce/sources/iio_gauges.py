"""The converters of `tipforce node --source iio:...` as one gauge source: local devices, remote boards, the supply."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from tipforce.dictionary import table
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sources import iio_sysfs
from tipforce.sources.iio import IioSource, RemoteDevice
from tipforce.sources.iio_sysfs import BufferedDevice, Device, PolledDevice
from tipforce.sources.layout_file import BridgeTable

_LOG = logging.getLogger(__name__)
_HRTIMER = "tipforce"
_FULL_MICROSTRAIN = 1000.0  # the process value of the second scaling point, 6123h


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
    devices: str, layout_name: str, gauges: int, bridge: BridgeTable | None,
    capture: Capture = Capture(), root: Path | None = None,  # noqa: B008 - immutable
) -> IioSource:  # fmt: skip
    """Return the ``devices`` (text as for ``parse_devices``) as one source of ``gauges`` gauges. Raises InputError and
    EnvironmentLackError for devices that are missing, incompatible or not readable."""
    if bridge is None:
        problem = f"--layout {layout_name}: the gauges of a real converter need a [bridge] table: a layout file with "
        raise InputError(f'{problem}points = ["K_H", "S_H", "U"] and [bridge] gauge_factor, excitation_volts, gain')
    root = iio_sysfs.ROOT if root is None else root
    parts: list[PolledDevice] = []
    channels: list[_Channel] = []
    # Neighbours in the list that are channels of one local device are read together.
    for key, group in groupby(parse_devices(devices), lambda at: at if at.uri else iio_sysfs.find(at.device, root)):
        places = list(group)
        if isinstance(key, Place):
            for at in places:
                remote = RemoteDevice(at.uri, at.device, [at.channel] if at.channel else [])
                parts.append(remote)
                refusal = "the board does not state its scale ({})"
                for name in remote.channels:
                    channels.append(_stated(f"{remote.name}/{name}", partial(remote.attribute, name), refusal, None))
        else:
            names = [name for at in places for name in _names(key, at.channel)]
            channels += [_local_channel(key, name, bridge) for name in names]
            parts.append(_part(key, names, capture, root))
    names, ends = [channel.name for channel in channels], [channel.ends for channel in channels if channel.ends]
    if len(set(names)) != len(names):
        raise InputError(f"--source iio:{devices}: a channel is named twice")
    if len(names) != gauges:
        problem = f"--source iio:{devices}: {len(names)} channels ({', '.join(names)}), but layout {layout_name} has "
        raise InputError(f"{problem}{gauges} gauges; select channels: device0/voltage0")
    if bridge.count_range is not None:
        ends = [bridge.count_range]
    if len(set(ends)) != 1:
        shown = ", ".join(f"{low} to {high}" for low, high in dict.fromkeys(ends)) or "not stated by the driver"
        problem = f"--source iio:{devices}: the range of counts is {shown}; all gauges need one range, and the layout "
        raise InputError(f"{problem}file can state it: [bridge] count_range = [lowest, highest]")
    bits = max(16, 1 + max(ends[0][1], ~ends[0][0]).bit_length())  # of a signed integer that holds the range
    converter = _converter(bridge, channels, bits)
    period_us = round(1e6 / capture.timer_hz) if capture.mode != "poll" else 0
    return IioSource(parts, gauges, converter, ends[0], _supply(bridge, root), period_us)


class _Channel(NamedTuple):
    name: str
    millivolts_per_count: float | None
    offset_counts: float
    why: str
    """The reason for a missing scale; empty if there is a scale."""
    ends: tuple[int, int] | None
    """The lowest and the highest count."""


def _converter(bridge: BridgeTable, channels: Sequence[_Channel], bits: int) -> table.Converter:
    """Return the dictionary's converter, with scaling points per gauge. Raises InputError where a scale is missing."""
    from tipforce.sources.front_end import Bridge

    volts_per_microstrain = Bridge(bridge.kind, bridge.gauge_factor, bridge.excitation_volts).volts_per_microstrain
    gains = bridge.gain if isinstance(bridge.gain, list) else [bridge.gain] * len(channels)
    if len(gains) != len(channels):
        raise InputError(f"[bridge] gain: {len(gains)} numbers for {len(channels)} gauges")
    points = []
    for channel, gain in zip(channels, gains, strict=True):
        volts_per_count, millivolts = bridge.volts_per_count, channel.millivolts_per_count
        if volts_per_count is None:
            if millivolts is None:
                problem = f"{channel.name}: {channel.why}; state the converter's step in the layout file: "
                raise InputError(f"{problem}[bridge] volts_per_count = (reference voltage / number of counts)")
            if not (math.isfinite(millivolts) and millivolts > 0.0):
                raise InputError(f"{channel.name}: scale {millivolts!r}; state [bridge] volts_per_count")
            volts_per_count = 1e-3 * millivolts
        zero = bridge.zero_volts / volts_per_count - channel.offset_counts
        end = zero + _FULL_MICROSTRAIN * gain * volts_per_microstrain / volts_per_count
        if not (max(abs(zero), abs(end)) <= 0x7FFFFFFF and abs(end - zero) >= 1e-6):
            told = f"{channel.name}: 0 and 1000 microstrain are {zero:g} and {end:g} counts"
            raise InputError(f"{told}: allowed are different ones of INTEGER32; check scale, offset and [bridge]")
        points.append((zero, end))
    fits = all(abs(count) <= 0x7FFF for pair in points for count in pair)
    return (bits if fits else max(bits, 17)), abs(points[0][1] - points[0][0]) / _FULL_MICROSTRAIN, tuple(points)


def _part(device: Device, channels: list[str], capture: Capture, root: Path) -> PolledDevice:
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
    known = iio_sysfs.triggers(root)
    if capture.trigger and capture.trigger not in known:
        raise InputError(f"--trigger {capture.trigger}: no such trigger; there are {', '.join(known) or 'none'}")
    trigger = capture.trigger or iio_sysfs.own_trigger(device, root)
    if trigger is not None:
        return trigger
    try:
        return iio_sysfs.make_hrtimer(_HRTIMER, capture.timer_hz, root, iio_sysfs.HRTIMER)
    except EnvironmentLackError:
        if capture.mode == "buffer":
            raise
        return None


def _stated(
    name: str, attribute: Callable[[str], float | None], refusal: str, ends: tuple[int, int] | None
) -> _Channel:
    offset, scale, why = 0.0, None, "the driver states no scale"
    try:
        offset = attribute("offset") or 0.0  # known also where the scale is not
        scale = attribute("scale")
    except PermissionError:
        raise
    except OSError as error:
        why = refusal.format(error.strerror)
    return _Channel(name, scale, offset, "" if scale is not None else why, ends)


def _names(device: Device, channel: str) -> list[str]:
    present = iio_sysfs.voltage_channels(device.path)
    if channel and channel not in present:
        raise InputError(f"{device}: no channel {channel!r}; it has {', '.join(present) or 'no voltage channel'}")
    if not present:
        raise InputError(f"{device}: has no voltage channel")
    return [channel] if channel else present


def _local_channel(device: Device, channel: str, bridge: BridgeTable) -> _Channel:
    name, kind = f"{device.number}/{channel}", iio_sysfs.scan_type(device.path, channel)
    if kind is None and bridge.count_range is None:
        problem = f"{name}: the driver does not state its range of counts; state it in the layout file: [bridge] "
        raise InputError(f"{problem}count_range = [lowest, highest]")
    refusal = "the kernel does not state its scale ({}: no regulator)"
    return _stated(name, partial(iio_sysfs.attribute, device.path, channel), refusal, kind.ends if kind else None)


def _supply(bridge: BridgeTable, root: Path) -> Callable[[], bool] | None:
    """Return a check whether the measured excitation is out of tolerance; None without a measurement."""
    if bridge.supply is None:
        return None
    place, *others = parse_devices(bridge.supply)
    device = iio_sysfs.find(place.device, root)
    channel, *more = _names(device, place.channel)
    if others or more or place.uri:
        raise InputError(f"[bridge] supply = {bridge.supply!r}: allowed is one channel here, device0/voltage1")
    part = PolledDevice(device, [channel])
    allowed = bridge.supply_tolerance * bridge.excitation_volts

    def off() -> bool:
        try:
            volts = 1e-3 * part.quantity(channel) * bridge.supply_divider
        except OSError:
            with suppress(OSError):  # it may be back under another number
                part.reopen()
            return True
        return not abs(volts - bridge.excitation_volts) <= allowed

    return off
