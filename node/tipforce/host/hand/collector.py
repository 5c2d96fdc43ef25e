"""Collect frames into rows: one row for each SYNC, with every finger's answer to it.

A SYNC with a counter is numbered, and each answer carries the number in 2121h: it is assigned to its row by
arithmetic, whenever it arrives, up to half the numbers late. Without numbers an answer is assumed to be that to the
last SYNC before it. A finger that was missing may still send the answer to the SYNC before; so its next row stays open
until the next SYNC, and two different answers in it are both discarded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import HEARTBEAT_BASE, STANDARD_MASK, SYNC_COB_ID
from tipforce.dictionary import indices
from tipforce.dictionary.signals import Message, tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.columns import columns_of
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.rows import CHANGED, DOUBTFUL, MIXED, NO_ANSWER, PRESENT, Rows, Tally, joined
from tipforce.host.hand.sync_numbers import LARGEST, RESTARTED, SyncNumbers

COUNTER = "counter"
AHEAD = LARGEST // 2
"""An answer may precede its SYNC's place by so many numbers: the SYNCs between were not received."""

_RING = 512  # rows: the open ones, those of one part, AHEAD of the last one, and emitted ones for late answers
_PART_SYNCS = 100
_UNDECIDED_WAITS = 4  # for the next SYNC, where it decides whether a value is right
_EMPTY, _LIVE, _DOUBTFUL, _EARLY, _CHANGED = range(5)  # states of an answer
_REASON = np.array([NO_ANSWER, PRESENT, DOUBTFUL, NO_ANSWER, CHANGED], dtype=np.uint8)  # by state
_WORD = np.dtype("<u8")
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _OpenRow:
    t_ns: int
    opened_s: float
    number: int
    received: bool = True


