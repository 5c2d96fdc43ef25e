"""Frames in, coherent rows out: one row for each SYNC, with what every finger answered to it.

A row begins with a SYNC in the stream of received frames. All PDOs of a finger in one row must carry one sample
counter, because a node packs them from one sample; otherwise the row is mixed and the finger counts as missing. A
second answer of a finger within a row means that the first one was late: it belongs to the SYNC before and is dropped.

An answer that stands alone in its row is doubted by its counter, which counts samples and not SYNCs: one that repeats
the row before without saying that it is stale, or that lags behind the rows, may be old and is not shown (counters.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decode import Decoder, Samples
from tipforce.host.frames import FRAME, FrameArray
from tipforce.host.hand.counters import CONFIRMED, CounterCheck

SYNC_COB_ID = 0x80
COUNTER = "counter"
MOST_ANSWERS = 4
"""That lateness and duplicates explain in one row."""

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
_Answers = dict[tuple[int, str], tuple[Samples, npt.NDArray[np.intp]]]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """m rows of k fingers, in the order of the SYNCs and of the hand's node-ids.

    ``columns`` has every signal of the PDOs that the hand reads, each (m, k): measurements as float64 in the signal's
    unit, NaN where the node marks them unknown or the finger is missing; flags as bool, False where missing.
    """

    first: int
    """Number of the first row since the collector began."""
    sync_ns: npt.NDArray[np.int64]
    """(m,) receive time of each SYNC."""
    counter: npt.NDArray[np.int64]
    """(m, k) sample counter 0..255, -1 where missing."""
    columns: dict[str, npt.NDArray[Any]]

    @property
    def missing(self) -> BoolArray:
        """(m, k) no whole answer of this finger."""
        return self.counter < 0

    def __len__(self) -> int:
        return len(self.sync_ns)


@dataclass(slots=True)
class Tally:
    """What was counted since the collector began; arrays have one element per finger."""

    node_ids: tuple[int, ...]
    rows: int = 0
    missing: npt.NDArray[np.int64] = field(init=False)
    """Rows without a whole answer."""
    late: npt.NDArray[np.int64] = field(init=False)
    """Answers that came after the next SYNC, or after the row was given up."""
    mixed: npt.NDArray[np.int64] = field(init=False)
    """Rows whose PDOs were of two samples."""
    repeated: npt.NDArray[np.int64] = field(init=False)
    """Rows with the counter of the row before, marked stale: the SYNC came faster than the node's converter."""
    doubtful: npt.NDArray[np.int64] = field(init=False)
    """Answers that were not shown because their counter says that they may be old."""

    def __post_init__(self) -> None:
        zeros = np.zeros((5, len(self.node_ids)), dtype=np.int64)
        self.missing, self.late, self.mixed, self.repeated, self.doubtful = zeros


