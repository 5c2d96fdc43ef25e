"""Sources of `tipforce node --source`: a simulated finger, Linux converters, a recording."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.cli.bridge import BridgeTable, ChannelScale, converter_of, ends_fit

if TYPE_CHECKING:
    from tipforce.sources.iio import IioSource, Part
    from tipforce.sources.iio_sysfs import Device

_LOG = logging.getLogger(__name__)
_HRTIMER = "tipforce"


class Wanted(NamedTuple):
    """One DEVICE of the flag: the device, and its channels (empty for all)."""

    uri: str
    """``ip:HOST`` of a remote board, empty for this machine."""
    device: str
    channel: str


def parse_devices(text: str) -> list[Wanted]:
    """Parse ``iio:device0/voltage1,0-0051,ip:192.168.0.5/adc/voltage0``. Raises InputError for an empty part."""
    found = []
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
        found.append(Wanted(uri, device, channel))
    return found


def open_iio(args: argparse.Namespace, gauges: int, bridge: BridgeTable | None, root: Path | None = None) -> IioSource:
    """Return the devices of ``--source iio:...`` as one gauge source.

    Raises InputError and EnvironmentLackError for devices that are missing, incompatible or not readable.
    """
    from tipforce.sources import iio_sysfs
    from tipforce.sources.iio import IioSource

    root = iio_sysfs.ROOT if root is None else root
    if bridge is None:
        raise InputError(
            f"--layout {args.layout}: the gauges of a real converter need a [bridge] table: a layout file with "
            'points = ["K_H", "S_H", "U"] and [bridge] gauge_factor, excitation_volts, gain'
        )
    parts, scales, names, ends = _parts(args, bridge, root)
    if len(names) != gauges:
        raise InputError(
            f"--source {args.source}: {len(names)} channels ({', '.join(names)}), but layout {args.layout} has "
            f"{gauges} gauges; select channels: device0/voltage0"
        )
    if bridge.count_range is not None:
        ends = [bridge.count_range]
    if len(set(ends)) != 1:
        shown = ", ".join(f"{low} to {high}" for low, high in dict.fromkeys(ends)) or "not stated by the driver"
        raise InputError(
            f"--source {args.source}: the range of counts is {shown}; all gauges need one range, and the layout file "
            "can state it: [bridge] count_range = [lowest, highest]"
        )
    converter = converter_of(bridge, scales, names, ends_fit(ends[0]))
    period_us = round(1e6 / args.scan_rate) if args.capture != "poll" else 0
    return IioSource(parts, gauges, converter, ends[0], _supply(bridge, root), period_us)


def _parts(
    args: argparse.Namespace, bridge: BridgeTable, root: Path
) -> tuple[list[Part], list[ChannelScale], list[str], list[tuple[int, int]]]:
    from tipforce.sources import iio_sysfs

    parts: list[Part] = []
    scales: list[ChannelScale] = []
    names: list[str] = []
    ends: list[tuple[int, int]] = []
    local: dict[Device, list[str]] = {}
    for wanted in parse_devices(args.source.removeprefix("iio:")):
        if wanted.uri:
            _flush(args, local, parts, root)
            _add_remote(wanted, parts, scales, names)
            continue
        device = iio_sysfs.find(wanted.device, root)
        if local and device not in local:
            _flush(args, local, parts, root)
        for channel in _channels(device, wanted.channel):
            local.setdefault(device, []).append(channel)
            names.append(f"{device.number}/{channel}")
            scales.append(_scale(device.path, channel))
            kind = iio_sysfs.scan_type(device.path, channel)
            if kind is not None:
                ends.append(kind.ends)
            elif bridge.count_range is None:
                raise InputError(
                    f"{device.number}/{channel}: the driver does not state its range of counts; state it in the layout "
                    "file: [bridge] count_range = [lowest, highest]"
                )
    _flush(args, local, parts, root)
    if len(set(names)) != len(names):
        raise InputError(f"--source {args.source}: a channel is named twice")
    return parts, scales, names, ends


def _channels(device: Device, wanted: str) -> list[str]:
    from tipforce.sources import iio_sysfs

    there = iio_sysfs.voltage_channels(device.path)
    if wanted and wanted not in there:
        raise InputError(f"{device}: no channel {wanted!r}; it has {', '.join(there) or 'no voltage channel'}")
    if not there:
        raise InputError(f"{device}: has no voltage channel")
    return [wanted] if wanted else there


def _scale(path: Path, channel: str) -> ChannelScale:
    from tipforce.sources import iio_sysfs

    try:
        offset = iio_sysfs.attribute(path, channel, "offset") or 0.0
        scale = iio_sysfs.attribute(path, channel, "scale")
    except PermissionError:
        raise
    except OSError as error:
        return ChannelScale(None, 0.0, f"the kernel does not state its scale ({error.strerror}: no regulator)")
    return ChannelScale(scale, offset, "" if scale is not None else "the driver states no scale")


def _flush(args: argparse.Namespace, local: dict[Device, list[str]], parts: list[Part], root: Path) -> None:
    """Open the selected channels of one device."""
    from tipforce.sources.iio_sysfs import PolledDevice

    for device, channels in local.items():
        trigger = None if args.capture == "poll" else _trigger(args, device, root)
        if trigger is None:
            parts.append(PolledDevice(device, channels))
        else:
            parts.append(_buffered(args, device, channels, trigger))
    local.clear()


def _buffered(args: argparse.Namespace, device: Device, channels: list[str], trigger: str) -> Part:
    """Open buffered capture; if it is optional and the kernel refuses it, poll and log a warning."""
    from tipforce.sources.iio_buffer import BufferedDevice
    from tipforce.sources.iio_sysfs import PolledDevice

    try:
        return BufferedDevice(device, channels, trigger)
    except EnvironmentLackError as error:
        if args.capture == "buffer":
            raise
        _LOG.warning("%s; it is polled instead", error)
        return PolledDevice(device, channels)


def _trigger(args: argparse.Namespace, device: Device, root: Path) -> str | None:
    """Return the trigger for buffered capture: the one named, the device's own, or a timer; None for polling."""
    from tipforce.sources import iio_buffer

    if args.trigger:
        if args.trigger not in iio_buffer.triggers(root):
            there = ", ".join(iio_buffer.triggers(root)) or "none"
            raise InputError(f"--trigger {args.trigger}: no such trigger; there are {there}")
        return str(args.trigger)
    own = iio_buffer.own_trigger(device, root)
    if own is not None:
        return own
    try:
        return iio_buffer.make_hrtimer(_HRTIMER, args.scan_rate, root, iio_buffer.HRTIMER)
    except EnvironmentLackError:
        if args.capture == "buffer":
            raise
        return None


