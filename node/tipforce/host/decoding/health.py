"""The faults of a node (2124h) as its TPDO4, EMCY and boot-up messages tell them: held until they say otherwise. By
default TPDO4 is off, so EMCY is all that a bus shows of bits 12 to 15; bit 13 has none."""

import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import EMCY_BASE, HEARTBEAT_BASE, INITIALISING, NODE_ID_MASK
from tipforce.arrays import BoolArray, IntArray, occurring
from tipforce.dictionary import table as dictionary
from tipforce.dictionary.signals import Message, Signal
from tipforce.host.decoding.decoder import Samples
from tipforce.host.decoding.sample_table import NO_COUNTER, NO_FLAG, NO_INTEGER, Table, flag, in_order, place_of
from tipforce.host.frames.frame_array import FrameArray, heartbeats_and_emcys
from tipforce.samples import reasons

ALL = 0xFFFF
TOLD_BY_EMCY = 1 << dictionary.FAULT_CONTRADICTION | 1 << dictionary.FAULT_TEMPERATURE | 1 << dictionary.FAULT_OVERLOAD
"""What the calibration says of a sample, as far as EMCY has it."""
NAMES = {f"SG{k + 1}_fault": k for k in range(dictionary.MAX_GAUGES)} | {
    f"fault_{n}": k for k, n, _ in dictionary.FAULT_BITS
}
"""Bit of 2124h by signal name."""
EMCY_LENGTH = 8
MOST_KEPT = 4096
"""Changes of one node that are kept: more than a block of frames has."""
_BEFORE = -1 << 63
_OF_BIT = {
    dictionary.EMCY_TEMPERATURE: dictionary.FAULT_TEMPERATURE,
    dictionary.EMCY_OVERLOAD: dictionary.FAULT_OVERLOAD,
}


def of_emcy(data: bytes) -> tuple[int, bool]:
    """(bit of 2124h, whether it is set) that an EMCY message of 8 bytes tells; (0, False) for any other error."""
    code, _, detail, second = struct.unpack("<HBHHx", data)
    is_set = code != 0
    if not is_set:
        code, detail = detail, second
    bit = -1
    if code == dictionary.EMCY_GAUGE_SATURATED:
        bit = detail - 1
    elif code == dictionary.EMCY_FRONT_END:
        # Of a gauge left out: its number, and above it the bit that says why.
        bit = (detail & 0xFF) - 1 if detail >> 8 else detail
    elif _OF_BIT.get(code) == detail:
        bit = detail
    return (1 << bit, is_set) if 0 <= bit < 16 else (0, False)


def told_by(names: Collection[str]) -> int:
    """The bits of 2124h that a message with these signals tells; 0 where it has not all of bits 8 to 15, as TPDO4."""
    whole = all(f"fault_{name}" in names for _, name, _ in dictionary.FAULT_BITS)
    return sum(1 << bit for name, bit in NAMES.items() if name in names) if whole else 0


def faults_of(columns: Mapping[str, npt.NDArray[Any]], k: int, mask: int = ALL) -> IntArray:
    """2124h (k,) from the columns of its bits, as far as they are there and in ``mask``."""
    faults = np.zeros(k, dtype=np.int64)
    for name, bit in NAMES.items():
        if mask >> bit & 1 and name in columns:
            faults |= (columns[name] == 1).astype(np.int64) << bit
    return faults


def lost_gauges(columns: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...]) -> IntArray:
    """Bits of the gauges that the node left out or found saturated, of samples with ``shape`` (k, n): (k,). 2124h may
    come later than the sample; what counts for a sample is its own status."""
    bits, status = faults_of(columns, shape[0], (1 << shape[1]) - 1), columns.get("saturated")
    return bits if status is None else np.where(status == 1, bits, 0)


class Health:
    """2124h of each node over time: what is set, and which bits something has told. Times are integers that do not
    decrease from call to call: nanoseconds, or places in a log."""

    def __init__(self, told: Mapping[int, tuple[int, int]] | None = None) -> None:
        """``told``: (faults, seen) by node before the first time."""
        # node -> (time, faults, seen), the last MOST_KEPT
        self._told = {node: [(_BEFORE, *state)] for node, state in (told or {}).items()}

    @property
    def nodes(self) -> list[int]:
        """The nodes of which something is known."""
        return list(self._told)

    def now(self, node: int) -> tuple[int, int]:
        """(faults, seen) at present."""
        told = self._told.get(node)
        return (0, 0) if told is None else told[-1][1:]

    def at(self, node: int, times: npt.NDArray[np.int64]) -> tuple[IntArray, IntArray]:
        """(faults, seen) of a node at some times, (k,) each."""
        told = np.array([(0, 0, 0), *self._told.get(node, ())], dtype=np.int64)
        place = np.searchsorted(told[1:, 0], times, side="right")
        return told[place, 1], told[place, 2]

    def pdo(self, node: int, time: int, faults: int, mask: int = ALL) -> None:
        """A TPDO4 tells the bits of ``mask``."""
        before, seen = self.now(node)
        self._tell(node, time, before & ~mask | faults, seen | mask)

    def service(self, node: int, time: int, base: int, data: bytes) -> None:
        """Take an EMCY: a fault began or ended; or a heartbeat: a node that has booted tells each fault again."""
        if base == EMCY_BASE and len(data) == EMCY_LENGTH:
            bit, is_set = of_emcy(data)
            faults, seen = self.now(node)
            self._tell(node, time, faults | bit if is_set else faults & ~bit, seen | bit)
        elif base == HEARTBEAT_BASE and data and data[0] & NODE_ID_MASK == INITIALISING:
            self._tell(node, time, 0, TOLD_BY_EMCY)

    def _tell(self, node: int, time: int, faults: int, seen: int) -> None:
        if (faults, seen) != self.now(node):
            told = self._told.setdefault(node, [])
            told.append((time, faults, seen))
            del told[:-MOST_KEPT]

    def take(self, frames: FrameArray, decoded: Iterable[Samples] = ()) -> None:
        """Received frames, FRAME (n,): EMCY and boot-ups among them, and what was decoded of them."""
        told: list[tuple[int, int, int | tuple[int, bytes]]] = []  # row, node-id, 2124h or a service
        for samples in decoded:
            if told_by(samples.columns):
                words = faults_of(samples.columns, len(samples.row)).tolist()
                told += [(row, samples.node_id, word) for row, word in zip(samples.row.tolist(), words, strict=True)]
        told += [(row, node, (function, data)) for row, function, node, data in heartbeats_and_emcys(frames)]
        for row, node, what in sorted(told, key=lambda of_row: of_row[0]):
            time = int(frames["t_ns"][row])
            if isinstance(what, int):
                self.pdo(node, time, what)
            else:
                self.service(node, time, *what)