class Collector:
    """Collects rows of ``messages`` (PDO names) of the fingers ``node_ids``.

    The last row is given out as soon as it is whole, or when ``timeout_s`` has passed since its SYNC was handed in.
    Raises InputError for no finger, a repeated one, or a message without status and counter.
    """

    def __init__(
        self, node_ids: Sequence[int], messages: Sequence[str] = ("Contact",), gauges: int = 3,
        timeout_s: float = 0.02, decoder: Decoder | None = None,
    ) -> None:  # fmt: skip
        known = {m.name: m for m in tpdo_messages(gauges) if m.cob_id_base and m.name != "Health"}
        unknown = [name for name in messages if name not in known]
        if unknown or not messages:
            raise InputError(f"PDO {', '.join(unknown) or 'none'}: allowed in a row are {', '.join(known)}")
        if not node_ids or len(set(node_ids)) != len(node_ids):
            raise InputError(f"node-ids {list(node_ids)}: give each finger's once")
        self.node_ids = tuple(node_ids)
        self.tally = Tally(self.node_ids)
        self._messages = tuple(dict.fromkeys(messages))
        self._decoder = decoder or Decoder(gauges, node_ids)
        self._kinds = {s.name: bool if s.bits == 1 else float for name in self._messages for s in known[name].signals}
        self._signals = frozenset(self._kinds)
        del self._kinds[COUNTER]
        self._finger = {node_id: k for k, node_id in enumerate(node_ids)}
        self._timeout_s = timeout_s
        self._open: FrameArray = np.zeros(0, dtype=FRAME)  # the SYNC of the open row and what came after it
        self._given = False  # the open row was given out; what still comes for it is late
        self._opened_s = 0.0
        self._counters = CounterCheck(len(node_ids))
        self._answered = np.zeros(len(node_ids), dtype=np.bool_)  # in the row that was given out last
        self._distrust = np.zeros(len(node_ids), dtype=np.int64)  # rows for which a finger is not believed

    def add(self, frames: FrameArray, now_s: float) -> Rows:
        """Take frames as they were received, FRAME (n,); the rows that became whole or timed out, often none.

        ``now_s`` is a monotonic time. Call it without frames too, so that an unanswered SYNC is noticed.
        """
        pending = np.concatenate((self._open, frames)) if len(frames) else self._open
        syncs = np.flatnonzero(pending["can_id"] == SYNC_COB_ID)
        if not len(syncs):  # nothing begins a row yet
            return self._rows(0, pending[:0], {}, 0, 0)
        if len(syncs) > 1 or not len(self._open):
            self._opened_s = now_s
        first, count = int(self._given), len(syncs)
        found = self._answers(pending[syncs[0] :], syncs - syncs[0]) if len(pending) > count else {}
        if count > first:
            self._given = self._whole(found, count) or now_s - self._opened_s >= self._timeout_s
        last = count if self._given else count - 1
        start = int(syncs[-1])
        self._open = pending[start : start + 1 if self._given else None].copy()
        return self._rows(first, pending[syncs], found, count, last)

    def _answers(self, frames: FrameArray, syncs: npt.NDArray[np.intp]) -> _Answers:
        """What each finger said by (finger, message), with the row of each of its samples."""
        found: _Answers = {}
        for (node_id, name), samples in self._decoder.decode(frames, self._signals).items():
            if name in self._messages and node_id in self._finger:
                row = np.searchsorted(syncs, samples.row, side="right") - 1
                found[self._finger[node_id], name] = samples, row
        return found

    def _whole(self, found: _Answers, count: int) -> bool:
        """Every finger has answered the last SYNC with every message."""
        if len(found) < len(self.node_ids) * len(self._messages):
            return False
        return all(row[-1] == count - 1 for _, row in found.values())

    def _rows(self, first: int, syncs: FrameArray, found: _Answers, count: int, last: int) -> Rows:
        """Rows ``first`` to ``last`` of ``count``: the one before was given out already, what came for it is late."""
        tally, shape = self.tally, (count, len(self.node_ids))
        counters = np.full((len(self._messages), *shape), -1, dtype=np.int64)
        unsure = np.zeros(shape, dtype=np.bool_)
        columns: dict[str, npt.NDArray[Any]] = {
            name: np.full(shape, np.nan) if kind is float else np.zeros(shape, dtype=np.bool_)
            for name, kind in self._kinds.items()
        }
        for (k, name), (samples, row) in found.items():
            counters[self._messages.index(name), row, k] = samples.columns[COUNTER]
            now = row[row < last]
            if len(now):
                fresh = now[now >= first]  # in order
                tally.late[k] += len(now) - len(fresh) + np.count_nonzero(fresh[1:] == fresh[:-1])
            if len(row) > 1:
                unsure[_babbled(row, samples.columns[COUNTER]), k] = True
        self._fill(columns, found)
        counter = counters[0]
        one_sample = (counters == counter).all(axis=0)
        mixed = ~one_sample & (counters >= 0).all(axis=0)
        counter[~one_sample] = -1
        given = slice(first, max(first, last))
        shown = counter[given]
        babbled = unsure[given] & (shown >= 0)
        babbled |= self._distrusted(found, first, shown, babbled)
        answered = shown >= 0
        shown[babbled] = -1
        repeated, doubtful = self._counters.check(shown, columns["stale"][given])
        doubtful |= babbled
        if len(shown):
            self._answered = answered[-1]
        shown[doubtful] = -1
        tally.repeated += repeated.sum(axis=0)
        tally.doubtful += doubtful.sum(axis=0)
        tally.mixed += mixed[given].sum(axis=0)
        tally.missing += (shown < 0).sum(axis=0)
        of_rows = {name: column[given] for name, column in columns.items()}
        for column in of_rows.values():
            column[shown < 0] = np.nan if column.dtype.kind == "f" else False
        rows = Rows(tally.rows, syncs["t_ns"][given].astype(np.int64), counter[given], of_rows)
        tally.rows += len(rows)
        return rows

    def _distrusted(self, found: _Answers, first: int, shown: npt.NDArray[np.int64], babbled: BoolArray) -> BoolArray:
        """Answers (m, k) of fingers that have lately said more than one thing to one SYNC.

        A babbler's frame may come before the node's own, and its counter may happen to fit. So a finger that spoke
        again after its answer was given out, or that babbled, is not believed for CONFIRMED rows.
        """
        for (k, _), (_, row) in found.items():
            if self._answered[k] and (row < first).any():
                self._distrust[k] = CONFIRMED
        distrusted = np.zeros(shown.shape, dtype=np.bool_)
        if self._distrust.any() or babbled.any():
            for number in range(len(shown)):
                distrusted[number] = (self._distrust > 0) & (shown[number] >= 0)
                self._distrust = np.where(babbled[number], CONFIRMED, np.maximum(self._distrust - 1, 0))
        return distrusted

    def _fill(self, columns: dict[str, npt.NDArray[Any]], found: _Answers) -> None:
        """All fingers at once: a call of numpy's costs more than the few numbers that one finger brings."""
        for name in self._messages:
            answers = [(k, samples, row) for (k, of), (samples, row) in found.items() if of == name]
            if not answers:
                continue
            rows = np.concatenate([row for _, _, row in answers])
            fingers = np.repeat([k for k, _, _ in answers], [len(row) for _, _, row in answers])
            for signal in answers[0][1].columns:
                if signal != COUNTER:  # of two answers in a row the second one stays
                    columns[signal][rows, fingers] = np.concatenate([s.columns[signal] for _, s, _ in answers])


def _babbled(row: npt.NDArray[np.intp], counter: npt.NDArray[np.uint8]) -> npt.NDArray[np.intp]:
    """Rows (of the answers of one finger, in order) that hold more, or other, answers than lateness explains.

    A late answer and the one in time count on by one, a duplicate by none. Anything else is a babbler or a second node
    with the same COB-ID, and no answer in the row can be told from the others.
    """
    if len(row) < 2:
        return row[:0]
    same = np.diff(row) == 0
    odd = same & (np.diff(counter) > 1)  # unsigned: modulo 256
    many, counts = np.unique(row[1:][same], return_counts=True)
    return np.concatenate((row[1:][odd], many[counts >= MOST_ANSWERS]))
