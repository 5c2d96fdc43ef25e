"""Decode one part of a recording before the parts in front of it are known, and complete its rows once they are.

A part cannot know: rows that are open at its edges, where the counters of its nodes continue, the modulus of these
counters, and which faults of 2124h are set. ``Ends`` is all that ``Recording.follow`` needs to tell it (``Start``).
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import SYNC_COB_ID
from tipforce.host.decoding.counters import Counters, Tally
from tipforce.host.decoding.health_rows import Change, HealthChanges, HealthRows
from tipforce.host.decoding.log_part import Notes, Piece, Progress, Reading, Source
from tipforce.host.decoding.sample_merger import GAP_FRAMES, GAP_NS, Looked, SampleMerger
from tipforce.host.decoding.sample_table import NODE_BITS, Column, Table
from tipforce.host.decoding.services import BusEvent
from tipforce.host.decoding.sync_modulus import Syncs
from tipforce.host.frames.frame_array import FrameArray

_HEAD_FRAMES = 8 * GAP_FRAMES  # holds every row that can depend on the preceding part
_HEAD_NS = 8 * GAP_NS  # the same in time, where clocks do not step back
_IN_MEMORY_BYTES = 100_000_000
"""Of the rows of one part; more are kept in a temporary file."""


class Edge(NamedTuple):
    """Frames at an end of a part, with their numbers: from its first decodable frame, or back from its end."""

    frames: FrameArray
    number: npt.NDArray[np.int64]


@dataclass(slots=True)
class Ends:
    """What the other parts of a recording need to know of one. Channels are numbered as in ``channels``."""

    channels: tuple[str, ...]
    tally: Tally
    notes: Notes
    separable: bool = False
    """False for a part that is too short, or whose start has no steady numbers of SYNC: decode it after the others."""
    head: Edge | None = None
    tail: Edge | None = None
    looked: list[Looked] = field(default_factory=list)
    """SYNCs of the head, and of what follows it, with the moduli as the part knew them."""
    counters: tuple[dict[int, tuple[int, int]], dict[int, tuple[int, int]]] = field(default_factory=lambda: ({}, {}))
    """``Counters.first`` and ``last``."""
    health: dict[int, Change] = field(default_factory=dict)
    sampled: set[int] = field(default_factory=set)
    """Keys of samples."""
    keys: set[int] = field(default_factory=set)
    """Of all rows."""
    columns: tuple[Column, ...] = ()
    rows: int = 0


@dataclass(slots=True)
class Start:
    """What the parts before one tell it. Channels are numbered as in ``channels``."""

    channels: tuple[str, ...]
    numbers: list[int]
    """Of the part's own channels."""
    counters: dict[int, tuple[int, int]]
    health: dict[int, tuple[int, int]]
    timed: bool
    before: list[Table]
    """Rows across the border to the part before, complete."""
    after: list[Table]
    """Rows that are open at the end of the last part, complete."""
    events: list[BusEvent]


class DecodedPart:
    """A part whose rows wait for their ``Start``."""

    def __init__(self, piece: Piece, reading: Reading, progress: Progress | None = None) -> None:
        """Read and decode it. Raises InputError for a log that can't be read, StrictError for a bad line."""
        self._asked = reading.signals
        work = _Decoding(piece, reading, progress)
        self.ends, self._kept = work.ends, work.kept

    def rows(self, start: Start) -> Iterator[Table]:
        """Yield all rows that begin in this part, in order."""
        yield from start.before
        counters, health = Counters(start.counters), HealthRows(self._asked, start.health)
        for table in self._kept:
            whole = counters.unwrapped(renamed(table, start.numbers, start.channels))
            joined = health.joined(whole if start.timed else replace(whole, timed=False))
            if len(joined):
                yield joined
        yield from start.after


