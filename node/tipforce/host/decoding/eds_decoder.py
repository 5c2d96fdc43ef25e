"""A decoder of devices by their EDS or DCF that follows what SDO writes change of their PDOs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from canopen_device.core import codes, communication
from canopen_device.eds.description import Description
from canopen_device.eds.reader import read_eds
from tipforce.dictionary.signals import FIRST_OBJECT, Message, Signal
from tipforce.host.decoding.decoder import Change, Decoder
from tipforce.host.decoding.sdo_conversation import SdoConversation
from tipforce.host.frames.frame_array import FrameArray

if TYPE_CHECKING:
    from canopen_device.eds.description import Entry

RANGES = (("TPDO", communication.TPDO, communication.LAST_TPDO), ("RPDO", communication.RPDO, communication.LAST_RPDO))
"""Kind of PDO, first and last index of its communication parameters."""

Values: TypeAlias = Mapping[tuple[int, int], int]
"""PDO parameters by (index, sub)."""

_MOST_BITS = 64


def signal_names(described: Description) -> dict[tuple[int, int], str]:
    """Return a name for each entry, by (index, sub): with its number where one before it, mappable first, has it."""
    named: dict[str, tuple[int, int]] = {}
    for entry in sorted(described.entries(), key=lambda entry: not entry.directions):
        parent = described.objects[entry.index]
        text = parent.name if set(parent.entries) == {0} else f"{parent.name} {entry.name}"
        name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or f"x{_numbered(entry)}"
        named[f"{name}_{_numbered(entry)}" if name in named else name] = entry.index, entry.sub
    return {place: name for name, place in named.items()}


def _numbered(entry: Entry) -> str:
    return f"{entry.index:04X}_{entry.sub:02X}"


def pdo_message(
    found: Description, names: Mapping[tuple[int, int], str], values: Values, name: str, index: int
) -> tuple[int, Message] | None:
    """Return the identifier and the layout of the PDO with the communication parameters ``index``; None if invalid. A
    mapped string or DOMAIN, a data type as a placeholder, and an entry that the file does not have are gaps."""
    cob_id = values.get((index, 1))
    if cob_id is None or cob_id & (codes.COB_ID_INVALID | codes.EXTENDED_COB_ID):
        return None
    mapping = index + communication.MAPPING
    words = [values.get((mapping, sub), 0) for sub in range(1, values.get((mapping, 0), 0) + 1)]
    if not words or sum(word & 0xFF for word in words) > _MOST_BITS:
        return None
    signals: list[Signal] = []
    start = 0
    for word in words:
        entry = found.entry(word >> 16, word >> 8 & 0xFF) if word >> 16 >= FIRST_OBJECT else None
        if entry is not None and entry.type.size is not None:
            own = names[entry.index, entry.sub]
            own += f"_{_numbered(entry)}" if own in {signal.name for signal in signals} else ""  # mapped twice
            signals.append(_signal(own, entry, start, word & 0xFF))
        start += word & 0xFF
    length = (start + 7) // 8
    return cob_id & codes.STANDARD_MASK, Message("tpdo", 0, name, 0, length, tuple(signals), (), True, 255, 0)


def _signal(name: str, entry: Entry, start: int, bits: int) -> Signal:
    low, high = entry.type.limits or (0, 0)
    lowest, highest = float(low if entry.low is None else entry.low), float(high if entry.high is None else entry.high)
    return Signal(
        name, start, bits, low < 0, 1.0, entry.unit, lowest, highest, None, entry.name, entry.index, entry.sub,
        entry.type.python is float,
    )  # fmt: skip


_MOST_BYTES = 4  # of a PDO parameter
_STORED_GROUPS = (1, 2)  # sub-indices of 1010h and 1011h with the communication parameters


class EdsDecoder(Decoder):
    """Decode the PDOs of (node-id, EDS or DCF), from the layout after power-on. ``changes`` takes confirmed SDO writes
    of PDO parameters, and boot-ups, after which those of the last "save", or the file's, apply."""

    def __init__(self, files: Iterable[tuple[int, str]]) -> None:
        """Raises InputError as ``read_eds``."""
        super().__init__(node_ids=())
        self._devices = {node_id: _Device(read_eds(path, node_id)) for node_id, path in files}
        for node_id, device in self._devices.items():
            self._messages |= {(node_id, name): found for name, found in device.messages().items() if found is not None}

    def changes(self, frames: FrameArray) -> list[Change]:
        """Return the changes in frames (k,), which follow those of the call before, by the row they apply from."""
        can_id, data, length = (frames[name] for name in ("can_id", "data", "length"))
        node, kind = can_id & codes.NODE_ID_MASK, can_id & ~np.uint32(codes.NODE_ID_MASK)
        sdo = ((kind == codes.SDO_REQUEST_BASE) | (kind == codes.SDO_RESPONSE_BASE)) & (length == 8)
        booted = (kind == codes.HEARTBEAT_BASE) & (length == 1) & (data[:, 0] == codes.INITIALISING)
        return [
            Change(row + 1, (int(node[row]), name), message)
            for row in np.flatnonzero((sdo | booted) & np.isin(node, list(self._devices))).tolist()
            for name, message in self._devices[int(node[row])].take(int(kind[row]), data[row].tobytes())
        ]


class _Device:
    def __init__(self, described: Description) -> None:
        self._described, self._names = described, signal_names(described)
        self._initial = {
            (entry.index, entry.sub): entry.initial
            for entry in described.entries()
            if communication.RPDO <= entry.index <= communication.LAST_TPDO_MAPPING and isinstance(entry.initial, int)
        }
        self._values, self._stored = dict(self._initial), dict(self._initial)
        self._sdo = SdoConversation(described.node_id, lambda *_: None)
        self._made: dict[tuple[int, Message], tuple[int, Message]] = {}  # one object per layout, kept for its identity
        self._known = self.messages()

    def messages(self) -> dict[str, tuple[int, Message] | None]:
        messages: dict[str, tuple[int, Message] | None] = {}
        for kind, first, last in RANGES:
            for index in sorted(index for index in self._described.objects if first <= index <= last):
                name = f"{kind}{index - first + 1}"
                message = pdo_message(self._described, self._names, self._values, name, index)
                messages[name] = message and self._made.setdefault(message, message)
        return messages

    def take(self, kind: int, data: bytes) -> Iterator[tuple[str, tuple[int, Message] | None]]:
        """Take a frame; yield the PDOs that it changes."""
        if kind == codes.HEARTBEAT_BASE:
            self._values = dict(self._stored)
            self._sdo = SdoConversation(self._described.node_id, lambda *_: None)
        elif kind == codes.SDO_REQUEST_BASE:
            self._sdo.request(data)
            return
        else:
            self._sdo.response(data)
            if self._sdo.written is None or not self._apply(*self._sdo.written):
                return
        now = self.messages()
        for name, found in now.items():
            if found is not self._known[name]:
                yield name, found
        self._known = now

    def _apply(self, index: int, sub: int, content: bytes) -> bool:
        if index in (communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS) and sub in _STORED_GROUPS:
            self._stored = dict(self._values if index == communication.STORE_PARAMETERS else self._initial)
        if not communication.RPDO <= index <= communication.LAST_TPDO_MAPPING:
            return False
        entry = self._described.entry(index, sub)
        size = entry.type.size if entry is not None else None
        self._values[index, sub] = int.from_bytes(content[: size or _MOST_BYTES], "little")
        return True
