"""Whether the hand knows what its fingers' values mean, judged from the frames in order. ``known``: what it accepted of
each watched object. A download or command makes what it may change unsure, until an SDO response or a health PDO tells;
values are shown while none is unsure. On changes ``foreign_changes`` decides."""

import math
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from canopen_device.core import codes, communication, emcy
from tipforce.dictionary import indices, objects, table
from tipforce.dictionary.names import entries
from tipforce.dictionary.signals import Message
from tipforce.host.configuration.device_objects import Place
from tipforce.samples.reasons import NO_RESPONSE, PRESENT

VERIFY_S = 0.02  # from the last request of another to the reading: a node has one SDO server, which both would use
DECIDE_S = 0.25  # the same where something was changed, a long transfer is open, or the node restarts
_AGAIN_S = 0.1  # between two readings
_LATER_S = 5.0  # to the reading of what has no part in the values, after a boot
_TRANSFER_S = 0.5  # a download without a response for so long has none
_SETTLED_S, _SETTLED_ROWS = 1.0, 5  # without a row for so long, or a value in so many, it is not settled
_UNANSWERED_ROWS = 20  # rows without an answer: these are not frames that were lost
_ORDER_S = 0.01  # a response so soon after a command may be to a request before it
_LSS_CONFIGURES = (codes.LSS_NODE_ID, codes.LSS_BIT_TIMING, codes.LSS_ACTIVATE, codes.LSS_STORE)
_ANY = range(1, 9)  # data lengths
_ABORT, _BLOCK_END = 0x80, 0xA1  # first byte of an SDO abort, and of the last response to a block download


COUNTER, SERIAL = objects.CONFIGURATION_COUNTER.key, objects.IDENTITY_SERIAL.key
COMMANDED = (objects.CALIBRATION_ACTIVE_CRC, objects.TARE_F1, objects.TARE_F2, objects.TARE_F3)
"""What commands change, besides the offsets."""


@dataclass(slots=True)
class Finger:
    """What is known of one finger."""

    node_id: int
    column: int
    """Its place among the fingers."""
    known: Mapping[Place, int] = field(default_factory=dict)
    seen: dict[Place, int] = field(default_factory=dict)
    unsure: set[Place] = field(default_factory=set)
    asked: frozenset[Place] = frozenset()
    asked_s: float = 0.0  # when they are to be read
    hidden: bool = False  # the hand itself configures it, or is going to
    changed: bool = False  # something was seen otherwise
    announced: bool = False  # that is an event
    pending: bool = False  # to be verified
    due_s: float = 0.0
    # By object, the identifiers that it may send, though it should not; None: any.
    claims: dict[Place, set[int | None]] = field(default_factory=dict)
    place: Place | None = None  # of the last download
    transfer: frozenset[Place] = frozenset()  # what that may change
    flight_s: float = -math.inf
    block_until_s: float = -math.inf
    health_s: float = math.inf
    answered_row: int = 0
    answered_s: float = math.inf  # the time of the last answer
    unanswered: bool = False  # that there is none is an event
    shown_row: int = 0


