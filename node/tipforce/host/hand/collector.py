"""Collect frames into coherent rows: one row for each SYNC, with every finger's answer to it.

A row starts with a received SYNC. It is emitted as soon as it is complete, or after a waiting time; an answer that
arrives after the next SYNC is still assigned to its own row by its sample counter (lateness.py). All PDOs of a finger
in one row must have the same counter, because a node packs them from one sample; otherwise the row is mixed and the
finger counts as missing.

The counter counts samples, not SYNCs. An answer is doubtful if its counter repeats the previous row without the stale
bit, or lags behind the rows: it may be old and is discarded (counters.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import SYNC_COB_ID
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.counters import CounterCheck
from tipforce.host.hand.lateness import Answers, BoolArray, IntArray, babbled, seat
from tipforce.host.hand.rows import Rows, Tally
from tipforce.host.hand.sync_gaps import SyncGaps

COUNTER = "counter"
DISTRUSTED_ROWS = 4


class Collector:
    """Collect rows of ``messages`` (PDO names) of the fingers ``node_ids``.

    A row that is incomplete ``wait_s`` after its SYNC was received is emitted incomplete. Later rows do not wait for a
    missing finger, except until the next SYNC, before it responds again. ``own_sync``: the host sends the SYNC.
    Raises InputError for no finger, a repeated one, or a message without status and counter.
    """

    def __init__(
        self, node_ids: Sequence[int], messages: Sequence[str] = ("Contact",), gauges: int = 3,
        wait_s: float = 0.02, own_sync: bool = False, decoder: Decoder | None = None,
    ) -> None:  # fmt: skip
        known = {m.name: m for m in tpdo_messages(gauges) if m.cob_id_base and m.name != "Health"}
        unknown = [name for name in messages if name not in known]
        if unknown or not messages:
            raise InputError(f"PDO {', '.join(unknown) or 'none'}: allowed in a row are {', '.join(known)}")
        if not node_ids or len(set(node_ids)) != len(node_ids):
            raise InputError(f"node-ids {list(node_ids)}: allowed is each node-id once")
        self.node_ids = tuple(node_ids)
        self.tally = Tally(self.node_ids)
        self._messages = {name: number for number, name in enumerate(dict.fromkeys(messages))}
        self._decoder = decoder or Decoder(gauges, node_ids)
        self._kinds = {s.name: bool if s.bits == 1 else float for name in self._messages for s in known[name].signals}
        self._signals = frozenset(self._kinds)
        del self._kinds[COUNTER]
        self._finger = np.full(128, -1, dtype=np.int64)  # by node-id
        self._finger[list(node_ids)] = np.arange(len(node_ids))
        self._wait_s = wait_s
        self._open: FrameArray = np.zeros(0, dtype=FRAME)  # the SYNCs of open rows, and the answers since the first
        self._opened_s: list[float] = []  # receive time of each
        self._gaps: list[int] = []  # and the number of SYNCs missing before it
        self._given = False  # the only open row was emitted; further answers to it are late
        self._sync_gaps = SyncGaps(own_sync)
        self._counters = CounterCheck(len(node_ids))
        self._answered = np.zeros(len(node_ids), dtype=np.bool_)  # in the last emitted row
        self._silent: BoolArray = np.ones(len(node_ids), dtype=np.bool_)  # no answer in it, certain or not
        self._distrust = np.zeros(len(node_ids), dtype=np.int64)  # rows in which its answers are discarded

    def drop(self) -> None:
        """Note that frames were lost before or among the next ones."""
        self._sync_gaps.drop()

    def forget(self, node_id: int) -> None:
        """Restart the counter of a finger that booted; ignore other node-ids."""
        if self._finger[node_id] >= 0:
            self._counters.forget(int(self._finger[node_id]))

    def add(self, frames: FrameArray, now_s: float) -> Rows:
        """Process received frames, FRAME (n,); return the rows that are complete or timed out, often none.

        ``now_s`` is a monotonic time. Call it without frames too, to detect an unanswered SYNC.
        """
        window = _joined(self._open, frames)
        syncs = np.flatnonzero(window["can_id"] == SYNC_COB_ID)
        if not len(syncs):  # no SYNC has started a row yet
            return self._nothing()
        window, syncs = window[syncs[0] :], syncs - syncs[0]
        new = window["t_ns"][syncs[len(self._opened_s) :]].tolist()
        self._opened_s += [now_s] * len(new)
        self._gaps += [self._sync_gaps.add(t_ns) for t_ns in new]
        if new:
            self._sync_gaps.end_batch()
        first = int(self._given)
        if len(syncs) - first == 1 and self._too_few(len(window) - int(syncs[-1]), now_s):
            self._open = window
            return self._nothing()
        answers = self._answers(window, syncs, first) if len(window) > len(syncs) else []
        last = self._ready(answers, first, len(syncs), now_s)
        rows = self._rows(answers, window[syncs], first, last)
        self._keep(window, syncs, answers, last)
        return rows

    def _too_few(self, frames: int, now_s: float) -> bool:
        """Return whether the open frames cannot make a complete row, and no time-out is due."""
        enough = 1 + len(self._messages) * len(self.node_ids)
        return frames < enough and now_s - self._opened_s[-1] < self._wait_s

    def _nothing(self) -> Rows:
        """No row."""
        counter = np.zeros((0, len(self.node_ids)), dtype=np.int64)
        columns = {name: np.zeros(counter.shape, dtype=kind) for name, kind in self._kinds.items()}
        return Rows(self.tally.rows, np.zeros(0, dtype=np.int64), counter, columns)

    def _answers(self, window: FrameArray, syncs: npt.NDArray[np.intp], first: int) -> list[Answers]:
        """Return the fingers' answers, each assigned to its row as far as that is known."""
        found = []
        expected = self._counters.expected()
        expected = np.where(expected < 0, -1, (expected - first) % 256)  # the emitted row is the previous one
        regular = np.array(self._gaps) == 0
        regular[:first] = True
        for said in self._decoder.decode_together(window, self._signals):
            if said.name not in self._messages:
                continue
            row = np.searchsorted(syncs, said.row, side="right") - 1
            answers = Answers(
                self._messages[said.name], self._finger[said.node_id], row, said.row,
                said.columns[COUNTER].astype(np.int64), said.columns, *np.zeros((3, len(row)), dtype=np.bool_),
            )  # fmt: skip
            in_time = window["t_ns"][said.row] - window["t_ns"][syncs[row]] < self._sync_gaps.horizon_ns
            seat(answers, expected, in_time, regular)
            found.append(answers)
        return found

    def _ready(self, answers: list[Answers], first: int, count: int, now_s: float) -> int:
        """Return how many of ``count`` open rows can be emitted, in order."""
        shape = len(self._messages), count, len(self.node_ids)
        there: BoolArray = np.zeros(shape, dtype=np.bool_)
        silent = self._silent.copy()
        for said in answers:
            sure = ~said.waiting & (said.row >= first)
            there[said.message, said.row[sure], said.finger[sure]] = True
            silent[said.finger[said.waiting]] = False  # it responds again, and still has to catch up
        whole: BoolArray = np.logical_and.reduce(there)
        # Answers arrive in order: if a later one is present, the missing one is lost, and the row does not wait.
        passed = np.logical_and.reduce(np.logical_or.accumulate(there[:, ::-1], axis=1)[:, ::-1])
        spared = passed | silent
        spared[-1] = whole[-1]  # until the next SYNC there is time even for silent fingers
        timed_out = now_s - np.array(self._opened_s) >= self._wait_s
        ready = np.logical_and.reduce(spared, axis=1) | timed_out
        ready[:first] = True
        last = count if ready.all() else int(ready.argmin())
        if last > first:
            self._silent = np.logical_not(there[:, last - 1].any(axis=0))
        return last

    def _keep(self, window: FrameArray, syncs: npt.NDArray[np.intp], answers: list[Answers], last: int) -> None:
        """Keep the open rows and their answers, or only the last SYNC."""
        self._given = last == len(syncs)
        last = min(last, len(syncs) - 1)
        keep = np.zeros(len(window), dtype=np.bool_)
        keep[syncs[last:]] = True
        if not self._given:
            for said in answers:
                keep[said.frame[said.row >= last]] = True
        self._open = window[keep]
        del self._opened_s[:last], self._gaps[:last]

    def _rows(self, answers: list[Answers], syncs: FrameArray, first: int, last: int) -> Rows:
        """Return rows ``first`` to ``last``; answers to earlier ones are late."""
        shape = last - first, len(self.node_ids)
        counters = np.full((len(self._messages), *shape), -1, dtype=np.int64)
        unsure, proved = np.zeros((2, *shape), dtype=np.bool_)
        columns: dict[str, npt.NDArray[Any]] = {
            name: np.full(shape, np.nan) if kind is float else np.zeros(shape, dtype=np.bool_)
            for name, kind in self._kinds.items()
        }
        for said in answers:
            now = (said.row >= first) & (said.row < last)
            row, finger = said.row[now] - first, said.finger[now]
            proved[row, finger] |= said.proved[now]
            counters[said.message, row, finger] = said.counter[now]  # of two answers in a row the second one is kept
            for signal, values in said.columns.items():
                if signal != COUNTER:
                    columns[signal][row, finger] = values[now]
            self._count(said, now, first)
            self._spoke_again(said, first)
            unsure |= babbled(said, first, shape)
        gaps = np.maximum(np.array(self._gaps[first:last], dtype=np.int64), 0)
        sync_ns = syncs["t_ns"][first:last].astype(np.int64)
        counter = self._judged(counters, columns["stale"], unsure, proved, gaps, sync_ns)
        missing = counter < 0
        if missing.any():
            for column in columns.values():
                column[missing] = np.nan if column.dtype.kind == "f" else False
        rows = Rows(self.tally.rows, sync_ns, counter, columns)
        self.tally.rows += len(rows)
        self.tally.missing += missing.sum(axis=0)
        return rows

    def _count(self, said: Answers, now: BoolArray, first: int) -> None:
        """Count late answers, and those assigned to their own row."""
        fingers = len(self.node_ids)
        place = np.unique(said.row[now] * fingers + said.finger[now])
        late = np.bincount(said.finger[now | (said.row < first)], minlength=fingers)
        self.tally.late += late - np.bincount(place % fingers, minlength=fingers)
        self.tally.delayed += np.bincount(said.finger[now & said.moved], minlength=fingers)

    def _spoke_again(self, said: Answers, first: int) -> None:
        """Discard the answers of a finger that sends a second answer to one SYNC for some rows.

        Except with the counter that is due next: that answers a SYNC that did not reach the host.
        """
        due = self._counters.expected()
        again = (said.row < first) & self._answered[said.finger] & (said.counter != due[said.finger])
        self._distrust[said.finger[again]] = DISTRUSTED_ROWS

    def _judged(
        self, counters: IntArray, stale: BoolArray, unsure: BoolArray, proved: BoolArray, gaps: IntArray,
        sync_ns: IntArray,
    ) -> IntArray:  # fmt: skip
        """Return the counters of the rows (m, k) from those of each message, (messages, m, k): -1 if discarded."""
        tally = self.tally
        counter: IntArray = counters[0].copy()
        one_sample = np.equal(counters, counter).all(axis=0)
        tally.mixed += (~one_sample & (counters >= 0).all(axis=0)).sum(axis=0)
        counter[~one_sample] = -1
        unsure &= counter >= 0
        unsure |= self._distrusted(counter >= 0, unsure)
        if len(counter):
            self._answered = counter[-1] >= 0
        counter[unsure] = -1
        repeated, doubtful = self._counters.check(counter, stale, proved, gaps, sync_ns)
        counter[doubtful] = -1
        tally.repeated += repeated.sum(axis=0)
        tally.doubtful += (doubtful | unsure).sum(axis=0)
        return counter

    def _distrusted(self, here: BoolArray, unsure: BoolArray) -> BoolArray:
        """Return the answers (m, k) of fingers that recently sent several answers to one SYNC.

        A babbler's frame may precede the node's own, and its counter may match by chance.
        """
        distrusted = np.zeros(here.shape, dtype=np.bool_)
        if self._distrust.any() or unsure.any():
            for number in range(len(here)):
                distrusted[number] = (self._distrust > 0) & here[number]
                self._distrust = np.where(unsure[number], DISTRUSTED_ROWS, np.maximum(self._distrust - 1, 0))
        return distrusted


def _joined(one: FrameArray, other: FrameArray) -> FrameArray:
    """Return both, in order; for a few frames ten times as fast as concatenate, which checks every field's name."""
    both: FrameArray = np.empty(len(one) + len(other), dtype=FRAME)
    both[: len(one)] = one
    both[len(one) :] = other
    return both
