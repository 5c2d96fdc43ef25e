"""canopen's LocalNode with a SYNC callback that sends two TPDOs, over the socket of bench/device_latency.py."""

from __future__ import annotations

import io
import select
import socket
import time
from typing import Any

import can
import canopen
from bench.device_costs import EDS, calibrated_node
from bench.device_usage import MARK_ID, Stopped, Usage

from tipforce.running import loop
from tipforce.socketcan import CAN_FRAME


class Loopback(can.BusABC):
    """A python-can bus over a datagram socket; ``done`` is true once the master ended it."""

    channel_info = "loopback"

    def __init__(self, bus: socket.socket, usage: Usage) -> None:
        super().__init__(channel="loopback")
        self._socket = bus
        self._usage = usage
        self.done = False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """One datagram."""
        self._socket.send(CAN_FRAME.pack(msg.arbitration_id, msg.dlc, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not select.select([self._socket], [], [], timeout)[0]:
            return None, False
        can_id, length, data = CAN_FRAME.unpack(self._socket.recv(16))
        if can_id >= MARK_ID:
            try:
                self._usage.control(can_id)
            except Stopped:
                self.done = True
            return None, False
        return can.Message(arbitration_id=can_id, data=data[:length], is_extended_id=False), False


class Finger:
    """One LocalNode with our EDS and, for the values, the application of a node of ours."""

    def __init__(self, network: canopen.Network, node_id: int) -> None:
        file = io.StringIO(EDS.decode())
        file.name = "node.eds"
        node = network.create_node(node_id, canopen.import_od(file, node_id))
        node.tpdo.read(from_od=True)
        self.pdos = [node.tpdo[1], node.tpdo[2]]
        self._application: Any = calibrated_node(node_id).application

    def set_values(self) -> None:
        """Latch a sample, compute what the PDOs carry, set each mapped variable."""
        self._application.on_sync(loop.now_us(), 0)
        od = self._application.device.od
        for pdo in self.pdos:
            for variable in pdo.map:
                variable.raw = od.get(variable.index, variable.subindex)


def run(bus: socket.socket, nodes: int, usage: Usage, measuring: bool) -> None:
    """Until the master ends it. ``measuring``: values are set anew for each SYNC."""
    loopback = Loopback(bus, usage)
    network = canopen.Network(loopback)
    fingers = [Finger(network, k + 1) for k in range(nodes)]

    def on_sync(_can_id: int, _data: bytearray, _timestamp: float) -> None:
        for finger in fingers:
            if measuring:
                finger.set_values()
            for pdo in finger.pdos:
                pdo.transmit()

    network.subscribe(0x80, on_sync)
    network.connect()
    while not loopback.done:
        time.sleep(0.05)
    if network.notifier is not None:
        network.notifier.stop()


def run_constant(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """LocalNode at its best: the data of the PDOs never changes."""
    run(bus, nodes, usage, False)


def run_measuring(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """LocalNode doing what the node does: latch, estimate, set the five values of each PDO, send."""
    run(bus, nodes, usage, True)
