"""Collect frames into rows: one row for each SYNC, with every finger's answer to it.

A SYNC with a counter is numbered, and each answer carries the number in 2121h: it is assigned to its row by
arithmetic, whenever it arrives, up to half the numbers late. Without numbers an answer is assumed to be that to the
last SYNC before it. A finger that was missing may still send the answer to the SYNC before; so its next row stays open
until the next SYNC, and two different answers in it are both discarded.

Frames are processed one after another: a bus gives a few at a time, for which numpy's calls cost more.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import SYNC_COB_ID
from tipforce.dictionary.signals import tpdo_messages
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.pdo_columns import PdoColumns
from tipforce.host.hand.rows import CHANGED, DOUBTFUL, MIXED, NO_ANSWER, PRESENT, Rows, Tally
from tipforce.host.hand.sync_numbers import LARGEST, RESTARTED, SyncNumbers
from tipforce.host.hand.trust import Trust

AHEAD = LARGEST // 2
"""An answer may precede its SYNC's place by so many numbers: the SYNCs between were not received."""

_UNDECIDED_WAITS = 4  # for the next SYNC, where it decides whether a value is right
_EMPTY, _LIVE, _DOUBTFUL, _CHANGED = range(4)  # states of an answer
_REASON = (NO_ANSWER, PRESENT, DOUBTFUL, CHANGED)  # by state
_ANY_NUMBER = 0, 1  # end of a count and its modulus, where the numbers of the count are not known
_NO_TIME = -math.inf  # between the frames of a call no row times out: its answer may be among them
_FIELDS = struct.Struct("<qIB3xQ")  # of FRAME: t_ns, can_id, length, data


