"""Checks of this machine: kernel and CAN interfaces, buses without hardware, converters, installed software."""

from __future__ import annotations

import errno
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tipforce.core import core, how_to_build
from tipforce.errors import TipforceError

if TYPE_CHECKING:
    from tipforce.sources.iio_sysfs import Device

State = Literal["ok", "note", "fail"]
"""ok; note: works, with a remark; fail: the requested function will not work."""


@dataclass(frozen=True, slots=True)
class Check:
    """``next_step`` is a command or a sentence, "" if none is needed."""

    topic: str
    state: State
    finding: str
    next_step: str = ""


ARPHRD_CAN = 280  # linux/if_arp.h
SHORT_QUEUE = 100  # frames; a hand responds to SYNC with more than the default of ten at once
_NET = Path("/sys/class/net")
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
    "science": ("scipy",),
    "plot": ("matplotlib",),
    "fem": ("scikit-fem",),
    "parquet": ("pyarrow",),
    "zstd": ("zstandard",),
    "mcap": ("mcap",),
    "ros2": ("cyclonedds",),
    "multicast": ("msgpack",),
    "dask": ("distributed",),
}
PEERS = ("candump", "canplayer", "tshark")


def kernel_checks(net: Path = _NET) -> Iterator[Check]:
    """CAN support, then each CAN interface."""
    if not sys.platform.startswith("linux"):
        yield Check("kernel", "note", f"{sys.platform}: no SocketCAN", "name your adapter's interface: -i")
        return
    yield _can_raw()
    interfaces = can_interfaces(net)
    if not interfaces:
        step = "plug in the adapter, or add vcan0: sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"
        yield Check("interface", "note", "no CAN interface", step)
    details = _ip_details()
    for name in interfaces:
        yield from interface_checks(name, details.get(name))


def can_interfaces(net: Path = _NET) -> list[str]:
    """Return the names of CAN network interfaces."""
    kinds = {file.parent.name: file.read_text() for file in net.glob("*/type")}
    return sorted(name for name, kind in kinds.items() if kind.strip() == str(ARPHRD_CAN))


def interface_checks(name: str, link: dict[str, Any] | None) -> Iterator[Check]:
    """Check one interface. ``link``: its record of `ip -details -json link show`, None without output."""
    topic = f"interface {name}"
    if link is None:
        yield Check(topic, "note", "details unknown", "install iproute2, which contains `ip`")
        return
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    virtual = info.get("info_kind") in ("vcan", "vxcan")
    rate = data.get("bittiming", {}).get("bitrate")
    kind = "virtual" if virtual else f"{rate} bit/s" if rate else "no bit rate set"
    state = "up" if "UP" in link.get("flags", ()) else "down"
    if state == "down":
        rate_words = "" if virtual else f" type can bitrate {rate or 1000000}"
        yield Check(topic, "fail", f"down, {kind}", f"sudo ip link set {name} up{rate_words}")
        return
    sample_point = data.get("bittiming", {}).get("sample_point")
    yield Check(topic, "ok", f"up, {kind}" + (f", sample point {sample_point}" if sample_point else ""))
    yield from _bus_state(topic, name, data)
    queue = link.get("txqlen")
    if not virtual and isinstance(queue, int) and queue < SHORT_QUEUE:
        yield Check(topic, "note", f"transmit queue of {queue} frames", f"sudo ip link set {name} txqueuelen 1000")


def _bus_state(topic: str, name: str, data: dict[str, Any]) -> Iterator[Check]:
    state = data.get("state")
    if state in (None, "ERROR-ACTIVE"):
        return
    counters = data.get("berr_counter", {})
    counts = f" (errors sent {counters['tx']}, received {counters['rx']})" if counters else ""
    step = "no acknowledgement, or different bit rates: check power, the two 120 ohm terminators, CAN-H and CAN-L"
    if state == "BUS-OFF":
        step = f"sudo ip link set {name} type can restart; restart-ms 100 restarts automatically"
    yield Check(topic, "fail", f"{state.lower()}{counts}", step)


def _can_raw() -> Check:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno in (errno.EPERM, errno.EACCES):
            return Check("kernel", "fail", "CAN sockets are not permitted here", "a container needs the host's network")
        return Check("kernel", "fail", f"no CAN sockets: {error.strerror}", _NO_CAN)
    return Check("kernel", "ok", "CAN sockets work")


def _ip_details() -> dict[str, dict[str, Any]]:
    command = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    if command is None:
        return {}
    done = subprocess.run([command, "-details", "-json", "link", "show"], capture_output=True, text=True, check=False)
    try:
        return {link["ifname"]: link for link in json.loads(done.stdout or "[]") if "ifname" in link}
    except ValueError:
        return {}


# --- buses without hardware ---------------------------------------------------------------------------------------


def trial() -> int:
    """Run `true` with the buses; return its exit code. Raises EnvironmentLackError."""
    from tipforce_tools.vcan.command import run_with_vcan

    return run_with_vcan(["true"], interfaces=INTERFACES, timeout_s=120.0)


def vcan_checks(try_it: Callable[[], int] | None = None) -> Iterator[Check]:
    """Yield one check; ``try_it`` replaces the trial in tests. Never raises."""
    if sys.platform != "linux":
        yield Check("vcan", "note", f"vcan exists on Linux only, and this is {sys.platform}", _UDP)
        return
    from tipforce_tools.vcan.command import choose
    from tipforce_tools.vcan.host import ELSEWHERE

    place = choose(INTERFACES)
    try:
        code = (try_it or trial)()
    except TipforceError as error:
        yield Check("vcan", "note", str(error).splitlines()[0], "`tipforce vcan -- true` shows the details")
        return
    if code:
        yield Check("vcan", "note", f"`tipforce vcan -- true` ended with {code}", ELSEWHERE)
    else:
        yield Check("vcan", "ok", f"`tipforce vcan` works: vcan0 and vcan1, {_PLACES[place]}")