class Collector:
    """Collect rows of ``messages`` (PDO names) of the fingers ``node_ids``.

    A row that is incomplete ``wait_s`` after its SYNC was received is emitted incomplete. ``own_sync``: the host sends
    the SYNC. Raises InputError for no finger, a repeated one, or a message without status and counter.
    """

    def __init__(
        self, node_ids: Sequence[int], messages: Sequence[str] = ("Contact",), gauges: int = 3,
        wait_s: float = 0.02, own_sync: bool = False,
    ) -> None:  # fmt: skip
        known = {m.name: m for m in tpdo_messages(gauges) if m.cob_id_base}
        health = known.pop("Health")
        unknown = [name for name in messages if name not in known]
        if unknown or not messages:
            raise InputError(f"PDO {', '.join(unknown) or 'none'}: allowed in a row are {', '.join(known)}")
        if not node_ids or len(set(node_ids)) != len(node_ids):
            raise InputError(f"node-ids {list(node_ids)}: allowed is each node-id once")
        self.node_ids = tuple(node_ids)
        self.tally = Tally(self.node_ids)
        self._messages = [known[name] for name in dict.fromkeys(messages)]
        self._wait_s = wait_s
        self._numbers = SyncNumbers(own_sync)
        self._slots(health)
        shape = len(self._messages), len(self.node_ids), _RING
        self._words = np.zeros(shape, dtype=_WORD)
        self._state = np.zeros(shape, dtype=np.uint8)
        # By place, answers that the next SYNC decides on: the row, the last row when it arrived, the state if right.
        self._early: dict[int, tuple[int, int, int]] = {}
        self._open: deque[_OpenRow] = deque()
        self._first = 0  # the first open row
        self._epoch = 0  # the first row of this count
        self._issued = np.full(LARGEST + 1, -LARGEST, dtype=np.int64)  # by number: its last row in counts before
        self._absent: set[int] = set()  # fingers for which no row waits
        self._unsettled = np.ones(len(node_ids), dtype=np.bool_)  # missing in the last row; matters without numbers
        self._last_counter = np.full(len(node_ids), -1, dtype=np.int64)
        self._verified: dict[int, int] = {}  # by finger: 2126h for which the hand knows what its values mean
        self._noticed: dict[int, int] = {}  # the last one that was reported as a change
        self._doubted = np.zeros(len(node_ids), dtype=np.bool_)
        self._health_s: dict[int, float] = {}  # by finger: when its health PDO came, or its 2126h was asked for
        self._requests: deque[Callable[[], None]] = deque()  # of other threads
        self._nothing: Rows | None = None
        self.changes: list[int] = []
        """Node-ids of fingers whose configuration counter (2126h) changed; the caller empties it."""

    def _slots(self, health: Message) -> None:
        """By identifier: the finger's place in a row, its health PDO or heartbeat; lengths; where the counter is."""
        fingers = len(self.node_ids)
        self._slot = np.full(STANDARD_MASK + 2, -1, dtype=np.int64)
        self._length = np.zeros(STANDARD_MASK + 2, dtype=np.uint8)
        self._service = fingers * len(self._messages)
        self._counter_shift = np.zeros(self._service, dtype=_WORD)
        for number, message in enumerate(self._messages):
            bits = {signal.name: signal.start_bit for signal in message.signals}
            for k, node_id in enumerate(self.node_ids):
                self._slot[message.cob_id_base + node_id] = number * fingers + k
                self._length[message.cob_id_base + node_id] = message.length_bytes
                self._counter_shift[number * fingers + k] = bits[COUNTER]
        for k, node_id in enumerate(self.node_ids):
            self._slot[health.cob_id_base + node_id] = self._slot[HEARTBEAT_BASE + node_id] = self._service + k
            self._length[HEARTBEAT_BASE + node_id] = 1
            self._length[health.cob_id_base + node_id] = health.length_bytes
        change = next(signal for signal in health.signals if signal.index == indices.CONFIGURATION_COUNTER)
        self._change_byte = change.start_bit // 8
        self._slot[SYNC_COB_ID] = self._service + fingers

    def verify(self, node_id: int, counter: int) -> None:
        """Show the values of a finger only while its 2126h is ``counter``. For any thread."""
        k = self.node_ids.index(node_id)

        def apply() -> None:
            self._verified[k], self._doubted[k] = counter, False
            self._noticed.pop(k, None)

        self._requests.append(apply)

    def notice(self, node_id: int, counter: int) -> bool:
        """Hide the values of a finger whose 2126h was read; return False if that change is known. For any thread."""
        k = self.node_ids.index(node_id)
        if self._noticed.get(k) == counter:
            return False

        def apply() -> None:
            self._noticed[k], self._doubted[k] = counter, True
            self.changes.append(node_id)

        self._requests.append(apply)
        return True

    def unwatched(self, now_s: float, limit_s: float) -> list[int]:
        """Return the fingers whose values are shown although their health PDO did not come for ``limit_s``."""
        shown = [k for k in self._verified if not self._doubted[k]]
        found = [k for k in shown if now_s - self._health_s.setdefault(k, now_s) > limit_s]
        self._health_s |= dict.fromkeys(found, now_s)
        return [self.node_ids[k] for k in found]

    def expect(self, node_id: int, present: bool) -> None:
        """Wait for a finger in each row, or not: one that is not operational. For any thread."""
        change = self._absent.discard if present else self._absent.add
        self._requests.append(partial(change, self.node_ids.index(node_id)))

    def restart(self) -> int:
        """End the open rows; return the number of the next SYNC, far from those that late answers may have."""
        self._numbers.number = (self._numbers.number + AHEAD) % LARGEST or LARGEST
        self._epoch = self._last + 1
        return self._numbers.number % LARGEST + 1

    def add(self, frames: FrameArray, now_s: float) -> Rows:
        """Process received frames, FRAME (n,); return the rows that are complete or timed out, often none.

        ``now_s`` is a monotonic time. Call it without frames too, to detect an unanswered SYNC.
        """
        while self._requests:
            self._requests.popleft()()
        can_id = np.minimum(frames["can_id"], STANDARD_MASK + 1)
        slot = self._slot[can_id]
        slot[frames["length"] < self._length[can_id]] = -1
        syncs = np.flatnonzero(slot == self._service + len(self.node_ids))
        cuts = self._cuts(frames, syncs) if len(syncs) else []
        if not cuts:
            return self._part(frames, slot, syncs, now_s)
        found, ends = [], [*cuts, len(frames)]
        for start, end in zip([0, *ends[:-1]], ends, strict=True):
            part = syncs[(syncs >= start) & (syncs < end)] - start
            found.append(self._part(frames[start:end], slot[start:end], part, now_s))
        return joined([rows for rows in found if len(rows)] or found[:1])

    def _cuts(self, frames: FrameArray, syncs: npt.NDArray[np.intp]) -> list[int]:
        """Return where to cut frames: answers before a gap or a restart of the count are taken before it."""
        number, cuts = self._numbers.number, []
        before_ns = self._numbers.last_ns
        for k, at in enumerate(syncs.tolist()):
            frame = frames[at]
            now, t_ns = int(frame["data"][0]) if frame["length"] == 1 else 0, int(frame["t_ns"])
            if k % _PART_SYNCS == _PART_SYNCS - 1 or not self._numbers.consecutive(number, now, t_ns - before_ns):
                cuts.append(at)
            number, before_ns = now, t_ns
        return cuts

    def _part(self, frames: FrameArray, slot: IntArray, syncs: npt.NDArray[np.intp], now_s: float) -> Rows:
        last, number = [self._last], [self._numbers.number]
        for frame in frames[syncs]:
            numbered = frame["length"] == 1
            self._sync(int(frame["data"][0]) if numbered else 0, int(frame["t_ns"]), now_s)
            last.append(self._last)
            number.append(self._numbers.number)
        answers = np.flatnonzero((slot >= 0) & (slot < self._service))
        services = np.flatnonzero((slot >= self._service) & (slot < self._service + len(self.node_ids)))
        from_here = self._watch(frames, slot, services, now_s) if len(services) else None
        if len(answers):
            before = np.searchsorted(syncs, answers)
            words = frames["data"].view(_WORD)[:, 0][answers]
            doubted = self._doubted[slot[answers] % len(self.node_ids)]
            if from_here is not None:
                doubted = answers >= from_here[slot[answers] % len(self.node_ids)]
            self._take(
                slot[answers], words, np.array(last)[before], np.array(number)[before], doubted,
                self._numbers.reachable(frames["t_ns"][answers].astype(np.int64)),
            )  # fmt: skip
        count = self._ready(now_s)
        if count:
            return self._rows(count)
        if self._nothing is None:  # most calls: no row is complete
            self._nothing = self._rows(0)
        return replace(self._nothing, first=self._first)

    @property
    def _last(self) -> int:
        """The row of the last SYNC."""
        return self._first + len(self._open) - 1

    # --- SYNCs ------------------------------------------------------------------------------------------------------

    def _sync(self, number: int, t_ns: int, now_s: float) -> None:
        """Start the row of a received SYNC, and those of SYNCs between it and the last one."""
        old = self._numbers.number, self._numbers.modulus
        before_ns = self._numbers.last_ns
        steps = self._numbers.step(number, t_ns)
        number = self._numbers.number
        last = self._last
        if steps == RESTARTED:
            if last >= 0:
                self._end_count(*old)
            self._epoch = last + 1
            self._early.clear()
            self._clear(last + 1, last + 1 + AHEAD)
            steps = 1
        for k in range(1, steps):
            missed_ns = before_ns + (t_ns - before_ns) * k // steps
            missed = (number - steps + k - 1) % self._numbers.modulus + 1
            self._open.append(_OpenRow(missed_ns, now_s, missed, False))
        self.tally.unreceived += steps - 1
        self._open.append(_OpenRow(t_ns, now_s, number))
        self._clear(last + 1 + AHEAD, self._last + 1 + AHEAD)
        if self._early:
            self._settle_early(last)

    def _clear(self, first: int, end: int) -> None:
        self._state[:, :, np.arange(first, end) % _RING] = _EMPTY

    def _end_count(self, number: int, modulus: int) -> None:
        """Note the numbers whose late answers may come after the restart of the count that ended with ``number``."""
        last, unreceived = self._last, min(self._numbers.gap_periods, LARGEST + 1) - 1
        if number:
            ago = np.arange(-unreceived, AHEAD)
            numbers = (number - 1 - ago) % modulus + 1
            np.maximum.at(self._issued, numbers, last - np.maximum(ago, -1))
        self._issued[1 : unreceived + 1] = last + 1  # another count may have begun and ended in the gap

    def _settle_early(self, before: int) -> None:
        """Answers that the number of this SYNC proves right, because the count went on.

        One ahead of its SYNC is right if the SYNC was not received and it came in its place, else doubtful.
        """
        for place, (row, last, state) in list(self._early.items()):
            if row <= self._last:
                right = row <= last or (last == before and not self._open[row - self._first].received)
                self._state.ravel()[place] = state if right else _DOUBTFUL
                del self._early[place]

    # --- answers ----------------------------------------------------------------------------------------------------

    def _watch(self, frames: FrameArray, slot: IntArray, services: npt.NDArray[np.intp], now_s: float) -> IntArray:
        """Return (k,) the frame from which on a finger's values are doubtful: another 2126h, a boot-up."""
        found = np.where(self._doubted, 0, len(frames))
        for at in services.tolist():
            k = int(slot[at]) - self._service
            data, heartbeat = frames["data"][at], frames["can_id"][at] >= HEARTBEAT_BASE
            if not heartbeat:
                self._health_s[k] = now_s
            counter = int(data[self._change_byte])
            if k not in self._verified or (data[0] if heartbeat else counter == self._verified[k]):
                continue
            if not self._doubted[k]:
                self._doubted[k], found[k] = True, at
            if not heartbeat and counter != self._noticed.get(k):
                self._noticed[k] = counter
                self.changes.append(self.node_ids[k])
        return found

    def _take(
        self, slot: IntArray, words: npt.NDArray[Any], last: IntArray, number: IntArray, doubted: BoolArray,
        reachable: IntArray | None,
    ) -> None:  # fmt: skip
        """Store answers (n,) received after the SYNC of row ``last`` with ``number`` (0: none).

        One whose number is ``reachable`` may be that to a SYNC of a restarted count which was not received.
        """
        row, fits = last, last >= 0
        counter = (words >> self._counter_shift[slot]).astype(np.uint8).astype(np.int64)
        numbered = number > 0
        if numbered.any():
            modulus = self._numbers.modulus
            behind = (number - counter) % modulus
            row = np.where(numbered, last - behind, last)
            row[numbered & (behind >= max(self._numbers.window, 1))] += modulus
            fits = fits & (~numbered | (counter > 0) & (counter <= modulus))
            if self._last - self._epoch < AHEAD + _PART_SYNCS:
                fits &= ~(numbered & (last - self._issued[np.minimum(counter, LARGEST)] < AHEAD))
            self._count(self.tally.delayed, slot[numbered & fits & (row < last) & (row >= self._first)])
        self._count(self.tally.doubtful, slot[~fits & (last >= 0)])
        late = fits & (row < max(self._first, self._epoch))
        place = slot * _RING + row % _RING
        if late.any():
            again = (self._state.ravel()[place] == _LIVE) & (self._words.ravel()[place] == words)
            self._count(self.tally.late, slot[late & ~again])
            self._unsettled[slot[late & ~again] % len(self.node_ids)] = True
        fits &= ~late
        state = np.where(doubted, _CHANGED, _LIVE).astype(np.uint8)
        early = row > last
        if reachable is not None:
            early |= numbered & (last == self._last) & (counter <= reachable)
        if fits.all():
            self._put(place, words, state, row, last, early)
        elif fits.any():
            self._put(place[fits], words[fits], state[fits], row[fits], last[fits], early[fits])

    def _put(
        self, place: IntArray, words: npt.NDArray[Any], state: npt.NDArray[np.uint8], row: IntArray, last: IntArray,
        early: BoolArray,
    ) -> None:  # fmt: skip
        all_words, states = self._words.ravel(), self._state.ravel()
        order = np.arange(len(place), dtype=_WORD)
        before = all_words[place]
        all_words[place] = order
        once = all_words[place] == order  # False: a later one of these has the same place
        all_words[place] = before
        if once.all() and not states[place].any() and not early.any():
            all_words[place], states[place] = words, state
            return
        each = (place, words, state, row, last, early)
        for at, word, new, of, after, waits in zip(*(one.tolist() for one in each), strict=True):
            if not states[at]:
                all_words[at], states[at] = word, new
                if waits:
                    states[at], self._early[at] = _EARLY, (of, after, new)
            elif all_words[at] != word:
                states[at] = _DOUBTFUL
                self._early.pop(at, None)
                self._count(self.tally.doubtful, np.array([at // _RING]))

    def _count(self, tally: IntArray, slot: IntArray) -> None:
        if len(slot):
            tally += np.bincount(slot % len(self.node_ids), minlength=len(self.node_ids))

    # --- rows -------------------------------------------------------------------------------------------------------

    def _ready(self, now_s: float) -> int:
        """Return how many open rows can be emitted, in order."""
        count = len(self._open)
        if not count:
            return 0
        state = self._state[:, :, np.arange(self._first, self._first + count) % _RING]
        there: BoolArray = state != _EMPTY
        undecided = np.zeros(count, dtype=np.bool_)
        if self._early:
            there &= state != _EARLY
            undecided = (state == _EARLY).any(axis=(0, 1))
        if self._absent:
            there[:, list(self._absent)] = True
        # A node sends its answers in order: if a later one is present, the missing one is lost, and the row does not
        # wait. Rows older than the window cannot receive an answer.
        passed = np.logical_or.accumulate(there[:, :, ::-1], axis=2)[:, :, ::-1]
        ready: BoolArray = np.logical_and.reduce(passed, axis=(0, 1))
        ready &= ~undecided
        ready[: max(self._epoch - self._first, 0)] = True
        ready[: max(count - self._numbers.window, 0)] = True
        if not self._numbers.number:
            ready[:-1] = True
            settled = (state[:, :, -2] == _LIVE).all() if count > 1 else not self._unsettled.any()
            ready[-1] &= bool(settled)
        if not ready.all():
            late = int(ready.argmin())
            for k in range(late, count):
                if now_s - self._open[k].opened_s < self._wait_s * (_UNDECIDED_WAITS if undecided[k] else 1):
                    break
                ready[k] = True
        return count if ready.all() else int(ready.argmin())

    def _rows(self, count: int) -> Rows:
        """Return the first ``count`` open rows, and close them."""
        rows = [self._open.popleft() for _ in range(count)]
        at = np.arange(self._first, self._first + count) % _RING
        self._first += count
        state = self._state[:, :, at].transpose(0, 2, 1)  # (messages, m, k)
        words = self._words[:, :, at].transpose(0, 2, 1)
        numbered = np.array([row.number > 0 for row in rows], dtype=np.bool_)
        columns: dict[str, npt.NDArray[Any]] = {}
        reason = _REASON[state].max(axis=0) if count else np.zeros(state.shape[1:], dtype=np.uint8)
        counter: IntArray = np.zeros(0, dtype=np.int64)
        for number, message in enumerate(self._messages):
            found = columns_of(words[number].ravel(), message.signals)
            own = found.pop(COUNTER).astype(np.int64).reshape(reason.shape)
            counter = own if not number else counter
            reason = np.where((own != counter) & (reason == PRESENT), np.uint8(MIXED), reason)
            columns |= {name: values.reshape(reason.shape) for name, values in found.items()}
        if count and not numbered.all():
            reason = self._repeats(reason, counter, columns["stale"], numbered)
        missing = reason != PRESENT
        if missing.any():
            counter[missing] = -1
            for name, column in columns.items():
                columns[name] = np.where(missing, np.nan if column.dtype.kind == "f" else False, column)
        if count:
            self._unsettled = missing[-1]
            self._last_counter = counter[-1]
        self._tally(reason, columns["stale"])
        sync_ns = np.array([row.t_ns for row in rows], dtype=np.int64)
        return Rows(self._first - count, sync_ns, numbered, counter, reason, columns)

    def _repeats(
        self, reason: npt.NDArray[np.uint8], counter: IntArray, stale: BoolArray, numbered: BoolArray
    ) -> npt.NDArray[np.uint8]:
        """Without numbers: a counter that stands still and is not marked stale is that of a duplicate."""
        before = np.concatenate((self._last_counter[np.newaxis], counter[:-1]))
        again = (counter == before) & ~stale & (reason == PRESENT) & ~numbered[:, np.newaxis]
        self._count(self.tally.doubtful, np.nonzero(again)[1])
        return np.where(again, np.uint8(DOUBTFUL), reason)

    def _tally(self, reason: npt.NDArray[np.uint8], stale: BoolArray) -> None:
        tally = self.tally
        tally.rows += len(reason)
        tally.missing += (reason != PRESENT).sum(axis=0)
        tally.mixed += (reason == MIXED).sum(axis=0)
        tally.changed += (reason == CHANGED).sum(axis=0)
        tally.repeated += stale.sum(axis=0)
