"""Sample counters (2121h): their modulus by the SYNCs of a log, lost samples by message, and counts without wraps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import SYNC_COB_ID
from tipforce.arrays import IntArray, occurring
from tipforce.host.decoding.decoder import Samples, unwrap_counter
from tipforce.host.decoding.sample_rule import COUNTER, SAMPLES, follows_sync, losses
from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Table
from tipforce.host.frames.frame_array import FrameArray
from tipforce.samples.sync_numbers import LARGEST

_NONE = -1

Place = tuple[str, int, str]
"""Channel, node-id, message name."""


class MessageCount(NamedTuple):
    """Frames of one message, and the samples lost between them (None: its PDO does not follow SYNC)."""

    frames: int = 0
    lost: int | None = None
    first: int | None = None
    last: int | None = None
    first_modulus: int = SAMPLES
    last_modulus: int = SAMPLES

    def followed_by(self, other: MessageCount) -> MessageCount:
        """Return it with the count of the next part; where its modulus is another one the count begins again."""
        frames = self.frames + other.frames
        if other.first is None or self.first is None or self.last is None:
            return (self if other.first is None else other)._replace(frames=frames)
        lost = (self.lost or 0) + (other.lost or 0)
        if self.last_modulus == other.first_modulus:
            lost += losses((self.last, other.first), self.last_modulus)[2]
        return self._replace(frames=frames, lost=lost, last=other.last, last_modulus=other.last_modulus)


TallyRow = tuple[str, int, str, int, int | None, int | None, int | None, int, int]
"""A place and the fields of its MessageCount."""


@dataclass(slots=True)
class Tally:
    """``messages`` by place; ``short`` frames that were shorter than their mapping."""

    messages: dict[Place, MessageCount] = field(default_factory=dict)
    short: Counter[Place] = field(default_factory=Counter)

    def add(self, place: Place, frames: int, first: int, last: int, lost: int, modulus: int) -> None:
        """Count frames, whose counters have this ``modulus`` (``SyncModulus``); ``first`` -1: they show no losses."""
        part = MessageCount(frames, lost, first, last, modulus, modulus) if first >= 0 else MessageCount(frames)
        self.messages[place] = self.messages.get(place, MessageCount()).followed_by(part)

    def add_samples(self, samples: Samples, modulus: int) -> None:
        """Count the samples of a bus."""
        counter = samples.columns.get(COUNTER, ()) if follows_sync(samples.message) else ()
        place = "", samples.node_id, samples.message.name
        self.add(place, len(samples.row), *losses(counter, modulus), modulus)

    def append(self, other: Tally) -> None:
        """Add the counts of the next part."""
        for place, count in other.messages.items():
            self.messages[place] = self.messages.get(place, MessageCount()).followed_by(count)
        self.short.update(other.short)

    @classmethod
    def of_rows(cls, messages: Iterable[TallyRow], short: Iterable[tuple[str, int, str, int]]) -> Tally:
        """Return the counts of rows: places and what is counted of them."""
        counts = {row[:3]: MessageCount._make(row[3:]) for row in messages}
        return cls(counts, Counter({row[:3]: row[3] for row in short}))

    def lost(self) -> dict[tuple[str, int], int]:
        """Return lost samples by channel and node: the maximum over its messages, which have one counter."""
        lost: dict[tuple[str, int], int] = {}
        for (channel, node, _), count in self.messages.items():
            if count.lost is not None:
                lost[channel, node] = max(lost.get((channel, node), 0), count.lost)
        return lost


class Counters:
    """Unwrap the counters of consecutive tables."""

    def __init__(self, last: Mapping[int, tuple[int, int]] | None = None) -> None:
        """``last``: by key, unwrapped and as sent."""
        self.last = dict(last or {})

    def unwrapped(self, table: Table) -> Table:
        """Return the table with each node's counter continued from its first value; an event-driven PDO in its own row
        gets the nearest count of a latch, before the first PDO that follows SYNC its own."""
        counter, before = table.counter.copy(), dict(self.last)
        order = np.argsort(table.key, kind="stable")
        steady = order[table.cyclic[order]]
        events = ~table.cyclic & (table.counter != NO_COUNTER)
        of_channel = dict(table.moduli)
        moduli = {key: of_channel.get(table.channels[key >> NODE_BITS], SAMPLES) for key in occurring(table.key)}
        for modulus in sorted({*moduli.values()}):
            of_modulus = np.array([key for key in moduli if moduli[key] == modulus])
            here = steady if len(of_modulus) == len(moduli) else steady[np.isin(table.key[steady], of_modulus)]
            if len(here):
                counter[here] = self._continued(table.key[here], table.counter[here], modulus)
        for key in occurring(table.key[events]):
            rows = order[slice(*np.searchsorted(table.key[order], [key, key + 1]))]
            counter[rows] = _with_events(table, rows, counter[rows], before.get(key), moduli[key])
        return replace(table, counter=counter)

    def _continued(self, key: npt.NDArray[np.uint16], sent: IntArray, modulus: int) -> IntArray:
        counts = unwrap_counter(sent, modulus)
        edges = [0, *(np.flatnonzero(key[1:] != key[:-1]) + 1).tolist(), len(key)]
        for start, end in pairwise(edges):
            of, first = int(key[start]), int(sent[start])
            last = self.last.get(of)
            begin = first if last is None else last[0] + (first - last[1]) % modulus
            counts[start:end] += begin - int(counts[start])
            self.last[of] = int(counts[end - 1]), int(sent[end - 1])
        return counts


def _with_events(
    table: Table, rows: npt.NDArray[np.intp], counts: IntArray, last: tuple[int, int] | None, modulus: int
) -> IntArray:
    """Return the counts of a node's rows with those of its event-driven PDOs, each nearest to the latch before it."""
    cyclic, raw = table.cyclic[rows], table.counter[rows]
    event = np.flatnonzero(~cyclic & (raw != NO_COUNTER))
    before = np.cumsum(cyclic)[event]
    known = np.concatenate(([-1 if last is None else last[0]], counts[cyclic]))[before]
    sent = np.concatenate(([0 if last is None else last[1]], raw[cyclic]))[before]
    half = modulus // 2
    nearest = known + (raw[event] - sent + half) % modulus - half
    counts[event] = nearest if last is not None else np.where(before == 0, raw[event], nearest)
    return counts


