"""Checks of converters (Linux Industrial I/O): the devices found, and what each lacks."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce_tools.doctor.check import Check

if TYPE_CHECKING:
    from tipforce.sources.iio_sysfs import Device

_BUS = Path("/sys/bus/iio")


def iio_checks(
    root: Path = _BUS / "devices", device_files: Path = Path("/dev"), configfs: Path | None = None
) -> Iterator[Check]:
    """Yield a check per converter, or one if there is none. Checks neither raise nor change anything."""
    if sys.platform != "linux":
        yield Check("ADC", "note", f"Industrial I/O needs Linux; this is {sys.platform}", "--source sim or replay:FILE")
        return
    from tipforce.sources import iio_sysfs

    if not root.is_dir():
        yield Check("ADC", "note", "the kernel has no Industrial I/O", "`modprobe industrialio`, or --source sim")
        return
    found = iio_sysfs.devices(root)
    with_voltage = [device for device in found if _channels(device.path)]
    if not with_voltage:
        others = f"; found: {', '.join(map(str, found))}" if found else ""
        yield Check(
            "ADC", "note", f"no converter{others}",
            "load its driver, and name the chip in the device tree or by "
            "`echo NAME 0xADDRESS > /sys/bus/i2c/devices/i2c-N/new_device`",
        )  # fmt: skip
        return
    for device in with_voltage:
        yield from _device(device, device_files)
    yield _buffering(with_voltage, root, configfs)


def _channels(path: Path) -> list[str]:
    from tipforce.sources import iio_sysfs

    try:
        return iio_sysfs.voltage_channels(path)
    except OSError:
        return []


def _device(device: Device, device_files: Path) -> Iterator[Check]:
    from tipforce.sources import iio_sysfs

    topic, channels = f"ADC {device.number}", _channels(device.path)
    types = [iio_sysfs.scan_type(device.path, channel) for channel in channels]
    shown = f"{device}: {', '.join(channels)}"
    bits = {kind.bits for kind in types if kind is not None}
    shown += f", {'/'.join(map(str, sorted(bits)))} bits" if bits else ""
    yield Check(topic, "ok", shown, f"--source iio:{device.place or device.number}")
    try:
        iio_sysfs.raw_value(device.path, channels[0])
    except OSError as error:
        yield Check(topic, "note", f"no response: {error.strerror}", "check its wiring and supply, and `dmesg`")
    if None in types:
        yield Check(
            topic, "note", "the driver does not state the range of counts",
            "write [bridge] count_range = [lowest, highest] into the layout file",
        )  # fmt: skip
    yield from _scale(topic, device.path, channels[0])
    file = device_files / device.number
    if file.exists() and not os.access(file, os.R_OK):
        yield Check(topic, "note", f"{file} is not readable: polling works, buffered capture does not", "run as root")


def _scale(topic: str, path: Path, channel: str) -> Iterator[Check]:
    from tipforce.sources import iio_sysfs

    step = "write [bridge] volts_per_count = reference voltage / number of counts into the layout file"
    try:
        scale = iio_sysfs.attribute(path, channel, "scale")
    except OSError as error:
        yield Check(topic, "note", f"no scale ({error.strerror}: the driver knows no reference voltage)", step)
        return
    if scale is None:
        yield Check(topic, "note", "no scale: the driver states none", step)


def _buffering(found: list[Device], root: Path, configfs: Path | None) -> Check:
    from tipforce.sources import iio_buffer

    topic = "ADC trigger"
    own = [name for device in found if (name := iio_buffer.own_trigger(device, root))]
    if own:
        return Check(topic, "ok", f"data-ready triggers: {', '.join(own)}", "used by --capture auto")
    if (configfs or iio_buffer.HRTIMER).is_dir():
        return Check(topic, "ok", "timer triggers are available", "used by --capture auto, rate by --scan-rate")
    others = ", ".join(iio_buffer.triggers(root))
    if others:
        return Check(topic, "ok", f"triggers: {others}", "--trigger NAME")
    return Check(
        topic, "note", "no trigger: converters are polled",
        "for buffered capture: `modprobe iio-trig-hrtimer` and `mount -t configfs none /sys/kernel/config`",
    )  # fmt: skip
