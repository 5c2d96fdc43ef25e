"""Collect frames into rows: one row for each SYNC, with every finger's answer to it.

A SYNC with a counter is numbered, and each answer carries the number in 2121h: it is assigned to its row by
arithmetic, whenever it arrives, up to half the numbers late. Without numbers an answer is assumed to be that to the
last SYNC before it. A finger that was missing may still send the answer to the SYNC before; so its next row stays open
until the next SYNC, and two different answers in it are both discarded.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import HEARTBEAT_BASE, STANDARD_MASK, SYNC_COB_ID
from tipforce.dictionary import indices
from tipforce.dictionary.signals import Message, tpdo_messages
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
_EMPTY, _LIVE, _DOUBTFUL, _CHANGED = range(4)  # states of an answer
_REASON = np.array([NO_ANSWER, PRESENT, DOUBTFUL, CHANGED], dtype=np.uint8)  # by state
_NOT_WATCHED, _BOOTED = -1, -2  # in place of a verified 2126h
_ANY_NUMBER = 0, 1  # end of a count and its modulus, where the numbers of the count are not known
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
    the SYNC.
    """

    def __init__(
        self, node_ids: Sequence[int], messages: Sequence[str] = ("Contact",), gauges: int = 3,
        wait_s: float = 0.02, own_sync: bool = False,
    ) -> None:  # fmt: skip
        known = {m.name: m for m in tpdo_messages(gauges) if m.cob_id_base}
        self.node_ids = tuple(node_ids)
        self.tally = Tally(self.node_ids)
        self._messages = [known[name] for name in dict.fromkeys(messages)]
        self._wait_s = wait_s
        self._own_sync, self._numbers = own_sync, SyncNumbers(own_sync)
        self._slots(known["Health"])
        shape = len(self._messages), len(self.node_ids), _RING
        self._words = np.zeros(shape, dtype=_WORD)
        self._state = np.zeros(shape, dtype=np.uint8)
        # By place, answers that the next SYNC decides on: the row, the last row when it arrived, word, state if right.
        self._held: dict[int, tuple[int, int, int, int]] = {}
        self._open: deque[_OpenRow] = deque()
        self._first = 0  # the first open row
        self._epoch = 0  # the first row of this count
        # Counts whose answers may still come: the last row, the last number, the modulus.
        self._ended: list[tuple[int, int, int]] = []
        self._lock = threading.Lock()
        fingers = len(node_ids)
        self._absent: set[int] = set()  # fingers for which no row waits
        self._unsettled = np.ones(fingers, dtype=np.bool_)  # missing in the last row; matters without numbers
        self._last_counter = np.full(fingers, -1, dtype=np.int64)
        self._verified = np.full(fingers, _NOT_WATCHED)  # 2126h for which the hand knows what the values mean
        self._seen = np.full(fingers, _NOT_WATCHED)  # the last 2126h; its values are shown while it is the verified one
        self._health_s: dict[int, float] = {}  # by finger: when its health PDO came, or its 2126h was asked for
        self.changes: list[int] = []
        """Node-ids of fingers whose configuration counter (2126h) changed; the caller empties it."""
        self._nothing = self._rows(0)

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
        with self._lock:
            self._verified[k] = self._seen[k] = counter
            self.changes = [one for one in self.changes if one != node_id]

    def notice(self, node_id: int, counter: int) -> bool:
        """Hide the values of a finger whose 2126h was read; return False if that change is known. For any thread."""
        k = self.node_ids.index(node_id)
        with self._lock:
            return self._change(k, counter)

    def _change(self, k: int, counter: int) -> bool:
        if self._seen[k] == counter:
            return False
        self._seen[k] = counter
        if self._verified[k] != counter:
            self.changes.append(self.node_ids[k])
        return True

    def unwatched(self, now_s: float, limit_s: float) -> list[int]:
        """Return the fingers whose values are shown although their health PDO did not come for ``limit_s``."""
        shown = np.flatnonzero((self._verified >= 0) & (self._seen == self._verified)).tolist()
        found = [k for k in shown if now_s - self._health_s.setdefault(k, now_s) > limit_s]
        self._health_s |= dict.fromkeys(found, now_s)
        return [self.node_ids[k] for k in found]

    def expect(self, node_id: int, present: bool) -> None:
        """Wait for a finger in each row, or not: one that is not operational. For any thread."""
        with self._lock:
            (self._absent.discard if present else self._absent.add)(self.node_ids.index(node_id))

    def restart(self) -> int:
        """End the open rows; return the number of the next SYNC, far from those that late answers may have."""
        self._numbers.number = (self._numbers.number + AHEAD) % LARGEST or LARGEST
        self._epoch = self._last + 1
        return self._numbers.number % LARGEST + 1

    def add(self, frames: FrameArray, now_s: float) -> Rows:
        """Process received frames, FRAME (n,); return the rows that are complete or timed out, often none.

        ``now_s`` is a monotonic time. Call it without frames too, to detect an unanswered SYNC.
        """
        with self._lock:
            return self._add(frames, now_s)

    def _add(self, frames: FrameArray, now_s: float) -> Rows:
        can_id = np.minimum(frames["can_id"], STANDARD_MASK + 1)
        slot = self._slot[can_id]
        slot[frames["length"] < self._length[can_id]] = -1
        syncs = np.flatnonzero(slot == self._service + len(self.node_ids))
        cuts = self._cuts(frames[syncs], syncs) if len(syncs) else []
        if not cuts:
            return self._part(frames, slot, syncs, now_s)
        found, ends = [], [*cuts, len(frames)]
        for start, end in zip([0, *ends[:-1]], ends, strict=True):
            part = syncs[(syncs >= start) & (syncs < end)] - start
            found.append(self._part(frames[start:end], slot[start:end], part, now_s))
        return joined([rows for rows in found if len(rows)] or found[:1])

    def _cuts(self, syncs: FrameArray, places: npt.NDArray[np.intp]) -> list[int]:
        """Return where to cut frames: answers before a gap or a restart of the count are taken before it."""
        numbers = np.where(syncs["length"] == 1, syncs["data"][:, 0], 0).astype(np.int64)
        cut = ~self._numbers.consecutive(numbers, syncs["t_ns"])
        cut[_PART_SYNCS - 1 :: _PART_SYNCS] = True
        found: list[int] = places[cut].tolist()
        return found

    def _part(self, frames: FrameArray, slot: IntArray, syncs: npt.NDArray[np.intp], now_s: float) -> Rows:
        last, number, held = [self._last], [self._numbers.number], bool(self._held)
        for frame in frames[syncs]:
            numbered = frame["length"] == 1
            self._sync(int(frame["data"][0]) if numbered else 0, int(frame["t_ns"]), now_s)
            last.append(self._last)
            number.append(self._numbers.number)
        answers = np.flatnonzero((slot >= 0) & (slot < self._service))
        doubted = np.where(self._verified == self._seen, len(frames), 0)
        if len(answers) + len(syncs) < len(frames):
            services = np.flatnonzero((slot >= self._service) & (slot < self._service + len(self.node_ids)))
            self._watch(frames, slot, services, doubted, now_s)
        if len(answers):
            before, at = np.searchsorted(syncs, answers), slot[answers]
            words = frames["data"].view(_WORD)[:, 0][answers]
            state = np.where(answers >= doubted[at % len(self.node_ids)], _CHANGED, _LIVE).astype(np.uint8)
            t_ns = frames["t_ns"][answers]
            self._take(at, words, np.array(last)[before], np.array(number)[before], state, t_ns)
        waits = not held and self._must_wait(now_s, bool(len(answers)))
        count = 0 if waits else self._ready(now_s)
        return self._rows(count) if count else self._nothing

    @property
    def _last(self) -> int:
        """The row of the last SYNC."""
        return self._first + len(self._open) - 1

    # --- SYNCs ------------------------------------------------------------------------------------------------------

    def _sync(self, number: int, t_ns: int, now_s: float) -> None:
        """Start the row of a received SYNC, and those of SYNCs between it and the last one."""
        before, modulus, before_ns = self._numbers.number, self._numbers.modulus, self._numbers.last_ns
        steps = self._numbers.step(number, t_ns)
        number = self._numbers.number
        last = self._last
        if steps == RESTARTED:
            if last >= 0:
                # Among SYNCs that were not received, other counts may have begun and ended.
                known = before and self._numbers.gap_periods <= 1
                self._ended.append((last, *((before, modulus) if known else _ANY_NUMBER)))
            self._epoch = last + 1
            self._held.clear()
            self._clear(last + 1, last + 1 + AHEAD)
            steps = 1
        for k in range(1, steps):
            missed_ns = before_ns + (t_ns - before_ns) * k // steps
            missed = (number - steps + k - 1) % self._numbers.modulus + 1
            self._open.append(_OpenRow(missed_ns, now_s, missed, False))
        self.tally.unreceived += steps - 1
        self._open.append(_OpenRow(t_ns, now_s, number))
        self._clear(last + 1 + AHEAD, self._last + 1 + AHEAD)
        for place, held in list(self._held.items()):
            self._settle(place, last, *held)

    def _clear(self, first: int, end: int) -> None:
        self._state[:, :, np.arange(first, end) % _RING] = _EMPTY

    def _settle(self, place: int, before: int, row: int, last: int, word: int, state: int) -> None:
        """Store a held answer, which the number of this SYNC proves right: the count went on.

        One ahead of its SYNC is right if the SYNC was not received and it came in its place, else doubtful.
        """
        if row <= self._last:
            right = row <= last or (last == before and not self._open[row - self._first].received)
            self._words.ravel()[place], self._state.ravel()[place] = word, state if right else _DOUBTFUL
            del self._held[place]

    # --- answers ----------------------------------------------------------------------------------------------------

    def _watch(
        self, frames: FrameArray, slot: IntArray, services: npt.NDArray[np.intp], doubted: IntArray, now_s: float
    ) -> None:
        """Lower ``doubted`` (k,), the frame from which on a finger's values are doubtful: another 2126h, a boot-up."""
        for at in services.tolist():
            k, data = int(slot[at]) - self._service, frames["data"][at]
            if frames["can_id"][at] < HEARTBEAT_BASE:
                self._health_s[k] = now_s
                if self._verified[k] != _NOT_WATCHED:
                    self._change(k, int(data[self._change_byte]))
            elif not data[0] and self._verified[k] != _NOT_WATCHED:
                self._verified[k] = _BOOTED
            if self._verified[k] != self._seen[k]:
                doubted[k] = min(doubted[k], at)

    def _take(
        self, slot: IntArray, words: npt.NDArray[Any], last: IntArray, number: IntArray,
        state: npt.NDArray[np.uint8], t_ns: IntArray,
    ) -> None:  # fmt: skip
        """Store answers (n,) received at ``t_ns`` after the SYNC of row ``last`` with ``number`` (0: none)."""
        row, fits, numbered = last, last >= 0, number > 0
        held = np.zeros(len(slot), dtype=np.bool_)
        counter = (words >> self._counter_shift[slot]).astype(np.uint8).astype(np.int64)
        punctual = self._own_sync and not self._ended and bool((counter == number).all())
        if not punctual and numbered.any():
            numbers, modulus = self._numbers, self._numbers.modulus
            behind = (number - counter) % modulus
            row = np.where(numbered, last - behind, last)
            row[numbered & (behind >= max(numbers.window, 1))] += modulus
            fits &= ~numbered | (counter > 0) & (counter <= modulus)
            self._ended = [one for one in self._ended if self._last - one[0] < AHEAD + _PART_SYNCS]
            for end, ended_number, ended_modulus in self._ended:  # may be a late answer to that count
                fits &= ~numbered | (last - end + (ended_number - counter) % ended_modulus >= AHEAD)
            # An answer ahead of its SYNC, or perhaps to a SYNC of a restarted count which was not received.
            held = (row > last) | (numbered & (last == self._last) & (counter <= numbers.reachable(t_ns)))
            self._count(self.tally.delayed, slot[numbered & fits & (row < last) & (row >= self._first)])
        self._count(self.tally.doubtful, slot[~fits & (last >= 0)])
        place = slot * _RING + row % _RING
        late = fits & (row < max(self._first, self._epoch))
        if late.any():
            again = (self._state.ravel()[place] == _LIVE) & (self._words.ravel()[place] == words)
            self._count(self.tally.late, slot[late & ~again])
            self._unsettled[slot[late & ~again] % len(self.node_ids)] = True
            fits &= ~late
        answers = place, words, state, row, last, held
        self._put(*(answers if fits.all() else (one[fits] for one in answers)))

    def _put(
        self, place: IntArray, words: npt.NDArray[Any], state: npt.NDArray[np.uint8], row: IntArray, last: IntArray,
        held: BoolArray,
    ) -> None:  # fmt: skip
        all_words, states = self._words.ravel(), self._state.ravel()
        if not states[place].any() and not held.any() and len(set(place.tolist())) == len(place):
            all_words[place], states[place] = words, state
            return
        each = (place, words, state, row, last, held)
        for at, word, new, of, after, waits in zip(*(one.tolist() for one in each), strict=True):
            if waits and not states[at]:
                same = at not in self._held or self._held[at][2] == word
                self._held.setdefault(at, (of, after, word, new))
                if not same:
                    self._held[at] = of, of - LARGEST, word, new  # no row before is that one: doubtful
            elif not states[at]:
                all_words[at], states[at] = word, new
            elif all_words[at] != word:
                states[at] = _DOUBTFUL
                self._count(self.tally.doubtful, np.array([at // _RING]))

    def _count(self, tally: IntArray, slot: IntArray) -> None:
        if len(slot):
            tally += np.bincount(slot % len(self.node_ids), minlength=len(self.node_ids))

    # --- rows -------------------------------------------------------------------------------------------------------

    def _must_wait(self, now_s: float, answered: bool) -> bool:
        """Return whether surely no row is complete, without a search: most calls bring a part of one row."""
        count, first = len(self._open), self._first
        if not count:
            return True
        in_time = now_s - self._open[0].opened_s < self._wait_s and count <= self._numbers.window
        if not in_time or not self._numbers.number or first < self._epoch or self._absent:
            return False
        return not answered or (count == 1 and not self._state[:, :, first % _RING].all())

    def _ready(self, now_s: float) -> int:
        """Return how many open rows can be emitted, in order."""
        count = len(self._open)
        if not count:
            return 0
        state = self._state[:, :, np.arange(self._first, self._first + count) % _RING]
        there: BoolArray = state != _EMPTY
        undecided = np.zeros(count, dtype=np.bool_)
        for row, *_ in self._held.values():
            if row <= self._last:
                undecided[max(row - self._first, 0)] = True
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
            if number:
                reason = np.where((own != counter) & (reason == PRESENT), np.uint8(MIXED), reason)
            else:
                counter = own
            columns |= {name: values.reshape(reason.shape) for name, values in found.items()}
        if count and not numbered.all():
            reason = self._repeats(reason, counter, columns["stale"], numbered)
        missing = reason != PRESENT
        if missing.any():
            counter[missing] = -1
            for name, column in columns.items():
                columns[name] = np.where(missing, np.nan if column.dtype.kind == "f" else False, column)
            self.tally.missing += missing.sum(axis=0)
            self.tally.mixed += (reason == MIXED).sum(axis=0)
            self.tally.changed += (reason == CHANGED).sum(axis=0)
        if count:
            self._unsettled = missing[-1]
            self._last_counter = counter[-1]
        self.tally.rows += count
        self.tally.repeated += columns["stale"].sum(axis=0)
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
