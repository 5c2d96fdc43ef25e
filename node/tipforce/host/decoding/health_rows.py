"""Join the faults of a node (2124h) to its samples: from TPDO4, EMCY and boot-ups, in the order of the log."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from tipforce.arrays import BoolArray, IntArray
from tipforce.device.codes import EMCY_BASE, HEARTBEAT_BASE, INITIALISING, NODE_ID_MASK
from tipforce.dictionary.signals import Message, Signal
from tipforce.host.decoding import status_words
from tipforce.host.decoding.health import EMCY_LENGTH, NAMES, Health
from tipforce.host.decoding.sample_table import (
    NO_COUNTER,
    NO_FLAG,
    NO_INTEGER,
    NODE_BITS,
    Table,
    Values,
    flag,
    in_order,
)

EMCY, STATE = "emcy", "nmt_state"
"""Columns of the messages below, which become rows of a table until they are joined."""


def _service(name: str, column: str, base: int, length: int) -> Message:
    signal = Signal(column, 0, 8 * length, True, 1, "", 0, 0, None, name, 0, 0)
    return Message("emcy", 0, name, base, length, (signal,), (), True, 255, 0)


SERVICES = (_service("EMCY", EMCY, EMCY_BASE, EMCY_LENGTH), _service("Heartbeat", STATE, HEARTBEAT_BASE, 1))


def joins(signals: Iterable[str] | None) -> bool:
    """Whether bits of 2124h are among the signals; None: all signals."""
    return signals is None or any(name in NAMES for name in signals)


def with_services(signals: tuple[str, ...] | None) -> tuple[str, ...] | None:
    """The signals to decode where these are asked for."""
    return signals if signals is None or not joins(signals) else (*signals, EMCY, STATE)


class HealthRows:
    """Joins table after table. ``asked``: the signals that are shown; None: all."""

    def __init__(self, asked: tuple[str, ...] | None = None) -> None:
        self._asked = asked
        self._health = Health()
        self._rows = 0
        self._sampled: dict[int, tuple[str, int]] = {}

    @property
    def unseen(self) -> list[tuple[str, int]]:
        """Channel and node-id of the nodes with samples of which nothing told any of bits 12 to 15."""
        seen = {key for key in self._health.nodes if self._health.now(key)[1] & status_words.JUDGED}
        return sorted(place for key, place in self._sampled.items() if key not in seen)

    def joined(self, table: Table) -> Table:
        """The table with the columns of 2124h in all rows where they are known, and without rows of other messages."""
        place = self._rows + np.arange(len(table))
        self._rows += len(table)
        service = self._take(table, place)
        keys = np.unique(table.key[~service & (table.counter != NO_COUNTER)]).tolist()
        self._sampled |= {key: (table.channels[key >> NODE_BITS], key & ((1 << NODE_BITS) - 1)) for key in keys}
        if self._health.nodes:
            table = self._with_faults(table, place)
        if not service.any() and EMCY not in table.values and STATE not in table.values:
            return table
        found = table.take(np.flatnonzero(~service))
        columns = tuple(column for column in found.columns if column.name not in (EMCY, STATE))
        values = {column.name: found.values[column.name] for column in columns}
        absent = {name: rows for name, rows in found.absent.items() if name in values and rows.any()}
        return replace(found, columns=columns, values=values, absent=absent)

    def _take(self, table: Table, place: IntArray) -> BoolArray:
        """Take what the rows tell; (k,): the rows of EMCY and heartbeats."""
        values, none = table.values, np.zeros(len(table), dtype=np.bool_)
        emcy = none if EMCY not in values else values[EMCY] != NO_INTEGER
        state = none if STATE not in values else values[STATE] != NO_INTEGER
        names = [name for name in NAMES if name in values]
        told = none if not names else np.logical_or.reduce([values[name] != NO_FLAG for name in names])
        mask = sum(1 << NAMES[name] for name in names)
        for row in np.flatnonzero(emcy | state | told).tolist():
            key, time = int(table.key[row]), int(place[row])
            if emcy[row]:
                self._health.emcy(key, time, int(values[EMCY][row]).to_bytes(EMCY_LENGTH, "little", signed=True))
            elif state[row]:
                if int(values[STATE][row]) & NODE_ID_MASK == INITIALISING:
                    self._health.boot(key, time)
            else:
                faults = sum(1 << NAMES[name] for name in names if values[name][row] == 1)
                self._health.pdo(key, time, faults, mask)
        return emcy | state

    def _with_faults(self, table: Table, place: IntArray) -> Table:
        faults, seen = np.zeros(len(table), dtype=np.int64), np.zeros(len(table), dtype=np.int64)
        for key in np.unique(table.key).tolist():
            rows = np.flatnonzero(table.key == key)
            faults[rows], seen[rows] = self._health.at(key, place[rows])
        some = int(np.bitwise_or.reduce(seen)) if len(seen) else 0
        new: dict[str, Values] = {}
        absent = dict(table.absent)
        for name, bit in NAMES.items():
            if not some >> bit & 1 or (self._asked is not None and name not in self._asked):
                continue
            known = seen >> bit & 1 == 1
            new[name] = np.where(known, faults >> bit & 1, NO_FLAG).astype(np.int8)
            absent[name] = ~known
        columns = {column.name: column for column in table.columns}
        columns |= {name: flag(name) for name in new if name not in columns}
        absent = {name: rows for name, rows in absent.items() if rows.any()}
        ordered = in_order(columns.values(), self._asked)
        return replace(table, columns=ordered, values={**table.values, **new}, absent=absent)
