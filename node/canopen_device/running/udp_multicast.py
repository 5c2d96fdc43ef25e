"""CAN frames as UDP multicast (python-can's `udp_multicast`) without the own frames of a bus object, which the network
returns for other programs of the machine: a node would report them as a collision (EMCY 8150h)."""

import copy
import logging
import secrets
import struct
import time
from typing import Any

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.utils import is_msgpack_installed, unpack_message

from canopen_device.errors import EnvironmentLackError

DEFAULT_GROUP = UdpMulticastBus.DEFAULT_GROUP_IPv4
"""A group of IPv4: containers often have no IPv6."""

_LOG = logging.getLogger(__name__)
_FLOAT64 = b"\xcb"  # of MessagePack, in which the frames are packed


class OwnEchoFreeBus(UdpMulticastBus):
    """A multicast bus that drops its own echoes and malformed datagrams. The field ``timestamp`` of a sent frame
    identifies its sender: receivers, also plain python-can's, replace it by the time of reception."""

    def __init__(self, channel: str = DEFAULT_GROUP, **options: Any) -> None:
        """Raises EnvironmentLackError if the package is missing or the machine has no route to the group."""
        if not is_msgpack_installed(raise_exception=False):
            raise EnvironmentLackError("udp_multicast needs msgpack: pip install msgpack")
        self._sender = float(secrets.randbits(52))
        self._mark = _FLOAT64 + struct.pack(">d", self._sender)
        try:
            super().__init__(channel, **options)
        except can.CanInitializationError as error:
            self._is_shutdown = True  # otherwise python-can logs that an unopened bus was not closed
            raise EnvironmentLackError(
                f"udp_multicast, group {channel}: {error.__cause__ or error}; without a network, on Linux: "
                "`sudo ip link set lo up && sudo ip route add 239.0.0.0/8 dev lo`, "
                f"then -i udp_multicast -c {DEFAULT_GROUP}"
            ) from None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        marked = copy.copy(msg)
        marked.timestamp = self._sender
        super().send(marked, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            received = self._multicast.recv(timeout)
            if received is None:
                return None, False
            data, _, timestamp_s = received
            message = None
            try:
                if self._mark not in data:
                    message = unpack_message(data, replace={"timestamp": timestamp_s}, check=True)
            except Exception as error:  # of another program; msgpack raises errors of several kinds, python-can others
                _LOG.debug("a datagram that holds no frame: %s", error)
            if message is not None and (not message.is_fd or self._can_protocol is can.CanProtocol.CAN_FD):
                return message, False
            if deadline_s is not None:
                timeout = max(deadline_s - time.monotonic(), 0.0)
