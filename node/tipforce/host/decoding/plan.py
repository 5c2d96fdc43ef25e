"""What a decoder looks up: by identifier the message of a node, by message its layout, for one set of signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import STANDARD_MASK
from tipforce.dictionary.signals import Message
from tipforce.errors import InputError
from tipforce.host.decoding.columns import Layout
from tipforce.host.decoding.sample_rule import SLOT, counter_place, follows_sync

MAX_COB_ID = STANDARD_MASK

Key = tuple[int, str]  # node-id, message name


@dataclass(frozen=True, slots=True)
class Group:
    """Slots ``first`` .. ``first + len(node_ids) - 1``: the nodes that share one layout, decoded together."""

    message: Message
    layout: Layout
    first: int
    node_ids: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """Slots of the identifiers, for one set of signals. A slot is one message of one node; slot 0 is ignored."""

    slot_of_id: npt.NDArray[np.uint32]  # (MAX_COB_ID + 2,), the last entry is for all larger identifiers
    extended_ids: npt.NDArray[np.uint32]  # (e,) sorted, with EXTENDED_FLAG: of foreign messages
    extended_slots: npt.NDArray[np.uint32]  # (e,)
    slots: npt.NDArray[np.void]  # SLOT (slots + 1,) for one channel
    alone: npt.NDArray[np.void]  # the same, without counters
    keys: tuple[Key, ...]  # of slot 1, 2, ...
    groups: tuple[Group, ...]
    group_of: tuple[int, ...]  # of each slot; that of slot 0 has no meaning


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
    slot_of_id = np.zeros(MAX_COB_ID + 2, dtype=np.uint32)
    extended: dict[int, int] = {}
    rows: list[tuple[int | bytes, ...]] = [(0, -1, 0, 0, 0, 0, 0, 0, b"")]
    keys, group_of, senders = list[Key](), [0], dict[int, int]()
    for message, members in layouts.values():
        signals = tuple(signal for signal in message.signals if wanted is None or signal.name in wanted)
        if not signals:
            continue
        groups.append(Group(message, Layout(signals), len(rows), tuple(node_id for node_id, _ in members)))
        shift, mask = counter_place(signals)
        cyclic = shift >= 0 and follows_sync(message)
        for node_id, can_id in members:
            if can_id <= MAX_COB_ID:
                slot_of_id[can_id] = len(rows)
            else:
                extended[can_id] = len(rows)
            sender = senders.setdefault(node_id, len(senders))
            rows.append((sender, shift, mask, message.number, message.length_bytes, cyclic, 1, node_id, b""))
            keys.append((node_id, message.name))
            group_of.append(len(groups) - 1)
    ids = np.array(sorted(extended), dtype=np.uint32)
    slots = np.array([extended[can_id] for can_id in ids.tolist()], dtype=np.uint32)
    with_counters = np.array(rows, dtype=SLOT)
    alone = with_counters.copy()
    alone["shift"] = -1
    return Plan(slot_of_id, ids, slots, with_counters, alone, tuple(keys), tuple(groups), tuple(group_of))


def slots_of(plan: Plan, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Return the slot of each identifier (k,): flags and larger identifiers are beyond MAX_COB_ID."""
    slot: npt.NDArray[np.uint32] = plan.slot_of_id[np.minimum(can_id, MAX_COB_ID + 1)]
    if len(plan.extended_ids):
        place = np.minimum(np.searchsorted(plan.extended_ids, can_id), len(plan.extended_ids) - 1)
        found = plan.extended_ids[place] == can_id
        slot[found] = plan.extended_slots[place[found]]
    return slot
