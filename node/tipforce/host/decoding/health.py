"""The faults of a node (2124h) as its TPDO4, EMCY and boot-up messages tell them: held until they say otherwise.

By default TPDO4 is off and bits 12 to 15 are in no other PDO, so EMCY is all that a bus shows of them; bit 13 has none.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import EMCY_BASE, HEARTBEAT_BASE, INITIALISING, NODE_ID_MASK, SYNC_COB_ID
from tipforce.arrays import IntArray
from tipforce.dictionary import table
from tipforce.host.decoding.decoder import Samples
from tipforce.host.frames.frame_array import FrameArray

ALL = 0xFFFF
TOLD_BY_EMCY = 1 << table.FAULT_CONTRADICTION | 1 << table.FAULT_TEMPERATURE | 1 << table.FAULT_OVERLOAD
"""What the calibration says of a sample, as far as EMCY has it."""
NAMES = {f"SG{k + 1}_fault": k for k in range(table.MAX_GAUGES)} | {f"fault_{n}": k for k, n, _ in table.FAULT_BITS}
"""Bit of 2124h by signal name."""
EMCY_LENGTH = 8
MOST_KEPT = 4096
"""Changes of one node that are kept: more than a block of frames has."""
_BEFORE = -1 << 63
_OF_BIT = {table.EMCY_TEMPERATURE: table.FAULT_TEMPERATURE, table.EMCY_OVERLOAD: table.FAULT_OVERLOAD}


def of_emcy(data: bytes) -> tuple[int, bool]:
    """(bit of 2124h, whether it is set) that an EMCY message of 8 bytes tells; (0, False) for any other error."""
    code, _, detail, second = struct.unpack("<HBHHx", data)
    is_set = code != 0
    if not is_set:
        code, detail = detail, second
    bit = -1
    if code == table.EMCY_GAUGE_SATURATED:
        bit = detail - 1
    elif code == table.EMCY_FRONT_END:
        # Of a gauge left out: its number, and above it the bit that says why.
        bit = (detail & 0xFF) - 1 if detail >> 8 else detail
    elif _OF_BIT.get(code) == detail:
        bit = detail
    return (1 << bit, is_set) if 0 <= bit < 16 else (0, False)


def packed(columns: Mapping[str, npt.NDArray[Any]]) -> IntArray | None:
    """2124h from the columns of its bits, (k,); None where these are not all that a TPDO4 has of bits 8 to 15."""
    if any(f"fault_{name}" not in columns for _, name, _ in table.FAULT_BITS):
        return None
    found = [(columns[name] == 1).astype(np.int64) << bit for name, bit in NAMES.items() if name in columns]
    return np.asarray(np.bitwise_or.reduce(found))


def lost_gauges(columns: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...]) -> IntArray:
    """Bits of the gauges that the node left out or found saturated, of samples with ``shape`` (k, n): (k,).

    2124h may come later than the sample; what counts for a sample is its own status.
    """
    found = np.zeros(shape[0], dtype=np.int64)
    for gauge in range(shape[1]):
        told = columns.get(f"SG{gauge + 1}_fault")
        if told is not None:
            found |= (told == 1).astype(np.int64) << gauge
    status = columns.get("saturated")
    return found if status is None else np.where(status == 1, found, 0)


class Health:
    """2124h of each node over time: what is set, and which bits something has told.

    Times are integers that do not decrease from call to call: nanoseconds, or places in a log.
    """

    def __init__(self, told: Mapping[int, tuple[int, int]] | None = None, unknown: tuple[int, int] = (0, 0)) -> None:
        """``told``: (faults, seen) by node before the first time; ``unknown``: of all other nodes."""
        self._unknown = unknown
        # node -> (time, faults, seen), the last MOST_KEPT
        self._told = {node: [(_BEFORE, *state)] for node, state in (told or {}).items()}

    @property
    def nodes(self) -> list[int]:
        """The nodes of which something is known."""
        return list(self._told)

    def now(self, node: int) -> tuple[int, int]:
        """(faults, seen) at present."""
        told = self._told.get(node)
        return self._unknown if told is None else told[-1][1:]

    def at(self, node: int, times: npt.NDArray[np.int64]) -> tuple[IntArray, IntArray]:
        """(faults, seen) of a node at some times, (k,) each."""
        told = np.array([(0, 0, 0), *self._told.get(node, ())], dtype=np.int64)
        place = np.searchsorted(told[1:, 0], times, side="right")
        return told[place, 1], told[place, 2]

    def pdo(self, node: int, time: int, faults: int, mask: int = ALL) -> None:
        """A TPDO4 tells the bits of ``mask``."""
        before, seen = self.now(node)
        self._tell(node, time, before & ~mask | faults, seen | mask)

    def set(self, node: int, faults: int, seen: int) -> None:
        """Set the state at present, without a past."""
        self._told[node] = [(_BEFORE, faults, seen)]

    def boot(self, node: int, time: int) -> None:
        """A node that has booted tells each fault again."""
        self._tell(node, time, 0, TOLD_BY_EMCY)

    def emcy(self, node: int, time: int, data: bytes) -> None:
        """An EMCY tells that a fault began or ended."""
        if len(data) == EMCY_LENGTH:
            bit, is_set = of_emcy(data)
            faults, seen = self.now(node)
            self._tell(node, time, faults | bit if is_set else faults & ~bit, seen | bit)

    def _tell(self, node: int, time: int, faults: int, seen: int) -> None:
        if (faults, seen) != self.now(node):
            told = self._told.setdefault(node, [])
            told.append((time, faults, seen))
            del told[:-MOST_KEPT]

    def take(self, frames: FrameArray, decoded: Iterable[Samples] = ()) -> None:
        """Received frames, FRAME (n,): EMCY and boot-ups among them, and what was decoded of them."""
        found: list[tuple[int, int, int | bytes]] = []  # row, node-id, 2124h or the frame's data
        for samples in decoded:
            words = packed(samples.columns)
            if words is not None:
                rows = samples.row.tolist()
                found += zip(rows, [samples.node_id] * len(rows), words.tolist(), strict=True)
        function = frames["can_id"] & ~np.uint32(NODE_ID_MASK)
        few = (function == HEARTBEAT_BASE) | ((function == EMCY_BASE) & (frames["can_id"] != SYNC_COB_ID))
        for row in np.flatnonzero(few).tolist():
            data = frames["data"][row][: frames["length"][row]].tobytes()
            found.append((row, int(frames["can_id"][row]) & NODE_ID_MASK, data))
        for row, node, what in sorted(found, key=lambda one: one[0]):
            time = int(frames["t_ns"][row])
            if isinstance(what, int):
                self.pdo(node, time, what)
            elif function[row] == EMCY_BASE:
                self.emcy(node, time, what)
            elif what and what[0] & NODE_ID_MASK == INITIALISING:
                self.boot(node, time)
