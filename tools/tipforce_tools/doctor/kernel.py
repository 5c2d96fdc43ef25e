"""Checks of the kernel: CAN support, interfaces with their bit rate and state, permissions."""

from __future__ import annotations

import errno
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tipforce_tools.doctor.check import Check

ARPHRD_CAN = 280  # linux/if_arp.h
SHORT_QUEUE = 100  # frames; a hand responds to SYNC with more than the default of ten at once
_NET = Path("/sys/class/net")
_NO_CAN = "load it: sudo modprobe can_raw; if the kernel has none, `tipforce vcan` runs commands on one that has"


def kernel_checks(net: Path = _NET) -> Iterator[Check]:
    """CAN support, then each CAN interface."""
    if not sys.platform.startswith("linux"):
        yield Check("kernel", "note", f"{sys.platform}: no SocketCAN", "name your adapter's interface: -i")
        return
    yield _can_raw()
    interfaces = can_interfaces(net)
    if not interfaces:
        yield Check(
            "interface", "note", "no CAN interface",
            "plug in the adapter, or add vcan0: sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up",
        )  # fmt: skip
    details = _ip_details()
    for name in interfaces:
        yield from interface_checks(name, details.get(name))


def can_interfaces(net: Path = _NET) -> list[str]:
    """Return the names of CAN network interfaces."""
    if not net.is_dir():
        return []
    return sorted(path.name for path in net.iterdir() if _number(path / "type") == ARPHRD_CAN)


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
    yield Check(topic, "ok", f"up, {kind}{_timing(data)}")
    yield from _bus_state(topic, name, data)
    queue = link.get("txqlen")
    if not virtual and isinstance(queue, int) and queue < SHORT_QUEUE:
        yield Check(topic, "note", f"transmit queue of {queue} frames", f"sudo ip link set {name} txqueuelen 1000")


def _timing(data: dict[str, Any]) -> str:
    sample_point = data.get("bittiming", {}).get("sample_point")
    return f", sample point {sample_point}" if sample_point else ""


def _bus_state(topic: str, name: str, data: dict[str, Any]) -> Iterator[Check]:
    state = data.get("state")
    if state in (None, "ERROR-ACTIVE"):
        return
    counters = data.get("berr_counter", {})
    counts = f" (errors sent {counters['tx']}, received {counters['rx']})" if counters else ""
    if state == "BUS-OFF":
        step = f"sudo ip link set {name} type can restart; restart-ms 100 restarts automatically"
        yield Check(topic, "fail", f"bus-off{counts}", step)
    else:
        step = "no acknowledgement, or different bit rates: check power, the two 120 ohm terminators, CAN-H and CAN-L"
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


def _number(path: Path) -> int:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return -1
