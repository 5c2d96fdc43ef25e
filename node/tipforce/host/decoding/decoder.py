"""The bulk decoder of tipforce's PDOs for live frames and for logs: frames in, columns of signals out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import STANDARD_MASK
from tipforce.dictionary.signals import Message, mapping_signals, tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.sample_rule import SAMPLES, SLOT, counter_place, follows_sync, join, losses
from tipforce.host.decoding.sample_table import Layout, Values
from tipforce.host.frames.frame_array import FrameArray

MAX_COB_ID = STANDARD_MASK
Key = tuple[int, str]  # node-id, message name
_WORD = np.dtype("<u8")
_NO_NUMBERS = np.zeros(0, dtype=np.int64)


class Group(NamedTuple):
    """A message that some nodes have alike: their frames are decoded together."""

    message: Message
    layout: Layout


@dataclass(frozen=True, eq=False)
class Plan:
    """Slots of the identifiers, for one set of signals. A slot is one message of one node; slot 0 is ignored."""

    slot_of_id: npt.NDArray[np.uint32]  # (MAX_COB_ID + 2,), the last entry is for all larger identifiers
    extended_ids: npt.NDArray[np.uint32]  # (e,) sorted, with EXTENDED_FLAG: of foreign messages
    extended_slots: npt.NDArray[np.uint32]  # (e,)
    slots: npt.NDArray[np.void]  # SLOT (slots + 1,) for one channel
    alone: npt.NDArray[np.void]  # the same, without counters, and each a group of its own
    keys: tuple[Key, ...]  # of slot 1, 2, ...
    groups: tuple[Group, ...]


def make_plan(
    messages: Mapping[Key, tuple[int, Message]], given: Mapping[int, Key], wanted: frozenset[str] | None
) -> Plan:
    """Return the plan for the signals ``wanted`` (None: all); ``given``: identifiers that one message alone has. Raises
    InputError for a signal that no message has."""
    known = {signal.name for message in {id(m): m for _, m in messages.values()}.values() for signal in message.signals}
    if wanted is not None and not wanted <= known:
        missing = ", ".join(sorted(wanted - known))
        raise InputError(f"no message has the signal {missing}: allowed are {', '.join(sorted(known))}")
    layouts: dict[int, tuple[Message, list[tuple[int, int]]]] = {}  # one Message object per layout, shared by its nodes
    for key, (can_id, message) in messages.items():
        if can_id and given.get(can_id, key) == key:
            layouts.setdefault(id(message), (message, []))[1].append((key[0], can_id))
    groups: list[Group] = []
    slot_of_id = np.zeros(MAX_COB_ID + 2, dtype=np.uint32)
    extended: dict[int, int] = {}
    rows: list[tuple[int, ...]] = [(0, 0, -1, 0, 0, 0, 0, 0, 0, 0)]
    keys, senders = list[Key](), dict[int, int]()
    for message, members in layouts.values():
        signals = tuple(signal for signal in message.signals if wanted is None or signal.name in wanted)
        if not signals:
            continue
        group = len(groups)
        groups.append(Group(message, Layout(signals)))
        shift, mask = counter_place(signals)
        cyclic = shift >= 0 and follows_sync(message)
        for node_id, can_id in members:
            if can_id <= MAX_COB_ID:
                slot_of_id[can_id] = len(rows)
            else:
                extended[can_id] = len(rows)
            sender = senders.setdefault(node_id, len(senders))
            number, length = message.number, message.length_bytes
            rows.append((sender, group, shift, mask, number, length, cyclic, 1, node_id, SAMPLES))
            keys.append((node_id, message.name))
    ids = np.array(sorted(extended), dtype=np.uint32)
    of_ids = np.array([extended[can_id] for can_id in sorted(extended)], dtype=np.uint32)
    slots = np.array(rows, dtype=SLOT)
    alone = slots.copy()
    alone["shift"], alone["cyclic"], alone["group"] = -1, 0, np.arange(len(alone))
    return Plan(slot_of_id, ids, of_ids, slots, alone, tuple(keys), tuple(groups))


def slots_of(plan: Plan, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Return the slot of each identifier (k,): flags and larger identifiers are beyond MAX_COB_ID."""
    slot: npt.NDArray[np.uint32] = plan.slot_of_id.take(can_id, mode="clip")
    if len(plan.extended_ids):
        place = np.minimum(np.searchsorted(plan.extended_ids, can_id), len(plan.extended_ids) - 1)
        found = plan.extended_ids[place] == can_id
        slot[found] = plan.extended_slots[place[found]]
    return slot


