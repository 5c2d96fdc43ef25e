"""Detect two nodes with one node-id. Frames may be lost, late or repeated, so it needs a row of second responses,
boot-ups or heartbeats, except for two serial numbers (1018h:4) in response to one read."""

from __future__ import annotations

import struct
import threading
from collections import deque
from itertools import pairwise
from typing import NamedTuple

from canopen_device.core import codes, communication
from canopen_device.core.emcy import COB_ID_COLLISION
from tipforce.dictionary import table

PRODUCT, SERIAL = (communication.IDENTITY, 2), (communication.IDENTITY, 4)
_PRODUCT_PLACE, _SERIAL_PLACE = (struct.pack("<HB", *place) for place in (PRODUCT, SERIAL))
_BOOT, _GUARD = b"boot-up", b"guarding"  # requests other than SDO, which are known by index and sub-index
_MOST_WAITING = 16  # responses that may still come to repeated requests
_MOST_REQUESTS = 64  # of one node that are remembered
_CERTAIN = 8  # second responses, of at most _WINDOW requests, three of four
_WINDOW = 12
_SECOND_NS = 200_000_000  # between two responses to one request, at most
_SINGLE = 3  # requests with one response, after which nobody else responds
_STATE_CHANGES = 8  # from heartbeat to heartbeat, without an NMT command
_BEATS = 11
_STEPS_BACK = 12  # of sample counters, with one step on between them
_MOST_STEPS = 2  # from a sample to the next of the same node: a SYNC may be lost
_SHORTEST_PERIOD_NS = 50_000_000  # receivers that read in batches give faster heartbeats any spacing
_SHORT = 0.3  # of the period: a node that rounds its period to its cycle alternates by a third at most
_UNEVEN = 1.25
GUARDING = codes.HEARTBEAT_BASE | codes.REMOTE_FLAG
_RESETS = (codes.NMT_RESET_NODE, codes.NMT_RESET_COMMUNICATION)


def of_product(product: int) -> str:
    """Return the flag of `tipforce lss` for a product; nothing for its default, and for an unknown product, 0."""
    default = table.product_code(table.MIN_GAUGES, simulated=False)
    return f" --product 0x{product:X}" if product not in (0, default) else ""


class Duplicate(NamedTuple):
    """Two nodes with one node-id; ``serials`` are those seen, ``product`` 0 is unknown. As text: cause and remedy."""

    t_ns: int
    node_id: int
    cause: str
    serials: tuple[int, ...] = ()
    product: int = 0

    def __str__(self) -> str:
        if len(self.serials) > 1:
            numbers = ", ".join(map(str, self.serials))
            one = f"{self.serials[-1]}{of_product(self.product)}"
            step = f"give one of them another node-id: `tipforce lss assign ID --serial {one}`"
            return f"{self.cause} (serial numbers {numbers}): {step}, then `tipforce nmt reset-comm {self.node_id}`"
        if self.serials:
            return f"{self.cause} (serial number {self.serials[0]}): power only one, and give it another node-id"
        return f"{self.cause}: `tipforce scan` shows their serial numbers and how to give one of them another node-id"