class Trust:
    """``answers``: place in ``node_ids`` by identifier. ``ids`` are the identifiers that ``note`` wants. Every method
    takes ``lock``, except ``note``, whose caller has it. ``shown[k]``: the values of finger k are shown."""

    def __init__(self, node_ids: Sequence[int], answers: Mapping[int, int], health: Message, gauges: int) -> None:
        self.lock = threading.Lock()
        self.shown = [True] * len(node_ids)
        self._fingers = {node_id: Finger(node_id, k) for k, node_id in enumerate(node_ids)}
        self._answers = {health.cob_id_base + n: k for k, n in enumerate(node_ids)} | dict(answers)
        self._rows, self._real_rows = entries(gauges, True), entries(gauges)
        self._shift = next(s.start_bit for s in health.signals if s.index == indices.CONFIGURATION_COUNTER)
        offsets = [place for place in self._real_rows if place[0] == indices.PROCESS_OFFSET and place[1]]
        self._commanded = frozenset((COUNTER, *(entry.key for entry in COMMANDED), *offsets))
        self._row, self._row_s, self._period_s, self._now_s = 0, -math.inf, 0.0, 0.0
        self._is_whole = False  # the last row has the answers of all, which the fingers do not have yet
        self._fixed: dict[int, tuple[Callable[[int, float], None], range]] = {
            codes.NMT_COB_ID: (self._nmt, range(2, 9)),
            codes.LSS_REQUEST_COB_ID: (self._lss, _ANY),
        }
        for node_id, finger in self._fingers.items():
            self._fixed |= {
                health.cob_id_base + node_id: (partial(self._health, finger), range(health.length_bytes, 9)),
                codes.EMCY_BASE + node_id: (partial(self._emcy, finger), range(8, 9)),
                codes.HEARTBEAT_BASE + node_id: (partial(self._heartbeat, finger), range(1, 2)),
                codes.SDO_RESPONSE_BASE + node_id: (partial(self._response, finger), range(8, 9)),
                codes.SDO_REQUEST_BASE + node_id: (partial(self._request, finger), _ANY),
                codes.RPDO_BASES[0] + node_id: (partial(self._command, finger), _ANY),
            }
        self.ids = dict(self._fixed)

    # --- for the thread that recovers -----------------------------------------------------------------------------

    def hide(self, node_id: int) -> None:
        """Show no values before ``learn``: the hand configures the finger itself."""
        with self.lock:
            self._fingers[node_id].hidden = True
            self._judge()

    def known(self, node_id: int) -> Mapping[Place, int]:
        """Return what a finger is known to send; nothing before ``learn``."""
        return self._fingers[node_id].known

    def learn(self, node_id: int, known: Mapping[Place, int], later: Collection[Place] = ()) -> None:
        """Show values while each object is seen as in ``known``, in frames that may still wait to be processed.
        ``later``: objects that are still to be read; values are shown meanwhile."""
        with self.lock:
            finger = self._fingers[node_id]
            finger.known, finger.hidden, finger.changed, finger.announced = known, False, False, False
            finger.asked, finger.asked_s = frozenset(later).difference(finger.seen), self._now_s + _LATER_S
            finger.unsure = {place for place, value in known.items() if finger.seen.get(place) != value} - finger.asked
            for place in finger.unsure:
                finger.seen.pop(place, None)
            finger.claims = {place: values for place, values in finger.claims.items() if values != {known.get(place)}}
            finger.pending, finger.due_s = bool(finger.unsure), self._now_s + _AGAIN_S
            self.ids = dict(self._fixed)
            for other in self._fingers.values():
                cob_id = other.known.get((communication.RPDO, 1), codes.COB_ID_INVALID)
                if not cob_id & codes.COB_ID_INVALID:
                    self.ids.setdefault(cob_id & codes.STANDARD_MASK, (partial(self._command, other), _ANY))
            self._judge()

    def refuse(self, node_id: int, changed: Collection[Place]) -> None:
        """Keep values unknown until these objects are seen as they are known."""
        with self.lock:
            finger = self._fingers[node_id]
            finger.hidden, finger.pending, finger.changed, finger.announced = False, False, True, True
            finger.unsure |= set(changed)
            self._judge()

    def suspect(self, node_ids: Collection[int], places: Collection[Place] | None = None) -> None:
        """Make objects (None: all) of fingers unsure: another may have changed them unseen."""
        with self.lock:
            for node_id in node_ids:
                finger = self._fingers[node_id]
                self._doubt(finger, finger.known if places is None else places, -math.inf)
            self._judge()

    def give_up(self, node_id: int) -> None:
        """Do not verify a silent finger again before it sends; what is unsure remains so."""
        with self.lock:
            self._fingers[node_id].pending = False

    def unsure(self, node_id: int) -> list[Place]:
        """Return the objects to read; 2126h at least."""
        with self.lock:
            finger = self._fingers[node_id]
            places, finger.asked = finger.unsure | finger.asked | {COUNTER}, frozenset()
            return sorted(places, key=lambda place: (place == COUNTER, place))

    def ask(self, node_id: int, places: Collection[Place]) -> None:
        """Read these objects with those that are unsure; values are shown meanwhile."""
        with self.lock:
            finger = self._fingers[node_id]
            finger.asked = frozenset(place for place in places if place in finger.known)

    def changed(self, node_id: int) -> bool:
        """Return whether a change is to be decided on."""
        with self.lock:
            return self._fingers[node_id].changed and self._fingers[node_id].pending

    # --- for the thread that receives -----------------------------------------------------------------------------

    def take_changes(self) -> list[int]:
        """Return the fingers of which a change was seen since the last call."""
        with self.lock:
            changed = [finger for finger in self._fingers.values() if finger.changed and not finger.announced]
            for finger in changed:
                finger.announced = True
            return [finger.node_id for finger in changed]

    def due(self, now_s: float, health_s: float) -> tuple[list[int], list[int]]:
        """Return the fingers to verify now: unsure ones, and those whose health PDO did not come for ``health_s``; and
        those of which objects are to be read while values are shown, each once."""
        with self.lock:
            self._now_s, due = now_s, []
            for finger in self._fingers.values():
                if not finger.known or finger.hidden:
                    finger.health_s = now_s
                    continue
                unverified = finger.pending and (finger.unsure or finger.changed) and now_s >= finger.due_s
                if unverified or now_s - min(finger.health_s, now_s) > health_s:
                    finger.due_s = now_s + (DECIDE_S if finger.changed else _AGAIN_S)
                    finger.health_s = now_s
                    due.append(finger.node_id)
            others = (finger for finger in self._fingers.values() if finger.node_id not in due)
            asked = [finger for finger in others if finger.asked and now_s >= finger.asked_s]
            for finger in asked:
                finger.asked_s = math.inf
            return due, [finger.node_id for finger in asked]

    def shows(self, node_id: int) -> bool:
        """Return whether the values of a finger are shown."""
        return self.shown[self._fingers[node_id].column]

    def count_rows(self, reasons: Sequence[Sequence[int]], now_s: float) -> None:
        """Note the reasons of rows, by finger."""
        with self.lock:
            self._row += len(reasons)
            if not any(map(any, reasons)):  # nearly always: all are PRESENT
                self._period_s, self._row_s, self._is_whole = min(now_s - self._row_s, 10.0), now_s, True
                return
            self._note_whole(len(reasons))
            self._period_s, self._row_s = min(now_s - self._row_s, 10.0), now_s
            for finger, of_finger in zip(self._fingers.values(), zip(*reasons, strict=True), strict=True):
                if PRESENT in of_finger:
                    finger.shown_row = self._row
                if of_finger.count(NO_RESPONSE) < len(of_finger) or not self.shown[finger.column]:
                    finger.answered_row, finger.answered_s, finger.unanswered = self._row, now_s, False

    def _note_whole(self, later_rows: int = 0) -> None:
        if self._is_whole:
            self._is_whole, row = False, self._row - later_rows
            for finger in self._fingers.values():
                finger.shown_row = finger.answered_row = row
                finger.answered_s, finger.unanswered = self._row_s, False

    def take_unanswered(self, now_s: float, limit_s: float) -> list[int]:
        """Return the verified fingers that answered no SYNC for so long; each once, until it answers again."""
        with self.lock:
            self._note_whole()
            silent = [
                finger
                for finger in self._fingers.values()
                if self.shown[finger.column]
                and not finger.unanswered
                and self._row - finger.answered_row >= _UNANSWERED_ROWS
                and now_s - finger.answered_s > limit_s
            ]
            for finger in silent:
                finger.unanswered = True
            return [finger.node_id for finger in silent]

    def settled(self, now_s: float) -> bool:
        """Return whether rows come, and all fingers are in them."""
        with self.lock:
            self._note_whole()
            come = now_s - self._row_s < max(_SETTLED_S, 3.0 * self._period_s)
            return come and all(
                self.shown[finger.column] and self._row - finger.shown_row < _SETTLED_ROWS
                for finger in self._fingers.values()
            )

    def note(self, can_id: int, length: int, word: int, now_s: float) -> None:
        """Process a frame whose identifier is in ``ids``; ``word`` is its data, little-endian."""
        handle, lengths = self.ids[can_id]
        if length in lengths:
            handle(word, now_s)
            self._judge()

    def _nmt(self, word: int, now_s: float) -> None:
        command, node_id = word & 0xFF, word >> 8 & 0xFF
        for finger in self._fingers.values():
            if node_id in (0, finger.node_id):
                restarts = command in (codes.NMT_RESET_NODE, codes.NMT_RESET_COMMUNICATION)
                if restarts:
                    self._forget(finger)
                self._doubt(finger, (COUNTER,), now_s, DECIDE_S if restarts else VERIFY_S)

    def _lss(self, word: int, now_s: float) -> None:
        if word & 0xFF in _LSS_CONFIGURES:  # of which node the frame does not say
            for finger in self._fingers.values():
                self._doubt(finger, (SERIAL, COUNTER), now_s)

    def _command(self, finger: Finger, word: int, now_s: float) -> None:
        if word:  # an RPDO; command 0 is none
            self._doubt(finger, self._commanded, now_s)

    def _emcy(self, _finger: Finger, word: int, now_s: float) -> None:
        if word & 0xFFFF == emcy.COB_ID_COLLISION:  # of two senders one may be another finger
            for finger in self._fingers.values():
                self._doubt(finger, {COUNTER, SERIAL, *filter(_sends, finger.known)}, now_s)

    def _heartbeat(self, finger: Finger, word: int, _now_s: float) -> None:
        if not word & 0xFF and finger.known:  # a boot-up: it is set up again
            self._forget(finger)
            finger.hidden, finger.pending = True, False

    def _health(self, finger: Finger, word: int, now_s: float) -> None:
        finger.health_s = now_s
        self._observe(finger, COUNTER, word >> self._shift & 0xFF, now_s)

    def _response(self, finger: Finger, word: int, now_s: float) -> None:
        first, place = word & 0xFF, _place(word)
        if first >> 5 == 2 and first & 2:  # an expedited upload
            size = 4 - (first >> 2 & 3) if first & 1 else 4
            self._observe(finger, place, word >> 32 & (1 << 8 * size) - 1, now_s)
        elif first >> 5 in (1, 5) or (first in (0x60, _ABORT) and place == finger.place):
            finger.flight_s = -math.inf  # of a download: what is read after it is what is there
            if first in (_ABORT, _BLOCK_END):
                finger.block_until_s = -math.inf

    def _request(self, finger: Finger, word: int, now_s: float) -> None:
        """Process an SDO request to a finger: a download, or a part of one, makes what it may change unsure."""
        first, specifier = word & 0xFF, word >> 5 & 7
        in_block = now_s < finger.block_until_s  # a segment of a block may begin with any byte
        if specifier in (3, 5) or (specifier == 2 and _place(word) not in finger.known):
            finger.due_s = max(finger.due_s, now_s + DECIDE_S)  # a long upload, which a reading would end
        if in_block and first == _ABORT:
            finger.block_until_s = -math.inf
        elif in_block or specifier == 0:
            if first != 0x40:  # an upload by another: then nobody sends a block
                self._doubt(finger, finger.transfer, now_s, DECIDE_S)
                finger.flight_s = now_s
                finger.block_until_s = now_s + _TRANSFER_S if in_block else -math.inf
        elif specifier in (1, 6):
            finger.place = _place(word)
            finger.transfer = self._changed_by(finger, finger.place)
            expedited = specifier == 1 and first & 2
            self._doubt(finger, finger.transfer, now_s, VERIFY_S if expedited else DECIDE_S)
            finger.flight_s = now_s
            if _sends(finger.place):
                finger.claims.setdefault(finger.place, set()).add(word >> 32 if expedited else None)
            finger.block_until_s = now_s + _TRANSFER_S if specifier == 6 else -math.inf

    def _changed_by(self, finger: Finger, place: Place) -> frozenset[Place]:
        row = self._rows.get(place)
        if row is not None and place not in self._real_rows:
            return frozenset()  # the load on a simulated finger
        if row is not None and row.flags & table.VIEW:
            place = indices.FIELD_VALUE & 0xF000 | row.index & 0xFFF, row.sub
        if place in finger.known:
            return frozenset((place, COUNTER))
        if row is None or row.access == "wo" or row.flags & table.RPDO:  # a command
            return self._commanded
        return frozenset((COUNTER,))

    def _doubt(self, finger: Finger, places: Collection[Place], now_s: float, after_s: float = VERIFY_S) -> None:
        if not places:
            return
        for place in places:
            finger.seen.pop(place, None)
        finger.unsure.update(place for place in places if place in finger.known)
        finger.flight_s = max(finger.flight_s, now_s + _ORDER_S - _TRANSFER_S)
        finger.pending, finger.due_s = True, now_s + (DECIDE_S if finger.changed else after_s)

    def _forget(self, finger: Finger) -> None:
        """Nothing of a finger is sure; an identifier that it claims remains so."""
        finger.seen.clear()
        finger.unsure = set(finger.known)

    def _observe(self, finger: Finger, place: Place, value: int, now_s: float) -> None:
        before, known = finger.seen.get(place), finger.known.get(place, value)
        if value == known and now_s - finger.flight_s <= _TRANSFER_S:
            return  # perhaps the response to a request before the download
        finger.seen[place] = value
        if value == known:
            finger.claims.pop(place, None)
        elif _sends(place):
            finger.claims[place] = {value}
        if value != known:
            finger.unsure.add(place)
            if before != value and not finger.hidden:
                finger.changed = finger.pending = True
                finger.due_s = now_s + DECIDE_S
        elif place in finger.unsure:
            finger.unsure.discard(place)
            finger.pending |= finger.changed and not finger.unsure

    def _judge(self) -> None:
        for finger in self._fingers.values():  # another one may send what is taken for an answer of this
            self.shown[finger.column] = not (finger.hidden or finger.unsure) and not any(
                value is None
                or (
                    not value & codes.COB_ID_INVALID and self._answers.get(value & codes.STANDARD_MASK) == finger.column
                )
                for other in self._fingers.values()
                if other.claims and other is not finger
                for values in other.claims.values()
                for value in values
            )


def _place(word: int) -> Place:
    return word >> 8 & 0xFFFF, word >> 24 & 0xFF


def _sends(place: Place) -> bool:
    """Return whether an object is an identifier that a finger sends: of a TPDO, of its EMCY."""
    index, sub = place
    return index == communication.COB_ID_EMCY or (communication.TPDO <= index <= communication.LAST_TPDO and sub == 1)
