"""The CAN interfaces of this machine (SocketCAN): which are up, and what the kernel says of each; and opening a bus."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import subprocess
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tipforce.errors import EnvironmentLackError

if TYPE_CHECKING:
    import can

    from canopen_device.running.open_bus import PythonCanPort
    from canopen_device.running.ports import SocketCanPort

ARPHRD_CAN = 280  # linux/if_arp.h
_SIOCGIFFLAGS, _SIOCGIFHWADDR, _IFF_UP = 0x8913, 0x8927, 1  # linux/sockios.h, linux/if.h


def interfaces() -> dict[str, bool]:
    """Return whether each CAN interface of this network namespace is up, by its name, sorted."""
    if sys.platform != "linux":
        return {}
    import fcntl

    kinds: dict[str, tuple[int, int]] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        for _, name in sorted(socket.if_nameindex(), key=lambda item: item[1]):
            request = struct.pack("16s24x", name.encode())
            try:
                flags, kind = (
                    struct.unpack_from("H", fcntl.ioctl(asker, number, request), 16)[0]
                    for number in (_SIOCGIFFLAGS, _SIOCGIFHWADDR)
                )
            except OSError:  # it was removed
                continue
            kinds[name] = flags, kind
    return {name: bool(flags & _IFF_UP) for name, (flags, kind) in kinds.items() if kind == ARPHRD_CAN}


@dataclass(frozen=True, slots=True)
class Link:
    """One interface as `ip -details` shows it. ``state``: of its controller, "" where the kernel states none."""

    name: str
    up: bool
    virtual: bool = True
    bit_rate: int = 0
    sample_point: str = ""
    state: str = ""
    errors_sent: int = 0
    errors_received: int = 0
    queue: int | None = None
    """Frames of the transmit queue."""

    @property
    def disturbed(self) -> bool:
        """Whether the controller counts errors: nobody acknowledges, or with another bit rate."""
        return self.state not in ("", "ERROR-ACTIVE") or max(self.errors_sent, self.errors_received) > 0


def links() -> dict[str, Link]:
    """Return the CAN interfaces by name; without `ip` (iproute2) only whether they are up."""
    command = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    if command is None:
        return {name: Link(name, up) for name, up in interfaces().items()}
    done = subprocess.run([command, "-details", "-json", "link", "show"], capture_output=True, text=True, check=False)
    try:
        records = json.loads(done.stdout or "[]")
    except ValueError:
        return {}
    return {link["ifname"]: link_of(link) for link in records if link.get("link_type") == "can"}


def link_of(record: dict[str, Any]) -> Link:
    """Return one record of `ip -details -json link show`."""
    info = record.get("linkinfo", {})
    data = info.get("info_data", {})
    timing, counter = data.get("bittiming", {}), data.get("berr_counter", {})
    return Link(
        record["ifname"], "UP" in record.get("flags", ()), info.get("info_kind") in ("vcan", "vxcan"),
        int(timing.get("bitrate") or 0), str(timing.get("sample_point", "")), str(data.get("state") or ""),
        int(counter.get("tx", 0)), int(counter.get("rx", 0)), record.get("txqlen"),
    )  # fmt: skip


def open_bus(**options: Any) -> can.BusABC:
    """Return python-can's bus. Raises as canopen_device's open_bus does, with the commands that help."""
    from canopen_device.running import open_bus as devices_bus

    return devices_bus.open_bus(
        options,
        "use -i and -c, as in -i socketcan -c can0, or set CAN_INTERFACE and CAN_CHANNEL; "
        "`tipforce doctor` lists the interfaces of this machine",
        "check -i and -c (`ip -br link` lists interfaces), run on a kernel with vcan: `tipforce vcan -- ...`, "
        "or use -i udp_multicast",
    )


def open_port(**options: Any) -> tuple[SocketCanPort | PythonCanPort, str]:
    """Return a port for nodes, and its name: kernel sockets for SocketCAN, python-can for every other interface."""
    from canopen_device.running.open_bus import PythonCanPort
    from canopen_device.running.ports import SocketCanPort

    channel = options.get("channel")
    if sys.platform == "linux" and options.get("interface") == "socketcan" and channel:
        try:
            return SocketCanPort(channel), channel
        except OSError as error:
            raise EnvironmentLackError(
                f"interface socketcan, channel {channel}: {error.strerror}; `ip -br link` lists interfaces; "
                "`tipforce vcan -- ...` provides vcan"
            ) from error
    bus = open_bus(**options)
    return PythonCanPort(bus, lambda: open_bus(**options)), str(bus.channel_info)