class _Node:
    def __init__(self) -> None:
        self.waiting: dict[bytes, int] = {}  # by request: responses that are due; -1 after a second one
        self.answers: dict[bytes, tuple[bytes, int]] = {}  # by request: the last response and its time
        self.serials: list[int] = []
        self.answered = self.doubled = self.changes = self.product = 0
        self.suspect = False
        self.state = -1
        self.beats: deque[int] = deque(maxlen=_BEATS)
        self.pdos: dict[str, tuple[int, int, bytes, int, int]] = {}  # by PDO: counters, data, steps back, steps on

    def boot(self) -> None:
        """Forget what was before a boot-up, except requests and responses: they may be late, and two nodes may boot."""
        self.answers.clear()
        self.serials.clear()
        self.beats.clear()
        self.pdos.clear()
        self.changes, self.state = 0, -1

    def request(self, place: bytes, most: int = _MOST_WAITING) -> None:
        if len(self.waiting) >= _MOST_REQUESTS and place not in self.waiting:
            self.waiting.clear()
        self.waiting[place] = min(max(self.waiting.get(place, 0), 0) + 1, most)

    def response(self, place: bytes, data: bytes, t_ns: int) -> bool:
        """Count a response; return whether it is certain that two nodes respond."""
        due = self.waiting.get(place)
        if due is None:  # to a request that was not seen
            return False
        if due < 0:  # a third one: requests of another client are not among the frames
            self.doubled = 0
            return False
        before, before_ns = self.answers.get(place, (b"", t_ns))
        if due:
            self.waiting[place] = due - 1
            self.answered += 1
            if self.answered >= _WINDOW:
                self.answered, self.doubled = self.answered // 2, self.doubled // 2
        else:
            self.waiting[place] = -1
            # A server may abort a transfer that it has confirmed: an abort is a second response to its like only.
            if t_ns - before_ns > _SECOND_NS or (data[:1] == b"\x80" and before != data):
                return False
            self.doubled += 1
            self.suspect |= 2 * self.doubled >= self.answered
        self.answers[place] = data, t_ns
        number = int.from_bytes(data[4:], "little") if data[:1] == b"\x43" else None
        if place == _PRODUCT_PLACE and number is not None:
            self.product = number
        if place == _SERIAL_PLACE and number is not None:
            if number not in self.serials:
                self.serials.append(number)
            if not due and before not in (b"", data):
                return True
        return not due and self.doubled >= _CERTAIN and 4 * self.doubled >= 3 * self.answered

    def heartbeat(self, state: int, t_ns: int) -> bool:
        """Take a heartbeat; return whether it is certain that two nodes send them."""
        self.changes = self.changes + 1 if self.state not in (-1, state) else 0
        self.state = state
        self.beats.append(t_ns)
        return self.changes >= _STATE_CHANGES or (len(self.beats) == _BEATS and self._two_in_a_period())

    def sample(self, name: str, counter: int, data: bytes, modulus: int) -> bool:
        """Take a sample; return whether it is certain that two nodes send them. Of two nodes that count on at each
        SYNC, every second counter is one that was there before, and each is the next one of the last but one."""
        previous, last, before, back, on = self.pdos.get(name, (counter, counter, data, 0, 0))
        step = (counter - last) % modulus
        if 0 < step <= modulus // 2:
            on += 1
            back = back if on < 2 else 0
        elif step or data != before:
            back, on = back + 1 if 0 < (counter - previous) % modulus <= _MOST_STEPS else 0, 0
        self.pdos[name] = last, counter, data, back, on
        return back >= _STEPS_BACK

    def _two_in_a_period(self) -> bool:
        """Return whether short and long intervals alternate, each pair as long as the others."""
        times = list(self.beats)
        periods = [late - early for early, late in zip(times, times[2:], strict=False)]
        least = min(periods)
        if least < _SHORTEST_PERIOD_NS or max(periods) > _UNEVEN * least:
            return False
        intervals = [late - early for early, late in pairwise(times)]
        return min(max(intervals[::2]), max(intervals[1::2])) <= _SHORT * least


ANY_LENGTH, _EMCY, _REQUEST, _RESPONSE = 1, 2, 3, 4
_OF_BASE = {
    codes.HEARTBEAT_BASE: ANY_LENGTH, codes.EMCY_BASE: _EMCY, codes.SDO_REQUEST_BASE: _REQUEST,
    codes.SDO_RESPONSE_BASE: _RESPONSE,
}  # fmt: skip
KIND_OF = [
    _OF_BASE.get(can_id & codes.FUNCTION_MASK, 0) if can_id & codes.NODE_ID_MASK else 0
    for can_id in range(codes.STANDARD_MASK + 1)
]
"""By identifier what its frames are; 0: nothing that is looked at."""
KIND_OF[codes.NMT_COB_ID] = ANY_LENGTH
BEGINS = {
    _REQUEST: frozenset(command for command in range(256) if command == 0x40 or command >> 5 == 1),
    _RESPONSE: frozenset(command for command in range(256) if command >> 4 == 4 or command in (0x60, 0x80)),
}
"""First bytes of those SDO frames that count: they begin a transfer."""


