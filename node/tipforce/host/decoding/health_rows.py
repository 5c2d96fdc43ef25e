"""Join the faults of a node (2124h) to its samples: from TPDO4, EMCY and boot-ups, in the order of the log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from canopen_device.core.codes import EMCY_BASE, HEARTBEAT_BASE, INITIALISING, NODE_ID_MASK
from tipforce.arrays import BoolArray, IntArray, occurring
from tipforce.dictionary.signals import Message, Signal
from tipforce.host.decoding.health import ALL, EMCY_LENGTH, NAMES, Health
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
from tipforce.samples import reasons

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
    """Joins table after table. ``asked``: the signals that are shown; None: all.

    ``told``: (faults, seen) by key before the first table.
    """

    def __init__(self, asked: tuple[str, ...] | None = None, told: Mapping[int, tuple[int, int]] | None = None) -> None:
        self._asked = asked
        self._health = Health(told)
        self._rows = 0
        self.sampled: dict[int, tuple[str, int]] = {}

    @property
    def told(self) -> dict[int, tuple[int, int]]:
        """(faults, seen) by key now."""
        return {key: self._health.now(key) for key in self._health.nodes}

    def skip(
        self, changes: Mapping[int, Change], sampled: Iterable[int], numbers: Sequence[int], channels: Sequence[str]
    ) -> None:
        """Take what the tables of a part tell, whose channels have these ``numbers`` here."""
        for key, change in changes.items():
            mine = with_channel(key, numbers)
            self._health.set(mine, *change.after(*self._health.now(mine)))
        for key in sampled:
            mine = with_channel(key, numbers)
            self.sampled[mine] = channels[mine >> NODE_BITS], mine & ((1 << NODE_BITS) - 1)

    @property
    def unseen(self) -> list[tuple[str, int]]:
        """Channel and node-id of the nodes with samples of which nothing told any of bits 12 to 15."""
        seen = {key for key in self._health.nodes if self._health.now(key)[1] & reasons.JUDGED}
        return sorted(place for key, place in self.sampled.items() if key not in seen)

    def joined(self, table: Table) -> Table:
        """The table with the columns of 2124h in all rows where they are known, and without rows of other messages."""
        place = self._rows + np.arange(len(table))
        self._rows += len(table)
        service = _take(table, place, (self._health,))
        for key in _sampled_keys(table, service):
            self.sampled[key] = table.channels[key >> NODE_BITS], key & ((1 << NODE_BITS) - 1)
        if self._health.nodes:
            table = self._with_faults(table, place)
        if not service.any() and EMCY not in table.values and STATE not in table.values:
            return table
        found = table.take(np.flatnonzero(~service))
        columns = tuple(column for column in found.columns if column.name not in (EMCY, STATE))
        values = {column.name: found.values[column.name] for column in columns}
        absent = {name: rows for name, rows in found.absent.items() if name in values and rows.any()}
        return replace(found, columns=columns, values=values, absent=absent)

    def _with_faults(self, table: Table, place: IntArray) -> Table:
        faults, seen = np.zeros(len(table), dtype=np.int64), np.zeros(len(table), dtype=np.int64)
        for key in occurring(table.key):
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


class Change(NamedTuple):
    """(faults, seen) after messages where no bit was set before them, and where all were."""

    from_none: tuple[int, int]
    from_all: tuple[int, int]
    seen_ever: int
    """Bits told by any of them."""

    def after(self, faults: int, seen: int) -> tuple[int, int]:
        """Return (faults, seen) after the messages, by those before them: each message acts on single bits."""
        return self.from_none[0] | faults & self.from_all[0], self.from_none[1] | seen & self.from_all[1]


class HealthChanges:
    """What the tables of a part do to an unknown state before them."""

    def __init__(self) -> None:
        self._from = Health(), Health(unknown=(ALL, ALL))
        self._ever: dict[int, int] = {}
        self._rows = 0
        self.sampled: set[int] = set()

    def take(self, table: Table) -> None:
        """Take the messages of the next table."""
        place = self._rows + np.arange(len(table))
        self._rows += len(table)
        service = _take(table, place, self._from)
        self.sampled.update(_sampled_keys(table, service))
        nothing = self._from[0]
        for key in nothing.nodes:
            rows = place[table.key == key]
            if len(rows):
                seen = nothing.at(key, rows)[1]
                self._ever[key] = self._ever.get(key, 0) | int(np.bitwise_or.reduce(seen))

    @property
    def found(self) -> dict[int, Change]:
        """By key the change over all tables."""
        nothing, everything = self._from
        keys = {*nothing.nodes, *everything.nodes}
        return {key: Change(nothing.now(key), everything.now(key), self._ever.get(key, 0)) for key in keys}


def _sampled_keys(table: Table, service: BoolArray) -> list[int]:
    return occurring(table.key[~service & (table.counter != NO_COUNTER)])


def _take(table: Table, place: IntArray, healths: Sequence[Health]) -> BoolArray:
    """Tell each of ``healths`` what the rows tell; (k,): the rows of EMCY and heartbeats."""
    values, none = table.values, np.zeros(len(table), dtype=np.bool_)
    emcy = none if EMCY not in values else values[EMCY] != NO_INTEGER
    state = none if STATE not in values else values[STATE] != NO_INTEGER
    names = [name for name in NAMES if name in values]
    told = none if not names else np.logical_or.reduce([values[name] != NO_FLAG for name in names])
    mask = sum(1 << NAMES[name] for name in names)
    for row in np.flatnonzero(emcy | state | told).tolist():
        key, time = int(table.key[row]), int(place[row])
        for health in healths:
            if emcy[row]:
                health.emcy(key, time, int(values[EMCY][row]).to_bytes(EMCY_LENGTH, "little", signed=True))
            elif state[row]:
                if int(values[STATE][row]) & NODE_ID_MASK == INITIALISING:
                    health.boot(key, time)
            else:
                faults = sum(1 << NAMES[name] for name in names if values[name][row] == 1)
                health.pdo(key, time, faults, mask)
    return emcy | state


def with_channel(key: int, numbers: Sequence[int]) -> int:
    """Return the key of the same node where its channel has another number."""
    return numbers[key >> NODE_BITS] << NODE_BITS | key & ((1 << NODE_BITS) - 1)
