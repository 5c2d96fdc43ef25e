"""PDO layouts of any device from its EDS or DCF, for ``EdsDecoder``: signals are named as its objects are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias

from tipforce.device import codes, communication
from tipforce.dictionary.signals import FIRST_OBJECT, Message, Signal

if TYPE_CHECKING:
    from tipforce.eds.description import Description, Entry

RANGES = (
    ("TPDO", communication.TPDO, communication.LAST_TPDO),
    ("RPDO", communication.RPDO, communication.LAST_RPDO),
)
"""Kind of PDO, first and last index of its communication parameters."""

Values: TypeAlias = Mapping[tuple[int, int], int]
"""PDO parameters by (index, sub)."""

_MOST_BITS = 64


def pdo_values(found: Description) -> dict[tuple[int, int], int]:
    """Return the PDO parameters after power-on."""
    return {
        (one.index, one.sub): one.initial
        for one in found.entries()
        if communication.RPDO <= one.index <= communication.LAST_TPDO_MAPPING and isinstance(one.initial, int)
    }


def pdo_message(found: Description, values: Values, name: str, index: int) -> tuple[int, Message] | None:
    """Return the identifier and the layout of the PDO with the communication parameters ``index``; None if invalid.

    A mapped string or DOMAIN, a data type as a placeholder, and an entry that the file does not have are gaps.
    """
    cob_id = values.get((index, 1))
    if cob_id is None or cob_id & (codes.COB_ID_INVALID | codes.EXTENDED_COB_ID):
        return None
    mapping = index + communication.MAPPING
    words = [values.get((mapping, sub), 0) for sub in range(1, values.get((mapping, 0), 0) + 1)]
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