EMCY, STATE = "emcy", "nmt_state"
"""Columns of the messages below, which become rows of a table until they are joined."""


def _service(name: str, column: str, base: int, length: int) -> Message:
    signal = Signal(column, 0, 8 * length, True, 1, "", 0, 0, None, name, 0, 0)
    return Message("emcy", 0, name, base, length, (signal,), (), True, 255, 0)


SERVICES = (_service("EMCY", EMCY, EMCY_BASE, EMCY_LENGTH), _service("Heartbeat", STATE, HEARTBEAT_BASE, 1))


def joins(signals: Iterable[str] | None) -> bool:
    """Whether bits of 2124h are among the signals; None: all signals."""
    return signals is None or any(name in NAMES for name in signals)


class HealthRows:
    """Joins table after table. ``asked``: the signals shown (None: all). Before the first: ``told``, (faults, seen) by
    key, and ``sampled``, the keys of the nodes with samples."""

    def __init__(
        self, asked: tuple[str, ...] | None, told: Mapping[int, tuple[int, int]] | None = None,
        sampled: Iterable[int] = (),
    ) -> None:  # fmt: skip
        self._asked, self._health = asked, Health(told)
        self._rows = 0
        self.sampled = dict.fromkeys(sampled)

    @property
    def told(self) -> dict[int, tuple[int, int]]:
        """(faults, seen) by key now."""
        return {key: self._health.now(key) for key in self._health.nodes}

    def unseen(self, channels: Sequence[str]) -> list[tuple[str, int]]:
        """Channel and node-id of the nodes with samples of which nothing told any of bits 12 to 15."""
        return sorted(place_of(channels, key) for key in self.sampled if not self._health.now(key)[1] & reasons.JUDGED)

    def joined(self, table: Table) -> Table:
        """The table with the columns of 2124h in all rows where they are known, and without rows of other messages."""
        place = self._rows + np.arange(len(table))
        self._rows += len(table)
        service = self._take(table, place)
        self.sampled |= dict.fromkeys(occurring(table.key[~service & (table.counter != NO_COUNTER)]))
        if self._health.nodes:
            table = self._with_faults(table, place)
        if not service.any() and EMCY not in table.values and STATE not in table.values:
            return table
        rows = table.take(np.flatnonzero(~service))
        columns = [column for column in rows.columns if column.name not in (EMCY, STATE)]
        return rows.of_columns(columns, rows.values, rows.absent)

    def _with_faults(self, table: Table, place: IntArray) -> Table:
        faults, seen = np.zeros(len(table), dtype=np.int64), np.zeros(len(table), dtype=np.int64)
        for key in occurring(table.key):
            rows = np.flatnonzero(table.key == key)
            faults[rows], seen[rows] = self._health.at(key, place[rows])
        columns, values, absent = {column.name: column for column in table.columns}, {**table.values}, {**table.absent}
        some = int(np.bitwise_or.reduce(seen))
        for name, bit in NAMES.items():
            if some >> bit & 1 and (self._asked is None or name in self._asked):
                known = seen >> bit & 1 == 1
                columns.setdefault(name, flag(name))
                values[name] = np.where(known, faults >> bit & 1, NO_FLAG).astype(np.int8)
                absent[name] = ~known
        return table.of_columns(in_order(columns.values(), self._asked), values, absent)

    def _take(self, table: Table, place: IntArray) -> BoolArray:
        """Take what the rows tell; return (k,) the rows of EMCY and heartbeats."""
        values, none = table.values, np.zeros(len(table), dtype=np.bool_)
        emcy, state = (values[name] != NO_INTEGER if name in values else none for name in (EMCY, STATE))
        told, mask, faults = none, 0, faults_of(values, len(table))
        for name, bit in NAMES.items():
            if name in values:
                told, mask = told | (values[name] != NO_FLAG), mask | 1 << bit
        for row in np.flatnonzero(emcy | state | told).tolist():
            key, time = int(table.key[row]), int(place[row])
            if emcy[row] or state[row]:
                name, base, length = (EMCY, EMCY_BASE, EMCY_LENGTH) if emcy[row] else (STATE, HEARTBEAT_BASE, 1)
                data = int(values[name][row]).to_bytes(8, "little", signed=True)[:length]
                self._health.service(key, time, base, data)
            else:
                self._health.pdo(key, time, int(faults[row]), mask)
        return emcy | state