class _Decoding:
    """The decoding of a part: its ``ends``, and the rows ``kept``."""

    def __init__(self, piece: Piece, reading: Reading, progress: Progress | None) -> None:
        self._source = Source(piece, reading, progress)
        self._merger = SampleMerger(reading.decoder, self._source.channels, reading.wanted)
        self.kept = _Kept()
        self._counters, self._health = Counters(), HealthChanges()
        self._columns: dict[str, Column] = {}
        self.ends = Ends(tuple(self._source.channels), self._merger.tally, self._source.notes)
        blocks = iter(self._source)
        begun = self._begin(blocks)
        if begun is not None:
            self._decode(*begun, blocks)

    def _begin(self, blocks: Iterator[FrameArray]) -> tuple[FrameArray, FrameArray] | None:
        """Return the frames that hold the head, and those behind it that were read too.

        None if they are too few, or if SYNCs among them change.
        """
        found, count, syncs = list[FrameArray](), 0, list[Syncs]()
        for block in blocks:
            self._merger.channels = self._source.channels
            near = _near(block) if not found else len(block)
            begun, rest = block[:near], block[near:]
            looked = self._merger.sync.look(begun)
            if _changes(begun, looked, syncs):
                return None
            syncs += looked
            found.append(self._merger.decodable(begun))
            count += len(found[-1])
            if len(rest) or count > _HEAD_FRAMES:
                self.ends.looked = self._merger.looked = [(syncs, dict(self._merger.sync.of))]
                return np.concatenate(found), rest
        return None

    def _decode(self, begun: FrameArray, behind: FrameArray, blocks: Iterator[FrameArray]) -> None:
        merger, ends = self._merger, self.ends
        frames, early = merger.head(begun)
        ends.head = Edge(frames[early], np.flatnonzero(early))
        self._keep(merger.add(frames[~early], number=np.flatnonzero(~early)))
        merger.skip(len(frames))
        for block in chain((behind,), blocks):
            merger.channels = self._source.channels
            merger.timed = self._source.log.timed
            for table in merger.tables(block):
                self._keep(table)
        ends.tail = Edge(*merger.held)
        ends.counters = self._counters.first, self._counters.last
        ends.health, ends.sampled = self._health.found, self._health.sampled
        ends.columns, ends.rows = tuple(self._columns.values()), self.kept.rows
        ends.channels, ends.tally, ends.separable = tuple(self._source.channels), merger.tally, True

    def _keep(self, table: Table | None) -> None:
        if table is not None:
            self._columns |= {column.name: column for column in table.columns}
            self._health.take(table)
            self.ends.keys.update(np.flatnonzero(np.bincount(table.key)).tolist())
            self._counters.unwrapped(table)
            self.kept.add(table)


def _near(block: FrameArray) -> int:
    """Return how many frames hold every row that can depend on the preceding part, by their times; or all."""
    t_ns = block["t_ns"]
    if t_ns[-1] - t_ns[0] <= _HEAD_NS or (np.diff(t_ns) < 0).any():
        return len(block)
    return int(np.searchsorted(t_ns, t_ns[0] + _HEAD_NS, side="right")) + 1


def _changes(block: FrameArray, looked: Iterable[Syncs], before: Iterable[Syncs]) -> bool:
    """Return whether some SYNCs of a channel carry numbers and others do not."""
    kinds: dict[int, bool] = {seen.channel: seen.numbered for seen in before}
    for seen in looked:
        mine = block[(block["can_id"] == SYNC_COB_ID) & (block["channel"] == seen.channel)]
        if (mine["length"] == 1).any() != (mine["length"] == 1).all() or kinds.get(seen.channel, seen.numbered) != (
            seen.numbered
        ):
            return True
    return False


def renamed(table: Table, numbers: list[int], channels: tuple[str, ...]) -> Table:
    """Return the table with the channel numbers of the whole recording."""
    if numbers == list(range(len(numbers))):
        return replace(table, channels=channels)
    node = table.key & ((1 << NODE_BITS) - 1)
    places = np.array(numbers, dtype=np.uint16)[table.channel]
    return replace(table, key=(places << NODE_BITS | node).astype(np.uint16), channels=channels)


class _Kept:
    """Tables in order: in memory, many in a temporary file."""

    def __init__(self) -> None:
        self.rows = 0
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY_BYTES)  # noqa: SIM115 - closed after the last row

    def add(self, table: Table) -> None:
        """Append a table."""
        self.rows += len(table)
        pickle.dump(table, self._file, protocol=5)

    def __iter__(self) -> Iterator[Table]:
        """Yield the tables."""
        self._file.seek(0)
        with suppress(EOFError):
            while True:
                yield pickle.load(self._file)

    def __del__(self) -> None:
        self._file.close()

    def __getstate__(self) -> tuple[int, bytes]:
        """Return all tables: a cluster moved the part to another worker."""
        self._file.seek(0)
        return self.rows, self._file.read()

    def __setstate__(self, state: tuple[int, bytes]) -> None:
        self.__init__()  # type: ignore[misc]
        self.rows = state[0]
        self._file.write(state[1])