class _Row:
    """One SYNC, and the answers to it by slot: message and finger."""

    __slots__ = ("counters", "number", "opened_s", "reasons", "received", "states", "t_ns", "words")

    def __init__(self, t_ns: int, opened_s: float, number: int, received: bool, slots: int) -> None:
        self.t_ns = t_ns
        self.opened_s = opened_s
        self.number = number
        self.received = received
        self.words = [0] * slots
        self.states = [_EMPTY] * slots
        self.reasons: list[int] = []  # by finger, when the row closes
        self.counters: list[int] = []


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
        self._wait_s = wait_s
        self._own_sync, self._numbers = own_sync, SyncNumbers(own_sync)
        self._messages = [PdoColumns(known[name]) for name in dict.fromkeys(messages)]
        fingers = len(self.node_ids)
        self._slots = fingers * len(self._messages)
        # By identifier: the slot, the finger, the length of the PDO, the place of its counter.
        self._answers = {
            message.cob_id_base + node_id: (number * fingers + k, k, message.length_bytes, message.counter_shift)
            for number, message in enumerate(self._messages)
            for k, node_id in enumerate(self.node_ids)
        }
        answers = {can_id: k for can_id, (_, k, _, _) in self._answers.items()}
        self.trust = Trust(self.node_ids, answers, known["Health"], gauges)
        self._rows: dict[int, _Row] = {}  # open ones, and emitted ones that a late answer may belong to
        # By row and slot, answers that the next SYNC decides on: the last row when it arrived, word, state if right.
        self._held: dict[tuple[int, int], tuple[int, int, int]] = {}
        self._latest = [-1] * self._slots  # the last row with an answer
        self._first = 0  # the first open row
        self._last = -1  # the row of the last SYNC
        self._epoch = 0  # the first row of this count
        # Rows that may be made of SYNCs that were not received: at most as many as SYNCs were, and LARGEST. So random
        # numbers make no flood of rows; beyond, the count is taken as restarted, and the SYNCs are counted only.
        self._gap_rows = LARGEST
        # Counts whose answers may still come: the last row, the last number, the modulus.
        self._ended: list[tuple[int, int, int]] = []
        self._absent: set[int] = set()  # fingers for which no row waits
        self._unsettled = [True] * fingers  # missing in the last row; matters without numbers
        self._last_counter = [-1] * fingers
        self._closed: list[_Row] = []  # and not emitted
        self._nothing = self._emit()

    def expect(self, node_id: int, present: bool) -> None:
        """Wait for a finger in each row, or not: one that is not operational. For any thread."""
        with self.trust.lock:
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
        with self.trust.lock:
            for t_ns, can_id, length, word in _FIELDS.iter_unpack(frames.tobytes()):
                if can_id in self._answers:
                    slot, k, least, shift = self._answers[can_id]
                    if length >= least and self._last >= 0:
                        self._answer(slot, k, word, word >> shift & 0xFF, t_ns)
                        if self._absent or min(self._latest) >= self._first:
                            self._close(_NO_TIME)
                elif can_id == SYNC_COB_ID:
                    self._sync(word & 0xFF if length == 1 else 0, t_ns, now_s)
                    self._close(_NO_TIME)
                elif can_id in self.trust.ids:
                    self.trust.note(can_id, length, word, now_s)
            self._close(now_s)
            return self._emit() if self._closed else self._nothing

    # --- SYNCs ------------------------------------------------------------------------------------------------------

    def _sync(self, number: int, t_ns: int, now_s: float) -> None:
        """Start the row of a received SYNC, and those of SYNCs between it and the last one."""
        numbers, last = self._numbers, self._last
        before, modulus, before_ns = numbers.number, numbers.modulus, numbers.last_ns
        steps = numbers.step(number, t_ns)
        number = numbers.number
        self._gap_rows = min(self._gap_rows + 1, LARGEST)
        if steps - 1 > self._gap_rows:
            self.tally.unreceived += steps - 1
            steps = RESTARTED
        if self._ended:
            self._ended = [one for one in self._ended if last - one[0] < AHEAD]
        if steps == RESTARTED:
            if last >= 0:
                # Among SYNCs that were not received, other counts may have begun and ended.
                known = before and numbers.gap_periods <= 1
                self._ended.append((last, *((before, modulus) if known else _ANY_NUMBER)))
            self._epoch = last + 1
            self._held.clear()
            steps = 1
        for k in range(1, steps):
            missed_ns = before_ns + (t_ns - before_ns) * k // steps
            missed = (number - steps + k - 1) % numbers.modulus + 1
            self._rows[last + k] = _Row(missed_ns, now_s, missed, False, self._slots)
        self.tally.unreceived += steps - 1
        self._gap_rows -= steps - 1
        self._last = last + steps
        self._rows[self._last] = _Row(t_ns, now_s, number, True, self._slots)
        if self._held:
            self._settle(last)

    def _settle(self, before: int) -> None:
        """Store the held answers that the number of this SYNC decides on; the last one was that of row ``before``.

        The count went on, so that they are right. One ahead of its SYNC is right if the SYNC was not received and it
        came in its place, else doubtful.
        """
        for (row, slot), (last, word, state) in list(self._held.items()):
            if row <= self._last:
                right = row <= last or (last == before and not self._rows[row].received)
                del self._held[row, slot]
                self._store(row, slot, word, state if right else _DOUBTFUL)

    # --- answers ----------------------------------------------------------------------------------------------------

    def _answer(self, slot: int, k: int, word: int, counter: int, t_ns: int) -> None:
        """Store an answer with ``counter``, or note that it is late, or that it can be that to no SYNC."""
        state = _LIVE if self.trust.shown[k] else _CHANGED
        row = last = self._last
        number = self._numbers.number
        held = False
        if number and not (counter == number and self._own_sync and not self._ended):
            row = self._row_of(counter, number)
            if row < 0:
                self.tally.doubtful[k] += 1
                return
            # An answer ahead of its SYNC, or perhaps to a SYNC of a restarted count which was not received.
            held = row > last or counter <= self._numbers.reachable(t_ns)
            if self._first <= row < last:
                self.tally.delayed[k] += 1
        if row < self._first or row < self._epoch:
            past = self._rows.get(row)
            if past is None or past.states[slot] != _LIVE or past.words[slot] != word:
                self.tally.late[k] += 1
                self._unsettled[k] = True
        elif held and (row > last or self._rows[row].states[slot] == _EMPTY):
            other = self._held.get((row, slot), (last, word, state))
            # Of two values for one number none is right: no row before is that one.
            self._held[row, slot] = other if other[1] == word else (row - LARGEST, word, state)
        else:
            self._store(row, slot, word, state)

    def _row_of(self, counter: int, number: int) -> int:
        """Return the row of an answer with ``counter``, received after the SYNC with ``number``; -1: it has none."""
        last, modulus = self._last, self._numbers.modulus
        if not 0 < counter <= modulus:
            return -1
        for end, ended_number, ended_modulus in self._ended:  # may be a late answer to that count
            if last - end + (ended_number - counter) % ended_modulus < AHEAD:
                return -1
        behind = (number - counter) % modulus
        return last - behind if behind < max(self._numbers.window, 1) else last - behind + modulus

    def _store(self, row: int, slot: int, word: int, state: int) -> None:
        found = self._rows[row]
        if found.states[slot] == _EMPTY:
            found.words[slot], found.states[slot] = word, state
            self._latest[slot] = max(self._latest[slot], row)
        elif found.words[slot] != word:
            found.states[slot] = _DOUBTFUL
            self.tally.doubtful[slot % len(self.node_ids)] += 1

    # --- rows -------------------------------------------------------------------------------------------------------

    def _ready(self, now_s: float) -> int:
        """Return the first row that cannot be closed yet."""
        row, last = self._first, self._last
        if row > last:
            return row
        # A node sends its answers in order: if a later one is present, the missing one is lost, and the row does not
        # wait. Rows older than the window cannot receive an answer.
        whole = self._whole()
        sure = max(self._epoch - 1, last - self._numbers.window)
        undecided = {of for of, _ in self._held} if self._held else ()
        if not self._numbers.number:  # an answer after the next SYNC is not the one to this
            sure = last - 1
            settled = all(s == _LIVE for s in self._rows[last - 1].states) if last > row else not any(self._unsettled)
            whole = whole if settled else sure
        while row <= last:
            waits = self._wait_s * (_UNDECIDED_WAITS if row in undecided else 1)
            if row > sure and (row > whole or row in undecided) and now_s - self._rows[row].opened_s < waits:
                break
            row += 1
        return row

    def _whole(self) -> int:
        """Return the last row after which each awaited finger has answered, to it or to a later one."""
        if not self._absent:
            return min(self._latest, default=self._last)
        fingers = len(self.node_ids)
        awaited = [at for slot, at in enumerate(self._latest) if slot % fingers not in self._absent]
        return min(awaited, default=self._last)

    def _close(self, now_s: float) -> None:
        """Close the rows that are ready; after each frame, so that rows do not depend on how frames are cut into calls.

        What a closed row has no longer changes: a later answer to it is late.
        """
        for number in range(self._first, self._ready(now_s)):
            row = self._rows[number]
            self._judge(row)
            self._closed.append(row)
            self._rows.pop(number - LARGEST, None)
            self._first = number + 1

    def _judge(self, row: _Row) -> None:
        """Store why each finger is missing in a row, and its counter; -1: no answer."""
        fingers = len(self.node_ids)
        reasons = [_REASON[state] for state in row.states[:fingers]]
        shift = self._messages[0].counter_shift
        counters = [word >> shift & 0xFF for word in row.words[:fingers]]
        if len(self._messages) > 1:
            self._join(row, reasons, counters)
        if not row.number:
            self._find_repeats(row, reasons, counters)
        if any(reasons):
            counters = [-1 if why == NO_ANSWER else own for why, own in zip(reasons, counters, strict=True)]
            self._unsettled = [why != PRESENT for why in reasons]
        elif not row.number:
            self._unsettled = [False] * fingers
        row.reasons, row.counters = reasons, counters
        self._last_counter = counters

    def _join(self, row: _Row, reasons: list[int], counters: list[int]) -> None:
        """Add the reasons of the messages after the first."""
        fingers = len(self.node_ids)
        for at in range(fingers, self._slots):
            k, why = at % fingers, _REASON[row.states[at]]
            reasons[k] = max(reasons[k], why)
            if (
                reasons[k] == PRESENT
                and row.words[at] >> self._messages[at // fingers].counter_shift & 0xFF != counters[k]
            ):
                reasons[k] = MIXED

    def _find_repeats(self, row: _Row, reasons: list[int], counters: list[int]) -> None:
        """Without numbers: a counter that stands still and is not marked stale is that of a duplicate."""
        fingers, stale = len(self.node_ids), self._messages[-1].stale_mask
        words = row.words[-fingers:]
        for k, before in enumerate(self._last_counter):
            if counters[k] == before and reasons[k] == PRESENT and not words[k] & stale:
                reasons[k] = DOUBTFUL
                self.tally.doubtful[k] += 1

    def _emit(self) -> Rows:
        """Return the closed rows."""
        rows, self._closed = self._closed, []
        count, fingers = len(rows), len(self.node_ids)
        columns: dict[str, npt.NDArray[Any]] = {}
        for number, message in enumerate(self._messages):
            part = slice(number * fingers, (number + 1) * fingers)
            words = [word for row in rows for word in row.words[part]]
            columns |= {name: values.reshape(count, fingers) for name, values in message.columns(words).items()}
        counter = np.array([row.counters for row in rows], dtype=np.int64).reshape(count, fingers)
        reason = np.array([row.reasons for row in rows], dtype=np.uint8).reshape(count, fingers)
        if reason.any():
            missing = reason != PRESENT
            counter[missing] = -1
            for name, column in columns.items():
                columns[name] = np.where(missing, np.nan if column.dtype.kind == "f" else False, column)
            self.tally.missing += missing.sum(axis=0)
            self.tally.mixed += (reason == MIXED).sum(axis=0)
            self.tally.changed += (reason == CHANGED).sum(axis=0)
        self.tally.repeated += columns["stale"].sum(axis=0)
        self.tally.rows += count
        numbered = np.array([row.number > 0 for row in rows], dtype=np.bool_)
        sync_ns = np.array([row.t_ns for row in rows], dtype=np.int64)
        return Rows(self._first - count, sync_ns, numbered, counter, reason, columns)
