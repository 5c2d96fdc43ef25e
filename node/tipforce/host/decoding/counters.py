"""Frames and lost samples per message, and the sample counters of consecutive tables unwrapped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import IntArray
from tipforce.host.decoding.decoder import Samples, lost_samples, unwrap_counter
from tipforce.host.decoding.health_rows import with_channel
from tipforce.host.decoding.sample_rule import COUNTER, follows_sync
from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Table
from tipforce.host.decoding.sync_modulus import SAMPLES

Place = tuple[str, int, str]
"""Channel, node-id, message name."""
TallyRow = tuple[str, int, str, int, int | None, int | None, int | None, int, int]
"""A place and the fields of its MessageCount."""


@dataclass(slots=True)
class MessageCount:
    """Frames of one message, and the samples lost between them (None: its PDO does not follow SYNC)."""

    frames: int = 0
    lost: int | None = None
    first: int | None = None
    last: int | None = None
    moduli: tuple[int, int] = (SAMPLES, SAMPLES)
    """Of the first and of the last counter."""

    def add(self, frames: int, counter: npt.NDArray[np.uint8] | None, modulus: int) -> None:
        """Count frames with their counters, of ``modulus``; None if their counter cannot show losses."""
        self.frames += frames
        if counter is not None and modulus != SAMPLES:
            counter = counter[counter > 0]  # 0 is no SYNC's latch, see lost_samples
        if counter is None or not len(counter):
            return
        inside = 0 if (np.diff(counter) == 1).all() else lost_samples(counter, modulus)
        self._join(int(counter[0]), int(counter[-1]), inside, (modulus, modulus))

    def append(self, other: MessageCount) -> None:
        """Add the count of the next part."""
        self.frames += other.frames
        if other.first is None:
            return
        assert other.last is not None
        self._join(other.first, other.last, other.lost or 0, other.moduli)

    def _join(self, first: int, last: int, lost: int, moduli: tuple[int, int]) -> None:
        """Add counters from ``first`` to ``last``; where the modulus is another one the count begins again."""
        if self.last is not None and self.moduli[1] == moduli[0]:
            lost += lost_samples([self.last, first], moduli[0])
        self.lost = (self.lost or 0) + lost
        self.moduli = (moduli[0] if self.first is None else self.moduli[0]), moduli[1]
        self.first = first if self.first is None else self.first
        self.last = last


@dataclass(slots=True)
class Tally:
    """``messages`` by place; ``short`` frames that were shorter than their mapping."""

    messages: dict[Place, MessageCount] = field(default_factory=dict)
    short: dict[Place, int] = field(default_factory=dict)

    def add(self, place: Place, frames: int, counter: npt.NDArray[Any] | None, modulus: int) -> None:
        """Count frames and their counters, of ``modulus`` (``SyncModulus``); None if these cannot show losses."""
        self.messages.setdefault(place, MessageCount()).add(frames, counter, modulus)

    def add_samples(self, samples: Samples, modulus: int) -> None:
        """Count the samples of a bus."""
        cyclic = COUNTER in samples.columns and follows_sync(samples.message)
        place = "", samples.node_id, samples.message.name
        self.add(place, len(samples.row), samples.columns[COUNTER] if cyclic else None, modulus)

    def append(self, other: Tally) -> None:
        """Add the counts of the next part."""
        for place, count in other.messages.items():
            self.messages.setdefault(place, MessageCount()).append(count)
        for place, frames in other.short.items():
            self.short[place] = self.short.get(place, 0) + frames

    def rows(self) -> tuple[list[TallyRow], list[tuple[str, int, str, int]]]:
        """Return both counts as rows."""
        rows = [
            (*place, count.frames, count.lost, count.first, count.last, *count.moduli)
            for place, count in self.messages.items()
        ]
        return rows, [(*place, frames) for place, frames in self.short.items()]

    def set_rows(self, messages: Iterable[TallyRow], short: Iterable[tuple[str, int, str, int]]) -> None:
        """Set both counts from ``rows``."""
        for channel, node, name, frames, lost, first, last, *moduli in messages:
            self.messages[channel, node, name] = MessageCount(frames, lost, first, last, (moduli[0], moduli[1]))
        self.short |= {(channel, node, name): frames for channel, node, name, frames in short}

    def lost(self) -> dict[tuple[str, int], int]:
        """Return lost samples by channel and node: the maximum over its messages, which have one counter."""
        found: dict[tuple[str, int], int] = {}
        for (channel, node, _), count in self.messages.items():
            if count.lost is not None:
                found[channel, node] = max(found.get((channel, node), 0), count.lost)
        return found


class Counters:
    """Unwrap the counters of consecutive tables."""

    def __init__(self, last: Mapping[int, tuple[int, int]] | None = None) -> None:
        """``last``: by key, unwrapped and as sent."""
        self.last = dict(last or {})
        self.first: dict[int, tuple[int, int]] = {}
        """By key as sent, and its modulus, where ``last`` had none."""

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
            counter[rows] = self._of_node(of, table.counter[rows], table.cyclic[rows], modulus_of(table, of))
        return replace(table, counter=counter)

    def skip(
        self, first: Mapping[int, tuple[int, int]], last: Mapping[int, tuple[int, int]], numbers: Sequence[int]
    ) -> None:
        """Take ``first`` and ``last`` of a part that was unwrapped by itself; ``numbers``: of its channels here."""
        for key, (unwrapped, sent) in last.items():
            place, (begun, modulus) = with_channel(key, numbers), first[key]
            before = self.last.get(place)
            shift = 0 if before is None else before[0] + (begun - before[1]) % modulus - begun
            self.last[place] = unwrapped + shift, sent

    def _of_node(
        self, key: int, raw: npt.NDArray[np.int64], cyclic: npt.NDArray[np.bool_], modulus: int
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
                self.first[key] = int(steady[0]), modulus
        if len(steady) < len(raw):
            event: IntArray = np.flatnonzero(~cyclic & (raw != NO_COUNTER))
            before = np.cumsum(cyclic)[event]
            known = np.concatenate(([-1 if last is None else last[0]], counts))[before]
            sent = np.concatenate(([0 if last is None else last[1]], steady))[before]
            nowhere = np.zeros(len(event), dtype=np.bool_) if last is not None else before == 0
            found[event] = np.where(nowhere, raw[event], _nearest(known, sent, raw[event], modulus))
        return found


def modulus_of(table: Table, key: int) -> int:
    """Return the modulus of a node's counters."""
    return dict(table.moduli).get(table.channels[key >> NODE_BITS], SAMPLES) if table.moduli else SAMPLES


def _nearest(known: Any, sent: Any, counter: Any, modulus: int) -> Any:
    """Return the count nearest to ``known``, which was ``sent`` so."""
    half = modulus // 2
    return known + (counter - sent + half) % modulus - half