class SyncModulus:
    """Follow the SYNCs of each channel: counters are their numbers, 1 to 1019h, or count samples modulo 256."""

    def __init__(self, state: Iterable[tuple[int, int, int, int]] = ()) -> None:
        """``state`` as a property of that name returned it."""
        # By channel the modulus, the largest number since the numbers began, and the last; _NONE without numbers.
        self._known = {channel: (modulus, largest, last) for channel, modulus, largest, last in state}

    @property
    def of(self) -> dict[int, int]:
        """The modulus by channel number; SAMPLES for one that it lacks."""
        return {channel: modulus for channel, (modulus, _, _) in self._known.items()}

    @property
    def state(self) -> list[tuple[int, int, int, int]]:
        """By channel: its number, the modulus, the largest and the last number, -1 for none."""
        return [(channel, *known) for channel, known in self._known.items()]

    @property
    def settled(self) -> bool:
        """Whether the numbers of each channel that has them were seen up to the largest one."""
        return all(modulus == max(largest, 2) for modulus, largest, _ in self._known.values() if largest != _NONE)

    @property
    def modulus(self) -> int:
        """That of frames from one channel."""
        return next(iter(self.of.values()), SAMPLES)

    def parts(self, frames: FrameArray) -> Iterator[FrameArray]:
        """Split frames (k,) at ``cuts``; ``of`` holds for the part just yielded."""
        start = 0
        for end in [*self.cuts(frames), len(frames)]:
            self.look(frames[start:end])
            yield frames[start:end]
            start = end

    def cuts(self, frames: FrameArray) -> list[int]:
        """Return the indices of the SYNCs at which numbers begin or end."""
        at = np.flatnonzero(frames["can_id"] == SYNC_COB_ID)
        places: list[int] = []
        for channel in occurring(frames["channel"][at]):
            of_channel = at[frames["channel"][at] == channel]
            numbered = (frames["length"][of_channel] == 1).astype(np.int8)
            before = np.int8(self.of.get(channel, SAMPLES) != SAMPLES)
            places += of_channel[np.diff(numbered, prepend=before) != 0].tolist()
        return sorted(places)

    def look(self, frames: FrameArray) -> None:
        """Take the numbers of SYNCs without a cut among them; they are numbered if the last one is."""
        syncs = frames.compress(frames["can_id"] == SYNC_COB_ID)
        for channel in occurring(syncs["channel"]):
            mine = syncs.compress(syncs["channel"] == channel)
            if mine["length"][-1] != 1:
                self._known[channel] = SAMPLES, _NONE, _NONE
                continue
            number = mine["data"][:, 0].astype(np.int64)
            modulus, largest, last = self._known.get(channel, (SAMPLES, _NONE, _NONE))
            last = int(number[0]) if last == _NONE else last
            wraps = bool((np.diff(number, prepend=last) < 0).any())
            largest = max(largest, int(number.max()))
            if wraps or largest > modulus or modulus == SAMPLES:
                modulus = max(largest, 2) if wraps else LARGEST
            self._known[channel] = modulus, largest, int(number[-1])
