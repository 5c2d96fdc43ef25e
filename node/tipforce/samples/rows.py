"""The samples of a SYNC become a row of a hand. An answer belongs to its row by the number in 2121h, up to half the
numbers late; without numbers it is to the last SYNC, and after a missing answer the row stays open until the next SYNC:
two different answers in it are discarded. While all answers come in turn, the compiled core makes the rows."""

import math
import struct
import threading
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from canopen_device.core.codes import STANDARD_MASK, SYNC_COB_ID
from tipforce.arrays import IntArray
from tipforce.core import core
from tipforce.dictionary.signals import tpdo_messages
from tipforce.host.frames.frame_array import FIELDS, FrameArray
from tipforce.samples.reasons import CHANGED, DOUBTFUL, MIXED, NO_RESPONSE, PRESENT
from tipforce.samples.record import Pdo, Row, Rows
from tipforce.samples.sync_numbers import LARGEST, RESTARTED, SyncNumbers

AHEAD = LARGEST // 2
"""An answer may precede its SYNC's place by so many numbers: the SYNCs between were not received."""

_UNDECIDED_WAITS = 4  # for the next SYNC, where it decides whether a value is right
_EMPTY, _LIVE, _DOUBTFUL, _CHANGED = range(4)  # states of an answer
_REASON = (NO_RESPONSE, PRESENT, DOUBTFUL, CHANGED)  # by state
_ANY_NUMBER = 0, 1  # end of a count and its modulus, where the numbers of the count are not known
_NO_TIME = -math.inf  # between the frames of a call no row times out: its answer may be among them
_STEADY, _OPENED, _ANSWER = 10, slice(8, 9), struct.Struct("<Qqq")  # Steady and Answer of _core.c
_WORD_MASK = (1 << 64) - 1


@dataclass(slots=True)
class RowTally:
    """Counts since the start of the rows; arrays have one element per finger."""

    node_ids: tuple[int, ...]
    rows: int = 0
    unreceived: int = 0
    """SYNCs that were not received: their numbers were left out. Each has a row, up to a bound."""
    missing: IntArray = field(init=False)
    """Rows without a certain, complete answer."""
    delayed: IntArray = field(init=False)
    """Answers that arrived after the next SYNC, and were assigned to their own row by its number."""
    late: IntArray = field(init=False)
    """Answers that arrived after their row was emitted."""
    mixed: IntArray = field(init=False)
    """Rows whose PDOs are from two samples; not possible where rows are numbered."""
    repeated: IntArray = field(init=False)
    """Rows whose sample the node marks stale: the SYNC is faster than its converter."""
    doubtful: IntArray = field(init=False)
    """Values discarded because another one has the same number, or because their number is that of no SYNC."""
    changed: IntArray = field(init=False)
    """Rows whose value is not shown, because its meaning was changed and not verified since."""

    def __post_init__(self) -> None:
        zeros = np.zeros((7, len(self.node_ids)), dtype=np.int64)
        self.missing, self.delayed, self.late, self.mixed, self.repeated, self.doubtful, self.changed = zeros


class _OpenRow:
    """One SYNC, and the answers to it by slot: message and finger. ``number`` 0: the SYNC has none."""

    __slots__ = ("number", "opened_s", "reasons", "received", "stale", "states", "t_ns", "words")

    def __init__(self, t_ns: int, opened_s: float, number: int, received: bool, slots: int) -> None:
        self.t_ns, self.opened_s, self.number, self.received = t_ns, opened_s, number, received
        self.stale = False  # an answer is
        self.words, self.states = [0] * slots, [0] * slots
        self.reasons: Sequence[int] = ()  # by finger, when the row closes


