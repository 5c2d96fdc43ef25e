"""Decode one part of a recording before the parts in front of it are known, and complete its rows once they are.

A part cannot know: rows that are open at its edges, where the counters of its nodes continue, the modulus of these
counters, and which faults of 2124h are set. So its first frames, the head, only bring the decoder into the state that
it would have there, and are decoded again after the parts in front. Where that ends in the same state, the rows behind
the head are right; they still get their counters and faults. Otherwise the whole part is decoded again.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tipforce.host.decoding.counters import Counters, Tally
from tipforce.host.decoding.duplicates import services
from tipforce.host.decoding.health_rows import Change, HealthChanges
from tipforce.host.decoding.log_part import Notes, Piece, Progress, Reading, Source
from tipforce.host.decoding.recording import Recording, State
from tipforce.host.decoding.sample_merger import OpenRows, SampleMerger
from tipforce.host.decoding.sample_rule import GAP_FRAMES, GAP_NS
from tipforce.host.decoding.sample_table import Column, Table
from tipforce.host.frames.frame_array import FrameArray

_STEP_FRAMES = 2048  # by which a head grows
_HEAD_NS, _HEAD_FRAMES = 5 * GAP_NS, 5 * GAP_FRAMES  # in either a row of a few PDOs ends, and the wait for the next
_IN_MEMORY_BYTES = 100_000_000
"""Of the rows of one part; more are kept in a temporary file."""


@dataclass(slots=True)
class Ends:
    """What the other parts of a recording need to know of one. Channels are numbered as in ``channels``."""

    channels: tuple[str, ...]
    notes: Notes
    head: FrameArray | None = None
    """Its first frames; None for a part that is too short: decode it after the others."""
    behind_head: OpenRows = field(default_factory=OpenRows.none)
    tail: OpenRows = field(default_factory=OpenRows.none)
    timed: bool = True
    """Up to the end of the head."""
    tally: Tally = field(default_factory=Tally)
    """Of what follows the head, as all below."""
    counters: tuple[dict[int, tuple[int, int]], dict[int, tuple[int, int]]] = field(default_factory=lambda: ({}, {}))
    """``Counters.first`` and ``last``."""
    health: dict[int, Change] = field(default_factory=dict)
    sampled: set[int] = field(default_factory=set)
    """Keys of samples."""
    keys: set[int] = field(default_factory=set)
    """Of all rows."""
    columns: tuple[Column, ...] = ()
    services: list[FrameArray] = field(default_factory=list)
    """All frames that ``BusEvents`` looks at."""


class DecodedPart:
    """A part whose rows wait for the ``State`` of the recording in front of it."""

    def __init__(self, piece: Piece, reading: Reading, progress: Progress | None = None) -> None:
        """Read and decode it. Raises InputError for a log that can't be read, StrictError for a bad line."""
        self._reading = reading
        self._kept = _Kept()
        source = Source(piece, reading, progress)
        merger = SampleMerger(reading.decoder, source.channels, reading.wanted)
        counters, health, columns = Counters(), HealthChanges(), dict[str, Column]()
        self.ends = ends = Ends((), source.notes)
        head: list[FrameArray] = []
        for block in source:
            ends.services.append(services(block))
            merger.channels, merger.timed = source.channels, source.log.timed
            rest = block
            while ends.head is None and len(rest):
                head.append(rest[:_STEP_FRAMES])
                rest = rest[_STEP_FRAMES:]
                for _ in merger.tables(head[-1]):
                    pass
                if _is_long(head) and merger.sync.settled:
                    ends.head, ends.behind_head, ends.timed = np.concatenate(head), merger.open, merger.timed
                    merger.tally = ends.tally
            for table in merger.tables(rest) if len(rest) else ():
                columns |= {column.name: column for column in table.columns}
                health.take(table)
                ends.keys.update(np.flatnonzero(np.bincount(table.key)).tolist())
                counters.unwrapped(table)
                self._kept.add(table)
        ends.channels, ends.tail = tuple(source.channels), merger.open
        ends.counters, ends.columns = (counters.first, counters.last), tuple(columns.values())
        ends.health, ends.sampled = health.found, health.sampled

    def rows(self, state: State, *, last: bool = False) -> Iterator[Table]:
        """Yield all rows that begin in this part, in order; ``last``: the recording ends with it."""
        yield from Recording(self._reading, state).rows_of_part(self.ends, self._kept, last=last)


def _is_long(head: list[FrameArray]) -> bool:
    """Return whether no row behind a head depends on what is in front of it."""
    return head[-1]["t_ns"][-1] - head[0]["t_ns"][0] > _HEAD_NS or sum(map(len, head)) > _HEAD_FRAMES


class _Kept:
    """Tables in order: the first in memory, the others in a temporary file."""

    def __init__(self) -> None:
        self._first: list[Table] = []
        self._bytes = 0
        self._file: Any = None

    def add(self, table: Table) -> None:
        """Append a table."""
        self._bytes += table.t_ns.nbytes + sum(column.nbytes for column in table.values.values())
        if self._bytes < _IN_MEMORY_BYTES:
            self._first.append(table)
            return
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed after the last row
        pickle.dump(table, self._file, protocol=5)

    def __iter__(self) -> Iterator[Table]:
        """Yield the tables."""
        yield from self._first
        if self._file is not None:
            self._file.seek(0)
            with suppress(EOFError):
                while True:
                    yield pickle.load(self._file)

    def __del__(self) -> None:
        if self._file is not None:
            self._file.close()

    def __getstate__(self) -> list[Table]:
        """Return all tables: a cluster moved the part to another worker."""
        return [*self]

    def __setstate__(self, state: list[Table]) -> None:
        self.__init__()  # type: ignore[misc]
        for table in state:
            self.add(table)