class DuplicateNodes:
    """Detect duplicates on one bus. ``found``: by node-id, until its next boot-up. For any thread. Requests of this
    host are frames too: give them to ``frame`` before they are sent."""

    def __init__(self) -> None:
        self.found: dict[int, Duplicate] = {}
        self._nodes: dict[int, _Node] = {}
        self._lock = threading.Lock()

    def frame(self, can_id: int, data: bytes, t_ns: int) -> Duplicate | None:
        """Process one frame, ``can_id`` with SocketCAN's flags; return a new finding."""
        node_id = can_id & codes.NODE_ID_MASK
        guarding = can_id - node_id == GUARDING
        kind = KIND_OF[can_id & codes.STANDARD_MASK] if guarding or can_id <= codes.STANDARD_MASK else 0
        if not kind or (kind != ANY_LENGTH and len(data) != 8):
            return None
        with self._lock:
            if can_id == codes.NMT_COB_ID:
                self._commanded(data)
                return None
            node = self._nodes.get(node_id) or self._nodes.setdefault(node_id, _Node())
            if guarding:
                node.request(_GUARD, 1)
                cause = ""
            elif kind == ANY_LENGTH:
                cause = self._heartbeat(node_id, node, data[0], t_ns) if len(data) == 1 else ""
            else:
                cause = _service(kind, node_id, node, data, t_ns)
            return self._note(node_id, node, cause, t_ns) if cause else None

    def sample(self, node_id: int, name: str, counter: int, data: bytes, modulus: int, t_ns: int) -> None:
        """Process a sample that is not stale: the PDO ``name`` with its counter and data."""
        if counter or modulus == table.SAMPLES:  # else that of no SYNC
            with self._lock:
                node = self._nodes.setdefault(node_id, _Node())
                if node.sample(name, counter, data, modulus):
                    self._note(node_id, node, f"two nodes send the samples of node {node_id}", t_ns)

    def _note(self, node_id: int, node: _Node, cause: str, t_ns: int) -> Duplicate | None:
        node.suspect = True
        known = node_id in self.found and self.found[node_id].serials == tuple(node.serials)
        self.found[node_id] = duplicate = Duplicate(t_ns, node_id, cause, tuple(node.serials), node.product)
        return None if known else duplicate

    def suspected(self, node_id: int) -> bool:
        """Return whether a second response, or a finding, was seen since ``retry``."""
        return node_id in self._nodes and self._nodes[node_id].suspect

    def retry(self, node_id: int) -> None:
        """Count responses and find again, for a read that is repeated until ``decided``."""
        with self._lock:
            self._nodes[node_id] = _Node()
            self.found.pop(node_id, None)

    def decided(self, node_id: int) -> bool:
        """Return whether the responses since ``retry`` are those of two nodes, or of one."""
        node = self._nodes[node_id]
        return node_id in self.found or node.answered - node.doubled >= _SINGLE

    def responses(self, node_id: int) -> tuple[int, int]:
        """Return the number of first and of second responses since ``retry``."""
        node = self._nodes[node_id]
        return node.answered, node.doubled

    def _commanded(self, data: bytes) -> None:
        if len(data) != 2:
            return
        if data[1]:
            self._nodes.setdefault(data[1] & codes.NODE_ID_MASK, _Node())
        for node_id, node in self._nodes.items():
            if data[1] in (0, node_id):
                node.changes = 0
                if data[0] in _RESETS:
                    node.request(_BOOT)

    def _heartbeat(self, node_id: int, node: _Node, content: int, t_ns: int) -> str:
        state = content & 0x7F
        if content & 0x80:  # node guarding: every second response has the toggle bit
            return f"two nodes respond as node {node_id}" if node.response(_GUARD, b"", t_ns) else ""
        if state == codes.INITIALISING:
            self.found.pop(node_id, None)
            node.boot()
            return f"two nodes boot as node {node_id}" if node.response(_BOOT, b"", t_ns) else ""
        return f"two nodes send heartbeats as node {node_id}" if node.heartbeat(state, t_ns) else ""


def _service(kind: int, node_id: int, node: _Node, data: bytes, t_ns: int) -> str:
    if kind == _EMCY:
        if int.from_bytes(data[:2], "little") != COB_ID_COLLISION:
            return ""
        can_id = int.from_bytes(data[3:5], "little")  # of a tipforce node; others may send something else there
        which = f"its identifier 0x{can_id:03X}" if can_id & codes.NODE_ID_MASK == node_id else "one of its identifiers"
        return f"node {node_id} reports that another node sends {which} (EMCY 8150h)"
    place = data[1:4]
    if data[0] not in BEGINS[kind]:
        return ""
    if kind == _REQUEST:
        node.request(place)
        return ""
    return f"two nodes respond as node {node_id}" if node.response(place, data, t_ns) else ""
