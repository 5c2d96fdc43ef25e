"""A node whose load tells which SYNC an answer is to: for test_hand_session.py.

Not in the test module, because each node's process imports what it is defined in, and there pytest takes a second."""

import fcntl
import gc
import socket
import struct

import numpy as np
import numpy.typing as npt

from canopen_device.running import loop
from canopen_device.running.ports import SocketCanPort
from tipforce.fingertip.node import fingertip_node
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import SimulatedSource

FIRST_NEWTONS, NEWTONS_PER_S = 1.0, 1.0
RISE_NS = 8_000_000_000  # then it begins anew: at 1 + 8 N no gauge is near its end
NMT, SYNC, LSS = 0x000, 0x080, 0x7E5
_EXTENDED = 0x80000000
_TIMESTAMP_NS = 0x8907  # SIOCGSTAMPNS of asm-generic/sockios.h
_TIMESPEC = struct.Struct("=qq")


def force_newtons(sync_ns: npt.ArrayLike, node_id: int) -> npt.NDArray[np.float64]:
    """What presses on a finger when a SYNC comes, by the kernel's time stamp of it: each SYNC has a force of its own.

    The stamp is one for all sockets that get the frame, so node and host agree on it however late either of them runs.
    """
    rising_s = 1e-9 * (np.asarray(sync_ns, dtype=np.int64) % RISE_NS)
    return np.asarray(FIRST_NEWTONS + 0.2 * node_id + NEWTONS_PER_S * rising_s, dtype=np.float64)


def _filters(node_id: int) -> bytes:
    """What a fingertip's CAN controller lets pass: whatever carries its node-id, and what is for all.

    Five nodes on one emulated processor that look at each other's PDOs leave it little time for anything else."""
    wanted = [(node_id, 0x7F), (NMT, 0x7FF), (SYNC, 0x7FF), (LSS, 0x7FF)]
    return b"".join(struct.pack("=II", can_id, mask | _EXTENDED) for can_id, mask in wanted)


def run_node(node_id: int, channel: str) -> None:
    """A process: one node without a store, until it is killed."""
    gc.freeze()  # see support.py
    source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist())

    class Pressed(SocketCanPort):
        def __init__(self) -> None:
            super().__init__(channel)
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, _filters(node_id))
            self._stamp()  # the first call asks the kernel for stamps

        def receive(self, timeout_s: float) -> loop.Frame | None:
            frame = super().receive(timeout_s)
            if frame is not None and frame[0] == SYNC:
                source.load = (float(force_newtons(self._stamp(), node_id)), 10.0, 30.0)
            return frame

        def _stamp(self) -> int:
            """Time of the frame that was read last, ns since 1970."""
            try:
                found = fcntl.ioctl(self._socket, _TIMESTAMP_NS, bytes(_TIMESPEC.size))
            except FileNotFoundError:  # there was no frame yet
                return 0
            seconds, ns = _TIMESPEC.unpack(found)
            return int(seconds) * 1_000_000_000 + int(ns)

    loop.run([fingertip_node(node_id, source, serial=1000 + node_id)], Pressed())