@dataclass(slots=True, eq=False)
class Samples:
    """k samples of a message of a node: ``t_ns`` received, ``row`` of the frame, ``columns`` by signal, (k,) each:
    float64 in the signal's unit, NaN for unknown; flags bool; counters integers. ``message`` has their units."""

    node_id: int
    message: Message
    t_ns: npt.NDArray[np.int64]
    row: npt.NDArray[np.intp]
    columns: Mapping[str, Values]


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """From row ``row`` of the frames on, a message has another identifier and layout; None: it is not sent."""

    row: int
    key: Key
    message: tuple[int, Message] | None


class Decoder:
    """Decode the TPDOs of nodes with ``n`` gauges, by default as in docs/objects.md. ``malformed``: by (node-id,
    message) frames shorter than their mapping, not decoded (a node's EMCY 8210h); extra bytes are ignored."""

    def __init__(
        self, n: int = 3, node_ids: Iterable[int] = range(1, 128), services: Iterable[Message] = ()
    ) -> None:  # fmt: skip
        """``services``: other messages of these nodes, on their base identifiers and node-ids. Raises InputError for an
        ``n`` outside 3..8 or a node-id outside 1..127."""
        self._n = n
        self._messages: dict[Key, tuple[int, Message]] = {}
        self._given: dict[int, Key] = {}  # identifiers set by remap
        self._remapped: dict[tuple[str, tuple[tuple[int, int, int], ...]], Message] = {}
        self._plans: dict[frozenset[str] | None, Plan] = {}
        self.malformed = Counter[Key]()
        messages = (*tpdo_messages(n), *services)
        for node_id in node_ids:
            if not 1 <= node_id <= 127:
                raise InputError(f"node-id {node_id}: allowed are 1 to 127")
            for message in messages:
                can_id = message.cob_id_base + node_id if message.cob_id_base else 0
                self._messages[node_id, message.name] = can_id, message

    @classmethod
    def of_messages(cls, messages: Mapping[Key, tuple[int, Message]]) -> Decoder:
        """Return a decoder of other messages: by key the can_id, with EXTENDED_FLAG for 29 bits, and the layout."""
        decoder = cls(node_ids=())
        decoder._messages.update(messages)
        return decoder

    def changes(self, frames: FrameArray) -> list[Change]:
        """Return the changes of layouts that the frames (k,) show; this decoder's layouts are given and stay."""
        del frames
        return []

    def apply(self, change: Change) -> None:
        """Decode with a change, after all frames before its row."""
        if change.message is None:
            self._messages.pop(change.key, None)
        else:
            self._messages[change.key] = change.message
        self._plans.clear()

    def parts(self, frames: FrameArray) -> Iterator[tuple[int, int]]:
        """Yield start and end of the parts of frames (k,) with the same layouts; each applies until the next."""
        changes, start = self.changes(frames), 0
        for end in sorted({*(change.row for change in changes), len(frames)}):
            yield start, end
            for change in changes:
                if change.row == end:
                    self.apply(change)
            start = end

    def messages(self) -> dict[Key, tuple[int, Message]]:
        """Return by (node-id, message name) the identifier, 0 for none, and the layout."""
        return dict(self._messages)

    def remap(self, node_id: int, name: str, can_id: int, mapping: Iterable[tuple[int, int, int]]) -> None:
        """Receive message ``name`` of a node on ``can_id`` (0: not at all), in place of a default PDO there. Raises
        InputError, with no change, for a message, an identifier (1..0x7FF, not in use) or a mapping."""
        key = node_id, name
        if key not in self._messages:
            names = ", ".join(message.name for message in tpdo_messages(self._n))
            raise InputError(f"node {node_id}, message {name!r}: allowed are this decoder's nodes and {names}")
        if not 0 <= can_id <= MAX_COB_ID:
            raise InputError(f"identifier 0x{can_id:X} of {name}: allowed are 0x001 to 0x7FF, or 0 for none")
        owner = self._given.get(can_id, key)
        if owner != key:
            raise InputError(f"identifier 0x{can_id:03X} of {name}: already assigned to {owner[1]} of node {owner[0]}")
        message, mapped = self._messages[key][1], tuple(mapping)
        if (name, mapped) not in self._remapped:
            length, signals = (sum(bits for _, _, bits in mapped) + 7) // 8, mapping_signals(mapped, self._n)
            changed = replace(message, length_bytes=length, signals=signals, mapping=mapped)
            self._remapped[name, mapped] = changed
        self._messages[key] = can_id, self._remapped[name, mapped]
        self._given = {given: other for given, other in self._given.items() if other != key}
        if can_id:
            self._given[can_id] = key
        self._plans.clear()

    def decode(self, frames: FrameArray, signals: Iterable[str] | None = None) -> dict[Key, Samples]:
        """Decode FRAME array (n,) to the samples of each (node-id, message name); with ``signals`` of these alone.
        Remote and error frames and unknown identifiers are ignored. Raises InputError for an unknown name."""
        plan = self.plan(signals)
        samples: dict[Key, Samples] = {}
        grouped = join(frames, slots_of(plan, frames["can_id"]), plan.alone, _NO_NUMBERS, 0, last=True)
        for slot, count in grouped.short:
            self.malformed[plan.keys[slot - 1]] += count
        words = frames["data"].view(_WORD)[:, 0]
        for number, members in groupby(grouped.spans, key=lambda span: int(plan.slots["group"][span[0]])):
            group, spans = plan.groups[number], list(members)
            start = spans[0][1]
            order = grouped.order[start : spans[-1][2]]
            t_ns, columns = frames["t_ns"][order], group.layout.columns(words[order])
            for slot, low, high in spans:
                rows, key = slice(low - start, high - start), plan.keys[slot - 1]
                samples[key] = Samples(key[0], group.message, t_ns[rows], order[rows], columns.part(rows))
        return samples

    def plan(self, signals: Iterable[str] | None) -> Plan:
        """Return the slots of the present layouts, for ``signals`` as of ``decode``. Raises InputError as that."""
        wanted = None if signals is None else frozenset(signals)
        if wanted not in self._plans:
            if len(self._plans) > 64:  # a caller with new signals in each call must not fill the memory
                self._plans.clear()
            self._plans[wanted] = make_plan(self._messages, self._given, wanted)
        return self._plans[wanted]


def unwrap_counter(counter: npt.ArrayLike, modulus: int = 256) -> npt.NDArray[np.int64]:
    """Return the sample counter (k,) without wraps: (k,), from its first value. ``modulus``: see ``lost_samples``."""
    values = np.array(counter, dtype=np.int64)
    values[1:] = np.diff(values) % modulus
    return np.cumsum(values)


def lost_samples(counter: npt.ArrayLike, modulus: int = 256) -> int:
    """Return how many samples of a PDO at every SYNC are missing, by its counter (k,). ``modulus``: 256, or the largest
    SYNC number (1019h), then from 1. 255 or 256 lost in a row do not show; one out of order counts as 254."""
    return losses(counter, modulus)[2]
