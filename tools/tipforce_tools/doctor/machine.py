"""Checks of this machine: kernel and CAN interfaces, buses without hardware, converters, installed software."""

from __future__ import annotations

import os
import platform
import shutil
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.core import core, how_to_build
from tipforce.errors import TipforceError
from tipforce.host.network.interfaces import Link, interfaces, links
from tipforce.watching.findings import RATE, Finding, Observed, of_the_wire

if TYPE_CHECKING:
    from tipforce.sources.iio_sysfs import Device

SHORT_QUEUE = 100  # frames; a hand responds to SYNC with more than the default of ten at once
_NO_CAN = "load it: sudo modprobe can_raw; if the kernel has none, `tipforce vcan` runs commands on one that has"
INTERFACES = ("vcan0", "vcan1")
_PLACES = {
    "direct": "they are up on this kernel",
    "namespace": "this kernel creates them for each run",
    "uml": "in User-mode Linux, which boots here",
}
_UDP = "-i udp_multicast -c 239.74.163.2 is a bus of UDP datagrams"
_IIO = Path("/sys/bus/iio/devices")
BASE = ("canopen", "cantools", "msgspec", "numpy", "python-can", "rich")
EXTRAS = {
    "science": "scipy", "plot": "matplotlib", "fem": "scikit-fem", "parquet": "pyarrow", "zstd": "zstandard",
    "mcap": "mcap", "ros2": "cyclonedds", "multicast": "msgpack", "slcan": "pyserial", "dask": "distributed",
}  # fmt: skip
"""A package of each extra."""
PEERS = ("candump", "canplayer", "tshark")


def kernel_checks() -> Iterator[Finding]:
    """CAN support, then each CAN interface."""
    if not sys.platform.startswith("linux"):
        yield Finding("kernel", "note", f"{sys.platform}: no SocketCAN", "name your adapter's interface: -i")
        return
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        yield Finding("kernel", "ok", "CAN sockets work")
    except PermissionError:
        yield Finding("kernel", "fail", "CAN sockets are not permitted here", "a container needs the host's network")
    except OSError as error:
        yield Finding("kernel", "fail", f"no CAN sockets: {error.strerror}", _NO_CAN)
    known, details = interfaces(), links()
    if not known:
        step = "plug in the adapter, or add vcan0: sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"
        yield Finding("interface", "note", "no CAN interface", step)
    for name, up in known.items():
        yield interface_check(details.get(name) or Link(name, up))


def interface_check(link: Link) -> Finding:
    """Check one interface. Errors of its bus are findings of the bus."""
    topic = f"interface {link.name}"
    kind = "virtual" if link.virtual else f"{link.bit_rate} bit/s" if link.bit_rate else "no bit rate set"
    if not link.up:
        rate = "" if link.virtual else f" type can bitrate {link.bit_rate or RATE}"
        return Finding(topic, "fail", f"down, {kind}", f"sudo ip link set {link.name} up{rate}")
    if link.state not in ("", "ERROR-ACTIVE"):
        return replace(next(of_the_wire(Observed(link=link))), topic=topic)
    if not link.virtual and link.queue is not None and link.queue < SHORT_QUEUE:
        step = f"sudo ip link set {link.name} txqueuelen 1000"
        return Finding(topic, "note", f"up, {kind}, transmit queue of {link.queue} frames", step)
    return Finding(topic, "ok", f"up, {kind}" + (f", sample point {link.sample_point}" if link.sample_point else ""))


def trial() -> int:
    """Run `true` with the buses; return its exit code. Raises EnvironmentLackError."""
    from tipforce_tools.kernel.uml import run_with_vcan

    return run_with_vcan(["true"], interfaces=INTERFACES, timeout_s=120.0)


def vcan_checks() -> Iterator[Finding]:
    """Yield one check. Never raises."""
    if sys.platform != "linux":
        yield Finding("vcan", "note", f"vcan exists on Linux only, and this is {sys.platform}", _UDP)
        return
    from tipforce_tools.kernel.host import ELSEWHERE, choose

    place = choose(INTERFACES)
    try:
        code = trial()
    except TipforceError as error:
        yield Finding("vcan", "note", str(error).splitlines()[0], "`tipforce vcan -- true` shows the details")
        return
    if code:
        yield Finding("vcan", "note", f"`tipforce vcan -- true` ended with {code}", ELSEWHERE)
    else:
        yield Finding("vcan", "ok", f"`tipforce vcan` works: vcan0 and vcan1, {_PLACES[place]}")


def multicast_checks() -> Iterator[Finding]:
    """Yield one check: open the bus of UDP datagrams, without sending. Never raises."""
    from tipforce.host.network.open_bus import open_bus

    try:
        open_bus(interface="udp_multicast", channel="239.74.163.2").shutdown()
        yield Finding("UDP bus", "ok", f"{_UDP} between programs, where vcan is not available")
    except TipforceError as error:
        yield Finding("UDP bus", "note", str(error))


