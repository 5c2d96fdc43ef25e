"""Checks of this machine: kernel and CAN interfaces, buses without hardware, converters, software; and of the bus."""

from __future__ import annotations

import os
import platform
import shutil
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can.util
import numpy as np

from canopen_device.core.codes import STOPPED
from tipforce.core import core, how_to_build
from tipforce.errors import TipforceError
from tipforce.host.network.bus import Bus
from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, range_of_bits
from tipforce.host.network.find import find_nodes
from tipforce.host.network.interfaces import Link, interfaces, links, open_bus
from tipforce.sources import iio_sysfs
from tipforce.watching.findings import RATE, Finding, Observed, findings, of_the_wire, shown

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray
    from tipforce.host.hand.file import FingerPlan
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
VARIABLES = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
BEATS_S = 5.0
"""Listen so much longer to a stopped node: it has no SDO, and two may send its heartbeats."""
_LOADED = 0.8


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


def vcan_checks() -> Iterator[Finding]:
    """Yield one check. Never raises."""
    if sys.platform != "linux":
        yield Finding("vcan", "note", f"vcan exists on Linux only, and this is {sys.platform}", _UDP)
        return
    from tipforce_tools.kernel import uml
    from tipforce_tools.kernel.host import ELSEWHERE, choose

    works = f"`tipforce vcan` works: vcan0 and vcan1, {_PLACES[choose(INTERFACES)]}"
    try:
        code = uml.run_with_vcan(["true"], interfaces=INTERFACES, timeout_s=120.0)
        failed = f"`tipforce vcan -- true` ended with {code}"
        yield Finding("vcan", "note", failed, ELSEWHERE) if code else Finding("vcan", "ok", works)
    except TipforceError as error:
        yield Finding("vcan", "note", str(error).splitlines()[0], "`tipforce vcan -- true` shows the details")


def multicast_checks() -> Iterator[Finding]:
    """Yield one check: open the bus of UDP datagrams, without sending. Never raises."""
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
    with suppress(OSError):
        return iio_sysfs.voltage_channels(path)
    return []


def _device_checks(device: Device, device_files: Path) -> Iterator[Finding]:
    topic, path, channels = f"ADC {device.number}", device.path, _channels(device.path)
    types = [iio_sysfs.scan_type(path, channel) for channel in channels]
    bits = "/".join(map(str, sorted({kind.bits for kind in types if kind is not None})))
    about = f"{device}: {', '.join(channels)}" + (f", {bits} bits" if bits else "")
    yield Finding(topic, "ok", about, f"--source iio:{device.place or device.number}")
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
    topic = "ADC trigger"
    if own := [name for device in devices if (name := iio_sysfs.own_trigger(device, root))]:
        return Finding(topic, "ok", f"data-ready triggers: {', '.join(own)}", "used by --capture auto")
    if (configfs or iio_sysfs.HRTIMER).is_dir():
        return Finding(topic, "ok", "timer triggers are available", "used by --capture auto, rate by --scan-rate")
    if others := ", ".join(iio_sysfs.triggers(root)):
        return Finding(topic, "ok", f"triggers: {others}", "--trigger NAME")
    step = "for buffered capture: `modprobe iio-trig-hrtimer` and `mount -t configfs none /sys/kernel/config`"
    return Finding(topic, "note", "no trigger: converters are polled", step)


def software_checks() -> Iterator[Finding]:
    """Yield checks of versions, extras and related tools."""
    base = ", ".join(f"{name} {_version(name)}" for name in BASE)
    yield Finding("software", "ok", f"tipforce {_version('tipforce')}, Python {platform.python_version()}, {base}")
    lacking = Finding("core", "note", "not compiled: logs are read more slowly", how_to_build())
    yield lacking if core is None else Finding("core", "ok", "compiled")
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


def configuration_check(options: Mapping[str, Any], flags: Mapping[str, Any]) -> Finding:
    """Return where the name of the bus comes from: flags, environment, configuration files, or the only interface."""
    sources = [f"flags ({' '.join(f'--{name} {value}' for name, value in flags.items())})"] if flags else []
    sources += [f"{name}={os.environ[name]}" for name in VARIABLES if os.environ.get(name)]
    sources += [str(path) for p in can.util.CONFIG_FILES if (path := Path(p).expanduser()).is_file()]
    try:
        config = can.util.load_config(config=dict(options))
    except (can.CanError, ValueError) as error:
        return Finding("configuration", "fail", f"{error}", "name the bus: -i socketcan -c can0")
    named = f"{config['interface']} {config.get('channel', '')}".strip()
    return Finding("configuration", "ok", f"{named}, from {'; '.join(sources) or 'the interfaces that are up'}")


def bus_findings(options: Mapping[str, Any], listen_s: float, wanted: tuple[FingerPlan, ...] = ()) -> Iterator[Finding]:
    """Open the bus, listen, ask every node-id for its identity, and yield what was found."""
    received: list[FrameArray] = []
    nodes = []
    link = links().get(str(options.get("channel")))
    try:
        with Bus(open_bus(**options)) as connection:
            begun_s, seen = time.monotonic(), Observed(duplicates=connection.duplicates, link=link)
            try:
                nodes = find_nodes(connection, range(1, 128), listen_s, received.append)
            except TipforceError as error:  # the bus takes no frames
                yield Finding("bus", "fail", str(error))
                time.sleep(listen_s)
            if any(connection.heartbeats.state(node.node_id) == STOPPED for node in nodes):
                time.sleep(BEATS_S)
            received.append(connection.buffer.take_all())
            seen.heard_s = time.monotonic() - begun_s
    except TipforceError as error:
        yield Finding("bus", "fail", str(error), "`tipforce doctor` without -i -c lists the interfaces")
        return
    frames = np.concatenate(received)
    seen.count(frames)
    seen.add_nodes(nodes)
    if seen.frames:
        rate = int(options.get("bitrate") or (link.bit_rate if link else 0) or DEFAULT_BIT_RATE)
        least, most = (bits / seen.heard_s / rate for bits in range_of_bits(frames))
        load = f"load {100 * least:.0f} to {100 * most:.0f} % of {rate} bit/s"
        finding = f"{len(frames) / seen.heard_s:.0f} frames/s, {load}"
        step = "a lower SYNC rate or fewer PDOs: `tipforce hand check` computes them" if most > _LOADED else ""
        yield Finding("traffic", "note" if step else "ok", finding, step)
    for node in nodes:
        if not node.duplicate:
            serial = f", serial {node.serial}" if node.product else ""
            yield Finding(shown([node.node_id]), "ok", f"{node.state}, {node.device}{serial}")
    yield from findings(seen, wanted=wanted)
