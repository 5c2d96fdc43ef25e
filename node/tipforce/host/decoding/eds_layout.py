"""PDO layouts of any device from its EDS or DCF, for ``Decoder.of_messages``: signals are named as its objects are."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from tipforce.device import codes, communication
from tipforce.dictionary.signals import FIRST_OBJECT, Message, Signal
from tipforce.eds.reader import read_eds
from tipforce.host.decoding.decoder import Key

if TYPE_CHECKING:
    from tipforce.eds.description import Description, Entry

_RANGES = (
    ("TPDO", communication.TPDO, communication.LAST_TPDO),
    ("RPDO", communication.RPDO, communication.LAST_RPDO),
)
_MOST_BITS = 64


def eds_messages(path: str, node_id: int) -> dict[Key, tuple[int, Message]]:
    """Return the PDOs that are valid after power-on: by (node-id, "TPDO1") the identifier and the layout.

    A mapped string or DOMAIN, a data type as a placeholder, and an entry that the file does not have are gaps.
    Raises InputError as ``read_eds``.
    """
    found = read_eds(path, node_id)
    messages: dict[Key, tuple[int, Message]] = {}
    for kind, first, last in _RANGES:
        for index in sorted(one for one in found.objects if first <= one <= last):
            message = _message(found, f"{kind}{index - first + 1}", index)
            if message is not None:
                messages[node_id, message[1].name] = message
    return messages


def _message(found: Description, name: str, index: int) -> tuple[int, Message] | None:
    cob_id = _integer(found.entry(index, 1))
    if cob_id is None or cob_id & (codes.COB_ID_INVALID | codes.EXTENDED_COB_ID):
        return None
    mapping = found.objects.get(index + communication.MAPPING)
    count = _integer(mapping.entries.get(0)) if mapping is not None else 0
    words = [_integer(mapping.entries.get(sub)) or 0 for sub in range(1, (count or 0) + 1)] if mapping else []
    signals: list[Signal] = []
    start = 0
    for word in words:
        bits = word & 0xFF
        entry = found.entry(word >> 16, word >> 8 & 0xFF) if word >> 16 >= FIRST_OBJECT else None
        if entry is not None and entry.type.size is not None and start + bits <= _MOST_BITS:
            signals.append(_signal(found, entry, start, bits, {one.name for one in signals}))
        start += bits
    if not words or start > _MOST_BITS:
        return None
    length = (start + 7) // 8
    return cob_id & codes.STANDARD_MASK, Message("tpdo", 0, name, 0, length, tuple(signals), (), True, 255, 0)


def _integer(entry: Entry | None) -> int | None:
    return entry.initial if entry is not None and isinstance(entry.initial, int) else None


def _signal(found: Description, entry: Entry, start: int, bits: int, taken: set[str]) -> Signal:
    low, high = entry.type.limits or (0, 0)
    name = signal_name(found, entry)
    if name in taken:
        name = f"{name}_{entry.index:04X}_{entry.sub:02X}"
    lowest, highest = float(low if entry.low is None else entry.low), float(high if entry.high is None else entry.high)
    return Signal(
        name, start, bits, low < 0, 1.0, entry.unit, lowest, highest, None, entry.name, entry.index, entry.sub,
        entry.type.python is float,
    )  # fmt: skip


def signal_name(found: Description, entry: Entry) -> str:
    """Return the name of an entry as a signal, of letters, digits and underscores."""
    one = found.objects[entry.index]
    text = one.name if set(one.entries) == {0} else f"{one.name} {entry.name}"
    return re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or f"x{entry.index:04X}_{entry.sub:02X}"
