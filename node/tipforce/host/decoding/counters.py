"""Unwrap the sample counters of consecutive tables, also of a part whose tables come before the ones in front of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.decoder import unwrap_counter
from tipforce.host.decoding.health_rows import with_channel
from tipforce.host.decoding.sample_rows import IntArray
from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Table
from tipforce.host.decoding.sync_modulus import SAMPLES


@dataclass(slots=True)
class PartCounters:
    """Counters of a part by key: (as sent, modulus) of the first, (unwrapped from it, as sent) of the last."""

    first: dict[int, tuple[int, int]] = field(default_factory=dict)
    last: dict[int, tuple[int, int]] = field(default_factory=dict)


class Counters:
    """Unwrap the counters of consecutive tables."""

    def __init__(self, last: Mapping[int, tuple[int, int]] | None = None) -> None:
        """``last``: by key, unwrapped and as sent."""
        self.last = dict(last or {})
        self._first: dict[int, tuple[int, int]] = {}
        self._early: list[IntArray] = []

    def unwrapped(self, table: Table) -> Table:
        """Return the table with each node's counter continued from its first value.

        An event-driven PDO in its own row belongs to the last latch: it gets the nearest count. Before
        the first PDO that follows SYNC its counter is unchanged.
        """
        counter = table.counter.copy()
        order = np.argsort(table.key, kind="stable")
        key = table.key[order]
        for rows in np.split(order, np.flatnonzero(key[1:] != key[:-1]) + 1) if len(key) else []:
            of = int(table.key[rows[0]])
            counter[rows] = self._of_node(of, table.counter[rows], table.cyclic[rows], modulus_of(table, of), rows)
        return replace(table, counter=counter)

    def unwrapped_apart(self, table: Table) -> tuple[Table, IntArray]:
        """Return the table unwrapped from the start of the part, and its rows that belong to a latch before that."""
        self._early = []
        found = self.unwrapped(table)
        return found, np.concatenate(self._early) if self._early else np.zeros(0, dtype=np.intp)

    def part(self) -> PartCounters:
        """Return the counters of all tables so far as those of one part."""
        return PartCounters(self._first, self.last)

    def shift(self, part: PartCounters, numbers: Sequence[int]) -> npt.NDArray[np.int64]:
        """Return by the part's keys what continues its counters from the last ones here."""
        found = np.zeros(max(part.first, default=0) + 1, dtype=np.int64)
        for key, (sent, modulus) in part.first.items():
            last = self.last.get(with_channel(key, numbers))
            if last is not None:
                found[key] = last[0] + (sent - last[1]) % modulus - sent
        return found

    def continued(self, table: Table, early: IntArray, shift: npt.NDArray[np.int64], numbers: Sequence[int]) -> Table:
        """Return a table from ``unwrapped_apart`` with the counters that continue the last ones here."""
        counter = table.counter.copy()
        moved = np.flatnonzero((counter != NO_COUNTER) & (table.key < len(shift)))
        counter[moved] += shift[table.key[moved]]
        for row in early.tolist():
            key, sent = int(table.key[row]), int(table.counter[row])
            last = self.last.get(with_channel(key, numbers))
            counter[row] = sent if last is None else _nearest(last[0], last[1], sent, modulus_of(table, key))
        return replace(table, counter=counter)

    def skip(self, part: PartCounters, numbers: Sequence[int]) -> None:
        """Take the counters of a part as the last ones."""
        shift = self.shift(part, numbers)
        for key, (unwrapped, sent) in part.last.items():
            self.last[with_channel(key, numbers)] = unwrapped + int(shift[key]), sent

    def _of_node(
        self, key: int, raw: npt.NDArray[np.int64], cyclic: npt.NDArray[np.bool_], modulus: int, rows: IntArray
    ) -> npt.NDArray[np.int64]:
        last = self.last.get(key)
        steady = raw[cyclic]
        found = raw.copy()
        counts = np.zeros(0, dtype=np.int64)
        if len(steady):
            seed = steady[:0] if last is None else np.array([last[1]])
            counts = unwrap_counter(np.concatenate((seed, steady)), modulus)
            counts += 0 if last is None else last[0] - last[1]
            counts = counts[len(seed) :]
            found[cyclic] = counts
            self.last[key] = int(counts[-1]), int(steady[-1])
            if last is None:
                self._first[key] = int(steady[0]), modulus
        if len(steady) < len(raw):
            event: IntArray = np.flatnonzero(~cyclic & (raw != NO_COUNTER))
            before = np.cumsum(cyclic)[event]
            known = np.concatenate(([-1 if last is None else last[0]], counts))[before]
            sent = np.concatenate(([0 if last is None else last[1]], steady))[before]
            nowhere = np.zeros(len(event), dtype=np.bool_) if last is not None else before == 0
            self._early.append(rows[event[nowhere]])
            found[event] = np.where(nowhere, raw[event], _nearest(known, sent, raw[event], modulus))
        return found


def modulus_of(table: Table, key: int) -> int:
    """Return the modulus of a node's counters."""
    return dict(table.moduli).get(table.channels[key >> NODE_BITS], SAMPLES) if table.moduli else SAMPLES


def _nearest(known: Any, sent: Any, counter: Any, modulus: int) -> Any:
    """Return the count nearest to ``known``, which was ``sent`` so."""
    half = modulus // 2
    return known + (counter - sent + half) % modulus - half
