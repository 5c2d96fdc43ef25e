"""What a decoder looks up: by identifier the message of a node, by message its layout, for one set of signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import STANDARD_MASK
from tipforce.dictionary.signals import Message, Signal
from tipforce.errors import InputError
from tipforce.host.decoding.columns import PackRow, packed_row

MAX_COB_ID = STANDARD_MASK

Key = tuple[int, str]  # node-id, message name


@dataclass(frozen=True, slots=True)
class Group:
    """Slots ``first`` .. ``first + len(node_ids) - 1``: the nodes that share one layout, decoded together."""

    message: Message
    signals: tuple[Signal, ...]
    first: int
    node_ids: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """Slots of the identifiers, for one set of signals. A slot is one message of one node; slot 0 is ignored."""

    slot_of_id: npt.NDArray[np.uint16]  # (MAX_COB_ID + 2,), the last entry is for all larger identifiers
    extended_ids: npt.NDArray[np.uint32]  # (e,) sorted, with EXTENDED_FLAG: of foreign messages
    extended_slots: npt.NDArray[np.uint16]  # (e,)
    length_of_slot: npt.NDArray[np.uint8]  # (slots + 1,), bytes
    keys: tuple[Key, ...]  # of slot 1, 2, ...
    can_ids: tuple[int, ...]  # the same
    groups: tuple[Group, ...]

    @cached_property
    def few(self) -> dict[int, Few]:
        """By identifier what decodes single frames, which is compiled for the first of them."""
        found = {}
        for group in self.groups:
            names, (pack, dtype) = tuple(signal.name for signal in group.signals), packed_row(group.signals)
            for slot in range(group.first, group.first + len(group.node_ids)):
                few = Few(slot, self.keys[slot - 1], group.message, names, pack, dtype)
                found[self.can_ids[slot - 1]] = few
        return found


class Few(NamedTuple):
    """One message of one node, for the decoding of single frames."""

    slot: int
    key: Key
    message: Message
    names: tuple[str, ...]
    pack: PackRow
    dtype: np.dtype[np.void]


def make_plan(
    messages: Mapping[Key, tuple[int, Message]], given: Mapping[int, Key], wanted: frozenset[str] | None
) -> Plan:
    """Return the plan for the signals ``wanted`` (None: all); ``given``: identifiers that one message alone has.

    Raises InputError for a signal that no message has.
    """
    alike = {id(message): message for _, message in messages.values()}
    known = {signal.name for message in alike.values() for signal in message.signals}
    if wanted is not None and not wanted <= known:
        missing = ", ".join(sorted(wanted - known))
        raise InputError(f"no message has the signal {missing}: allowed are {', '.join(sorted(known))}")
    layouts: dict[int, tuple[Message, list[tuple[int, int]]]] = {}  # one Message object per layout, shared by its nodes
    for key, (can_id, message) in messages.items():
        if can_id and given.get(can_id, key) == key:
            layouts.setdefault(id(message), (message, []))[1].append((key[0], can_id))
    groups: list[Group] = []
    slot_of_id = np.zeros(MAX_COB_ID + 2, dtype=np.uint16)
    extended: dict[int, int] = {}
    lengths, keys, can_ids = [0], list[Key](), list[int]()
    for message, members in layouts.values():
        signals = tuple(signal for signal in message.signals if wanted is None or signal.name in wanted)
        if not signals:
            continue
        groups.append(Group(message, signals, len(lengths), tuple(node_id for node_id, _ in members)))
        for node_id, can_id in members:
            if can_id <= MAX_COB_ID:
                slot_of_id[can_id] = len(lengths)
            else:
                extended[can_id] = len(lengths)
            lengths.append(message.length_bytes)
            keys.append((node_id, message.name))
            can_ids.append(can_id)
    ids = np.array(sorted(extended), dtype=np.uint32)
    slots = np.array([extended[can_id] for can_id in ids.tolist()], dtype=np.uint16)
    lengths_of = np.array(lengths, dtype=np.uint8)
    return Plan(slot_of_id, ids, slots, lengths_of, tuple(keys), tuple(can_ids), tuple(groups))


def slots_of(plan: Plan, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint16]:
    """Return the slot of each identifier (k,): flags and larger identifiers are beyond MAX_COB_ID."""
    slot: npt.NDArray[np.uint16] = plan.slot_of_id[np.minimum(can_id, MAX_COB_ID + 1)]
    if len(plan.extended_ids):
        place = np.minimum(np.searchsorted(plan.extended_ids, can_id), len(plan.extended_ids) - 1)
        found = plan.extended_ids[place] == can_id
        slot[found] = plan.extended_slots[place[found]]
    return slot