class RowAssembler:
    """Rows of the PDOs ``messages`` (names) of the fingers ``node_ids``. A row that is incomplete ``wait_s`` after its
    SYNC was received is emitted incomplete. ``own_sync``: the host sends the SYNC."""

    def __init__(
        self, node_ids: Sequence[int], messages: Sequence[str] = ("Contact",), gauges: int = 3,
        wait_s: float = 0.02, own_sync: bool = False,
    ) -> None:  # fmt: skip
        known = {m.name: m for m in tpdo_messages(gauges) if m.cob_id_base}
        self.node_ids = tuple(node_ids)
        self.tally = RowTally(self.node_ids)
        self.lock = threading.Lock()
        self.shown = [True] * len(self.node_ids)
        """By finger: its values are shown; else they are marked CHANGED."""
        self._wait_s = wait_s
        self._own_sync, self._numbers = own_sync, SyncNumbers(own_sync)
        self._pdos = [Pdo(known[name]) for name in dict.fromkeys(messages)]
        fingers = len(self.node_ids)
        self._slots = fingers * len(self._pdos)
        # By identifier: slot (message and finger), finger, length of the PDO, place of its counter, mask of stale.
        self._answers = {}
        for number, pdo in enumerate(self._pdos):
            stale = pdo.stale_mask if pdo is self._pdos[-1] else 0
            for k, node_id in enumerate(self.node_ids):
                answer = number * fingers + k, k, pdo.message.length_bytes, pdo.counter_shift, stale
                self._answers[pdo.message.cob_id_base + node_id] = answer
        self._rows: dict[int, _OpenRow] = {}  # open ones, and closed ones of which the next SYNC decides an answer
        self._past: deque[Row] = deque(maxlen=LARGEST)  # the last ones, to which a late answer may belong
        # By row and slot, answers that the next SYNC decides on: the last row when it arrived, word, state if right.
        self._held: dict[tuple[int, int], tuple[int, int, int]] = {}
        self._latest = [-1] * self._slots  # the last row with an answer
        self._first = 0  # the first open row
        self._last = -1  # the row of the last SYNC
        self._current = _OpenRow(0, 0.0, 0, False, self._slots)  # of that SYNC
        self._direct = -1  # an answer with this counter is to that SYNC
        self._epoch = 0  # the first row of this count
        # Rows that may be made of SYNCs that were not received: at most as many as SYNCs were, and LARGEST. So random
        # numbers make no flood of rows; beyond, the count is taken as restarted, and the SYNCs are counted only.
        self._gap_rows = LARGEST
        # Counts whose answers may still come: the last row, the last number, the modulus.
        self._ended: list[tuple[int, int, int]] = []
        self._absent: set[int] = set()  # fingers for which no row waits
        self._awaited = self._slots  # slots without an answer to the first open row or a later one
        self._opened_s = math.inf  # of the first open row
        self._changed = False  # by another thread: rows may be ready
        self._unsettled = [True] * fingers  # missing in the last row; matters without numbers
        self._all_live, self._all_present = [_LIVE] * self._slots, (PRESENT,) * fingers
        self._closed: list[Row] = []  # and not emitted
        self._nothing = Rows(0, [], self.node_ids, self._pdos)
        self._inside = False  # the core has the state
        self._of_core: tuple[object, ...] = ()  # what each of its calls needs
        slot_of = array("H", bytes(2 * (STANDARD_MASK + 1)))
        for can_id, (slot, *_) in self._answers.items():
            slot_of[can_id] = slot + 1
        answers = [_ANSWER.pack(stale, least, shift) for _, _, least, shift, stale in sorted(self._answers.values())]
        self._steady = array("q", bytes(8 * (_STEADY + 2 * self._slots)) + b"".join(answers) + slot_of.tobytes())

    def expect(self, node_id: int, present: bool) -> None:
        """Wait for a finger in each row, or not: one that is not operational. For any thread."""
        with self.lock:
            self._leave()
            (self._absent.discard if present else self._absent.add)(self.node_ids.index(node_id))
            self._await()
            self._changed = True

    def restart(self) -> int:
        """End the open rows; return the number of the next SYNC, far from those that late answers may have."""
        with self.lock:
            self._leave()
            self._numbers.number = (self._numbers.number + AHEAD) % LARGEST or LARGEST
            self._epoch, self._direct, self._changed = self._last + 1, -1, True
            return self._numbers.number % LARGEST + 1

    def add(self, frames: FrameArray, now_s: float) -> Rows:
        """Process received frames, FRAME (n,); return the rows that are complete or timed out, often none. ``now_s`` is
        a monotonic time. Call it without frames too, to detect an unanswered SYNC."""
        data = frames.tobytes()
        with self.lock:
            if self._inside or self._enter():
                closed = self._closed
                done = core.rows(data, now_s, closed, self._of_core)
                if closed:
                    self._past.extend(closed)
                if done != len(data):
                    self._leave()
                data = data[done:]
            if data:
                self._process(data, now_s)
            if self._changed or now_s - self._opened_s >= self._wait_s:
                self._leave()
                self._changed = False
                self._close(now_s)
            if not self._closed:
                return self._nothing
            rows, self._closed = self._closed, []
            first = self.tally.rows
            self.tally.rows = first + len(rows)
            return Rows(first, rows, self.node_ids, self._pdos)

    def _process(self, data: bytes, now_s: float) -> None:
        place_of = self._answers.get
        for t_ns, can_id, length, word in FIELDS.iter_unpack(data):
            place = place_of(can_id)
            if place is None:
                if can_id == SYNC_COB_ID:
                    self._sync(word & 0xFF if length == 1 else 0, t_ns, now_s)
                else:
                    self._other(t_ns, can_id, length, word, now_s)
                continue
            slot, k, least, shift, stale = place
            if length < least or self._last < 0:
                continue
            row, counter = self._current, word >> shift & 0xFF
            if counter == self._direct and not row.states[slot] and self.shown[k] and self._first <= self._last:
                row.words[slot], row.states[slot] = word, _LIVE
                if word & stale:
                    row.stale = True
                if self._latest[slot] < self._first:
                    self._awaited -= 1
                self._latest[slot] = self._last
            else:
                self._answer(slot, k, word, counter, t_ns)
            if not self._awaited or self._absent:
                self._close(_NO_TIME)

    def _other(self, t_ns: int, can_id: int, length: int, word: int, now_s: float) -> None:
        """Take a frame that is neither a SYNC nor an answer; ``word``: its data, little-endian."""

    def _enter(self) -> bool:
        """Give the state to the core, if no row is open and all is as it should be; return whether it has it."""
        numbers = self._numbers
        clean = self._first > self._last >= 0 and self._own_sync and numbers.number and numbers.modulus > 1
        if core is None or not clean or self._held or self._ended or self._absent or self._changed:
            return False
        state = 0, self._last, numbers.number, numbers.modulus, numbers.last_ns, numbers.period_ns, self._gap_rows, 0
        self._steady[:_STEADY] = array("q", struct.pack("<8q2d", *state, math.inf, self._wait_s))
        self._of_core = self._steady, LARGEST, self.shown, self._other, self._all_present, self._all_live
        self._inside = True
        return True

    def _leave(self) -> None:
        if not self._inside:
            return
        self._inside = False
        state, slots, numbers = self._steady, self._slots, self._numbers
        is_open, self._last, numbers.number, numbers.modulus, numbers.last_ns, numbers.period_ns = state[:6]
        self._gap_rows, self._awaited, self._direct = state[6], slots, numbers.number
        self._first, self._latest[:] = self._last + 1, [self._last] * slots
        if is_open:
            (opened_s,) = struct.unpack("<d", state[_OPENED].tobytes())
            row = _OpenRow(numbers.last_ns, opened_s, numbers.number, True, slots)
            words, present = state[_STEADY : _STEADY + slots], state[_STEADY + slots : _STEADY + 2 * slots]
            row.states = [_LIVE if is_present else _EMPTY for is_present in present]
            row.words = [word & _WORD_MASK if known else 0 for word, known in zip(words, present, strict=True)]
            self._first, self._awaited, self._current = self._last, state[7], row
            self._opened_s = row.opened_s
            self._rows = {self._last: row}  # answers are held for none
            self._latest[:] = [self._last - (not is_present) for is_present in present]

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
            self._ended = [count for count in self._ended if last - count[0] < AHEAD]
        if steps == RESTARTED:
            if last >= 0:
                # Among SYNCs that were not received, other counts may have begun and ended.
                known = before and numbers.gap_periods <= 1
                self._ended.append((last, *((before, modulus) if known else _ANY_NUMBER)))
            self._epoch = last + 1
            self._held.clear()
            steps = 1
        if steps > 1:
            self._missed(steps, before_ns, t_ns, now_s)
        self._last = last + steps
        self._current = self._rows[self._last] = _OpenRow(t_ns, now_s, number, True, self._slots)
        self._opened_s = min(self._opened_s, now_s)
        self._direct = number if number and self._own_sync and not (self._ended or self._absent) else -1
        if self._held:
            self._settle(last)
        if self._first < self._last or not self._awaited:
            self._close(_NO_TIME)

    def _missed(self, steps: int, before_ns: int, t_ns: int, now_s: float) -> None:
        """Start the rows of SYNCs that were not received: those after the last row, and before the ``steps``-th."""
        for k in range(1, steps):
            missed_ns = before_ns + (t_ns - before_ns) * k // steps
            missed = (self._numbers.number - steps + k - 1) % self._numbers.modulus + 1
            self._rows[self._last + k] = _OpenRow(missed_ns, now_s, missed, False, self._slots)
        self.tally.unreceived += steps - 1
        self._gap_rows -= steps - 1

    def _settle(self, before: int) -> None:
        """Store the held answers that the number of this SYNC decides on; the last one was that of row ``before``. One
        ahead of its SYNC is right if the SYNC was not received and it came in its place, else doubtful."""
        for (row, slot), (last, word, state) in list(self._held.items()):
            if row <= self._last:
                right = row <= last or (last == before and not self._rows[row].received)
                del self._held[row, slot]
                self._store(row, slot, word, state if right else _DOUBTFUL)

    def _answer(self, slot: int, k: int, word: int, counter: int, t_ns: int) -> None:
        """Store an answer with ``counter``, or note that it is late, or that it can be that to no SYNC."""
        state = _LIVE if self.shown[k] else _CHANGED
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
            words: Sequence[int] = self._rows[row].words if row >= self._first else ()
            states: Sequence[int] = self._rows[row].states if row >= self._first else ()
            if -len(self._past) <= row - self._first < 0:
                *_, words, _, states = self._past[row - self._first]
            if not states or states[slot] != _LIVE or words[slot] != word:
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

    def _store(self, number: int, slot: int, word: int, state: int) -> None:
        row, k = self._rows[number], slot % len(self.node_ids)
        if row.states[slot] == _EMPTY:
            row.words[slot], row.states[slot] = word, state
            row.stale = row.stale or bool(self._pdos[-1].stale_mask & word)
            if self._latest[slot] < number:
                if self._latest[slot] < self._first <= number and k not in self._absent:
                    self._awaited -= 1
                self._latest[slot] = number
        elif row.words[slot] != word:
            row.states[slot] = _DOUBTFUL
            self.tally.doubtful[k] += 1

    def _ready(self, now_s: float) -> int:
        row, last = self._first, self._last
        if row > last:
            return row
        if row == last and not (self._awaited or self._held) and self._numbers.number:
            return row + 1
        # A node sends its answers in order: if a later one is present, the missing one is lost, and the row does not
        # wait. Rows older than the window cannot receive an answer.
        fingers = len(self.node_ids)
        awaited = (at for slot, at in enumerate(self._latest) if slot % fingers not in self._absent)
        whole = min(awaited if self._absent else self._latest, default=last)
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

    def _await(self) -> None:
        first, fingers = self._first, len(self.node_ids)
        if not self._absent and max(self._latest, default=-1) < first:
            self._awaited = self._slots
        else:
            missing = (slot for slot, at in enumerate(self._latest) if at < first)
            self._awaited = sum(slot % fingers not in self._absent for slot in missing)
        self._opened_s = self._rows[first].opened_s if first <= self._last else math.inf
        if self._absent:
            self._direct = -1

    def _close(self, now_s: float) -> None:
        """Close the rows that are ready; after each frame, so that rows do not depend on how frames are cut into calls.
        What a closed row has no longer changes: a later answer to it is late."""
        end = self._ready(now_s)
        for number in range(self._first, end):
            row = self._rows[number]
            self._rows.pop(number - LARGEST, None)
            self._judge(row)
            self._closed.append((row.t_ns, row.number, row.words, row.reasons, row.states))
            self._past.append(self._closed[-1])
        if end > self._first:
            self._first = end
            self._await()

    def _judge(self, row: _OpenRow) -> None:
        if row.states == self._all_live and row.number and len(self._pdos) == 1:
            row.reasons = self._all_present
        else:
            fingers = len(self.node_ids)
            row.reasons = why = [_REASON[state] for state in row.states[:fingers]]
            if len(self._pdos) > 1:
                self._join(row, why)
            if not row.number:
                self._find_repeats(row, why)
            if any(why):
                self._unsettled = [reason != PRESENT for reason in why]
                for k, reason in enumerate(why):
                    self.tally.missing[k] += reason != PRESENT
                    self.tally.mixed[k] += reason == MIXED
                    self.tally.changed[k] += reason == CHANGED
            elif not row.number:
                self._unsettled = [False] * fingers
        if row.stale:
            for k, word in enumerate(row.words[-len(self.node_ids) :]):
                if word & self._pdos[-1].stale_mask and row.reasons[k] == PRESENT:
                    self.tally.repeated[k] += 1

    def _join(self, row: _OpenRow, why: list[int]) -> None:
        counters, fingers = self._counters(row.words), len(self.node_ids)
        for at in range(fingers, self._slots):
            k = at % fingers
            why[k] = max(why[k], _REASON[row.states[at]])
            if why[k] == PRESENT and row.words[at] >> self._pdos[at // fingers].counter_shift & 0xFF != counters[k]:
                why[k] = MIXED

    def _find_repeats(self, row: _OpenRow, why: list[int]) -> None:
        """Without numbers: a counter that stands still and is not marked stale is that of a duplicate."""
        if not self._past:
            return
        *_, words_before, reasons_before, _ = self._past[-1]
        counters = self._counters(row.words)
        words, stale = row.words[-len(self.node_ids) :], self._pdos[-1].stale_mask
        for k, counter in enumerate(self._counters(words_before)):
            if reasons_before[k] == NO_RESPONSE:
                continue
            if counters[k] == counter and why[k] == PRESENT and not words[k] & stale:
                why[k] = DOUBTFUL
                self.tally.doubtful[k] += 1

    def _counters(self, words: Sequence[int]) -> list[int]:
        shift = self._pdos[0].counter_shift
        return [word >> shift & 0xFF for word in words[: len(self.node_ids)]]
