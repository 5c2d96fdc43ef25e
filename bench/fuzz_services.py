"""What the frame fuzzer throws at every service but SDO: SYNC, NMT, LSS, TIME, heartbeats, error frames, noise."""

from __future__ import annotations

import struct
from random import Random
from typing import TYPE_CHECKING

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG

if TYPE_CHECKING:
    from bench.fuzz import Rig

Frame = tuple[int, bytes]


class Services:
    """Single frames that mean something to ``rig``'s node."""

    def __init__(self, rng: Random, rig: Rig) -> None:
        self._rng = rng
        self._rig = rig

    def _pick(self, items: tuple[int, ...]) -> int:
        return items[int(self._rng.random() * len(items))]

    def _byte(self) -> int:
        return self._rng.getrandbits(8)

    def _sync(self) -> Frame:
        data = b"" if self._rng.random() < 0.7 else bytes((self._byte() % 11,))
        return (self._rig.device.sync.cob_id if self._rng.random() < 0.9 else 0x80), data

    def _nmt(self) -> Frame:
        command = self._pick((1, 1, 1, 1, 1, 2, 128, 128, 129, 130, 0, 3))
        node_id = self._pick((0, self._rig.device.node_id, self._rig.device.node_id, 9))
        return 0, bytes((command, node_id))

    def _lss(self) -> Frame:
        identity = [int(self._rig.device.od.get(0x1018, sub)) for sub in (1, 2, 3, 4)]
        service = self._pick((0x04, 0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x46, 0x4C, 0x51, 0x51, 0x5A, 0x5E))
        if service in (0x40, 0x46):
            part = int(self._rng.random() * (4 if service == 0x40 else 6))
            number = identity[part if service == 0x40 else (0, 1, 2, 2, 3, 3)[part]]
            return 0x7E5, struct.pack("<BIxxx", service + part, number)
        if service == 0x51:
            part = int(self._rng.random() * 4)
            bit = self._pick((0, 0, 1, 5, 31, 32, 0x80))
            return 0x7E5, struct.pack(
                "<BIBBB", service, identity[part], bit, part, self._pick((0, part, (part + 1) % 4))
            )
        value = self._pick((0, 1, 5, 127, 128, 255, 0))
        return 0x7E5, bytes((service, value, self._pick((0, 1, 5, 8, 9)), 0, 0, 0, 0, 0))

    def _time(self) -> Frame:
        return 0x100, struct.pack("<IH", self._rng.getrandbits(28), self._rng.getrandbits(16))

    def _heartbeat(self) -> Frame:
        return 0x700 + self._pick((1, 2, 3, 4, 127)), bytes((self._pick((0, 4, 5, 127)),))

    def _command(self) -> Frame:
        return 0x200 + self._rig.device.node_id & 0x7FF, bytes((self._byte() % 5, 0))

    def _remote(self) -> Frame:
        return 0x700 + self._rig.device.node_id & 0x7FF | REMOTE_FLAG, b""

    def _error(self) -> Frame:
        kind = self._pick((0x004, 0x004, 0x004, 0x040, 0x100, 0x044, 0x008))
        return ERROR_FLAG | kind, bytes(
            (0, self._pick((0, 1, 2, 4, 8, 0x10, 0x20, 0x30, 0x40, 0xFF)), 0, 0, 0, 0, 0, 0)
        )

    def _own(self) -> Frame:
        """Another node with this node's identifiers."""
        return (self._pick((0x580, 0x700, 0x180, 0x280, 0x80)) + self._rig.device.node_id) & 0x7FF, self._rng.randbytes(
            8
        )

    def _noise(self) -> Frame:
        can_id = self._rng.getrandbits(11)
        if self._rng.random() < 0.3:
            can_id = self._rng.getrandbits(29) | self._pick((0, EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG))
        return can_id, self._rng.randbytes(int(self._rng.random() * 9))