def iio_checks(root: Path = _IIO, device_files: Path = Path("/dev"), configfs: Path | None = None) -> Iterator[Finding]:
    """Yield a check per converter, or one if there is none. Checks neither raise nor change anything."""
    if sys.platform != "linux":
        cause = f"Industrial I/O needs Linux; this is {sys.platform}"
        yield Finding("ADC", "note", cause, "--source sim or replay:FILE")
        return
    from tipforce.sources import iio_sysfs

    if not root.is_dir():
        yield Finding("ADC", "note", "the kernel has no Industrial I/O", "`modprobe industrialio`, or --source sim")
        return
    devices = iio_sysfs.devices(root)
    with_voltage = [device for device in devices if _channels(device.path)]
    if not with_voltage:
        others = f"; found: {', '.join(map(str, devices))}" if devices else ""
        echo = "`echo NAME 0xADDRESS > /sys/bus/i2c/devices/i2c-N/new_device`"
        step = f"load its driver, and name the chip in the device tree or by {echo}"
        yield Finding("ADC", "note", f"no converter{others}", step)
        return
    for device in with_voltage:
        yield from _device_checks(device, device_files)
    yield _buffering(with_voltage, root, configfs)


def _channels(path: Path) -> list[str]:
    from tipforce.sources import iio_sysfs

    with suppress(OSError):
        return iio_sysfs.voltage_channels(path)
    return []


def _device_checks(device: Device, device_files: Path) -> Iterator[Finding]:
    from tipforce.sources import iio_sysfs

    topic, path, channels = f"ADC {device.number}", device.path, _channels(device.path)
    types = [iio_sysfs.scan_type(path, channel) for channel in channels]
    bits = "/".join(map(str, sorted({kind.bits for kind in types if kind is not None})))
    shown = f"{device}: {', '.join(channels)}" + (f", {bits} bits" if bits else "")
    yield Finding(topic, "ok", shown, f"--source iio:{device.place or device.number}")
    try:
        iio_sysfs.raw_value(path, channels[0])
    except OSError as error:
        yield Finding(topic, "note", f"no response: {error.strerror}", "check its wiring and supply, and `dmesg`")
    if None in types:
        step = "write [bridge] count_range = [lowest, highest] into the layout file"
        yield Finding(topic, "note", "the driver does not state the range of counts", step)
    try:
        no_scale = "the driver states none" if iio_sysfs.attribute(path, channels[0], "scale") is None else ""
    except OSError as error:
        no_scale = f"{error.strerror}: the driver knows no reference voltage"
    if no_scale:
        step = "write [bridge] volts_per_count = reference voltage / number of counts into the layout file"
        yield Finding(topic, "note", f"no scale ({no_scale})", step)
    file = device_files / device.number
    if file.exists() and not os.access(file, os.R_OK):
        yield Finding(topic, "note", f"{file} is not readable: polling works, buffered capture does not", "run as root")


def _buffering(devices: list[Device], root: Path, configfs: Path | None) -> Finding:
    from tipforce.sources import iio_buffer

    topic = "ADC trigger"
    own = [name for device in devices if (name := iio_buffer.own_trigger(device, root))]
    if own:
        return Finding(topic, "ok", f"data-ready triggers: {', '.join(own)}", "used by --capture auto")
    if (configfs or iio_buffer.HRTIMER).is_dir():
        return Finding(topic, "ok", "timer triggers are available", "used by --capture auto, rate by --scan-rate")
    others = ", ".join(iio_buffer.triggers(root))
    if others:
        return Finding(topic, "ok", f"triggers: {others}", "--trigger NAME")
    step = "for buffered capture: `modprobe iio-trig-hrtimer` and `mount -t configfs none /sys/kernel/config`"
    return Finding(topic, "note", "no trigger: converters are polled", step)


def software_checks() -> Iterator[Finding]:
    """Yield checks of versions, extras and related tools."""
    base = ", ".join(f"{name} {_version(name)}" for name in BASE)
    yield Finding("software", "ok", f"tipforce {_version('tipforce')}, Python {platform.python_version()}, {base}")
    built = core is not None
    finding = "compiled" if built else "not compiled: logs are read more slowly"
    yield Finding("core", "ok" if built else "note", finding, "" if built else how_to_build())
    missing = [extra for extra, name in EXTRAS.items() if _version(name) == "missing"]
    yield _lacks("extras", "not installed", missing, f'pip install "tipforce[{",".join(missing)}]"', "all installed")
    absent = [name for name in PEERS if shutil.which(name) is None]
    yield _lacks("peers", "not found", absent, "sudo apt-get install can-utils tshark", ", ".join(PEERS))


def _lacks(topic: str, how: str, names: list[str], step: str, complete: str) -> Finding:
    return Finding(topic, "note", f"{how}: {', '.join(names)}", step) if names else Finding(topic, "ok", complete)


def _version(name: str) -> str:
    import importlib.metadata

    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