def multicast_checks() -> Iterator[Check]:
    """Yield one check: open the bus of UDP datagrams, without sending. Never raises."""
    from tipforce.host.network.open_bus import open_bus

    try:
        open_bus(interface="udp_multicast", channel="239.74.163.2").shutdown()
        yield Check("UDP bus", "ok", f"{_UDP} between programs, where vcan is not available")
    except TipforceError as error:
        yield Check("UDP bus", "note", str(error))


# --- converters ---------------------------------------------------------------------------------------------------


def iio_checks(root: Path = _IIO, device_files: Path = Path("/dev"), configfs: Path | None = None) -> Iterator[Check]:
    """Yield a check per converter, or one if there is none. Checks neither raise nor change anything."""
    if sys.platform != "linux":
        yield Check("ADC", "note", f"Industrial I/O needs Linux; this is {sys.platform}", "--source sim or replay:FILE")
        return
    from tipforce.sources import iio_sysfs

    if not root.is_dir():
        yield Check("ADC", "note", "the kernel has no Industrial I/O", "`modprobe industrialio`, or --source sim")
        return
    devices = iio_sysfs.devices(root)
    with_voltage = [device for device in devices if _channels(device.path)]
    if not with_voltage:
        others = f"; found: {', '.join(map(str, devices))}" if devices else ""
        step = "`echo NAME 0xADDRESS > /sys/bus/i2c/devices/i2c-N/new_device`"
        yield Check(
            "ADC",
            "note",
            f"no converter{others}",
            f"load its driver, and name the chip in the device tree or by {step}",
        )
        return
    for device in with_voltage:
        yield from _device_checks(device, device_files)
    yield _buffering(with_voltage, root, configfs)


def _channels(path: Path) -> list[str]:
    from tipforce.sources import iio_sysfs

    with suppress(OSError):
        return iio_sysfs.voltage_channels(path)
    return []


def _device_checks(device: Device, device_files: Path) -> Iterator[Check]:
    from tipforce.sources import iio_sysfs

    topic, path, channels = f"ADC {device.number}", device.path, _channels(device.path)
    types = [iio_sysfs.scan_type(path, channel) for channel in channels]
    bits = "/".join(map(str, sorted({kind.bits for kind in types if kind is not None})))
    shown = f"{device}: {', '.join(channels)}" + (f", {bits} bits" if bits else "")
    yield Check(topic, "ok", shown, f"--source iio:{device.place or device.number}")
    try:
        iio_sysfs.raw_value(path, channels[0])
    except OSError as error:
        yield Check(topic, "note", f"no response: {error.strerror}", "check its wiring and supply, and `dmesg`")
    if None in types:
        step = "write [bridge] count_range = [lowest, highest] into the layout file"
        yield Check(topic, "note", "the driver does not state the range of counts", step)
    try:
        no_scale = "the driver states none" if iio_sysfs.attribute(path, channels[0], "scale") is None else ""
    except OSError as error:
        no_scale = f"{error.strerror}: the driver knows no reference voltage"
    if no_scale:
        step = "write [bridge] volts_per_count = reference voltage / number of counts into the layout file"
        yield Check(topic, "note", f"no scale ({no_scale})", step)
    file = device_files / device.number
    if file.exists() and not os.access(file, os.R_OK):
        yield Check(topic, "note", f"{file} is not readable: polling works, buffered capture does not", "run as root")


def _buffering(devices: list[Device], root: Path, configfs: Path | None) -> Check:
    from tipforce.sources import iio_buffer

    topic = "ADC trigger"
    own = [name for device in devices if (name := iio_buffer.own_trigger(device, root))]
    if own:
        return Check(topic, "ok", f"data-ready triggers: {', '.join(own)}", "used by --capture auto")
    if (configfs or iio_buffer.HRTIMER).is_dir():
        return Check(topic, "ok", "timer triggers are available", "used by --capture auto, rate by --scan-rate")
    others = ", ".join(iio_buffer.triggers(root))
    if others:
        return Check(topic, "ok", f"triggers: {others}", "--trigger NAME")
    step = "for buffered capture: `modprobe iio-trig-hrtimer` and `mount -t configfs none /sys/kernel/config`"
    return Check(topic, "note", "no trigger: converters are polled", step)


# --- software -----------------------------------------------------------------------------------------------------


def software_checks() -> Iterator[Check]:
    """Yield checks of versions, extras and related tools."""
    base = ", ".join(f"{name} {_version(name)}" for name in BASE)
    yield Check("software", "ok", f"tipforce {_version('tipforce')}, Python {platform.python_version()}, {base}")
    built = core is not None
    finding = "compiled" if built else "not compiled: logs are read more slowly"
    yield Check("core", "ok" if built else "note", finding, "" if built else how_to_build())
    missing = [extra for extra, names in EXTRAS.items() if any(_version(name) == "missing" for name in names)]
    yield _lacks("extras", "not installed", missing, f'pip install "tipforce[{",".join(missing)}]"', "all installed")
    absent = [name for name in PEERS if shutil.which(name) is None]
    yield _lacks("peers", "not found", absent, "sudo apt-get install can-utils tshark", ", ".join(PEERS))


def _lacks(topic: str, how: str, names: list[str], step: str, complete: str) -> Check:
    return Check(topic, "note", f"{how}: {', '.join(names)}", step) if names else Check(topic, "ok", complete)


def _version(name: str) -> str:
    import importlib.metadata

    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