def _add_remote(wanted: Wanted, parts: list[Part], scales: list[ChannelScale], names: list[str]) -> None:
    from tipforce.sources.iio_remote import RemoteDevice

    remote = RemoteDevice(wanted.uri, wanted.device, [wanted.channel] if wanted.channel else [])
    parts.append(remote)
    for k, channel in enumerate(remote.channels):
        names.append(f"{remote.name}/{channel}")
        try:
            scale, offset = remote.attribute(k, "scale"), remote.attribute(k, "offset") or 0.0
            scales.append(ChannelScale(scale, offset, "" if scale is not None else "the driver states no scale"))
        except OSError as error:
            scales.append(ChannelScale(None, 0.0, f"the board does not state its scale ({error.strerror})"))


def _supply(bridge: BridgeTable, root: Path) -> Callable[[], bool] | None:
    """Return a check whether the measured excitation is out of tolerance; None without a measurement."""
    if bridge.supply is None:
        return None
    from tipforce.sources import iio_sysfs

    (wanted,) = parse_devices(bridge.supply)
    device = iio_sysfs.find(wanted.device, root)
    (channel,) = _channels(device, wanted.channel)[:1]
    allowed = bridge.supply_tolerance * bridge.excitation_volts

    def off() -> bool:
        try:
            volts = 1e-3 * iio_sysfs.millivolts(device.path, channel) * bridge.supply_divider
        except OSError:
            return True
        return not abs(volts - bridge.excitation_volts) <= allowed

    return off
