"""The dictionary of the node that is configured: that of a fingertip, or what an EDS says of another device."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

from tipforce.device import communication
from tipforce.dictionary import names, table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.rows import rows
from tipforce.dictionary.types import Value
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.eds import description as eds

Place = tuple[int, int]

_NO_SETTING = table.VIEW | table.NOT_STORED | table.STAGED
_ACTIONS = (communication.ERROR_HISTORY, communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS)
_CONTROLWORD = 0x6040  # of CiA 402
_COUNTED = re.compile(r"(.+):(\d+)")


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting: ``default`` includes the node-id where ``adds_node_id``; ``array`` names the object of a list."""

    entry: Entry[Value]
    default: Value
    adds_node_id: bool
    array: str


class DeviceObjects(Protocol):
    """Names, types and settings of one node."""

    @property
    def settings(self) -> Mapping[Place, Setting]:
        """The settings by (index, sub)."""

    def resolve(self, text: str) -> Entry[Value]:
        """The entry that a person names. Raises InputError."""

    def name(self, index: int, sub: int) -> str | None:
        """The name that ``resolve`` reads, None for an entry without one."""

    def check(self, entry: Entry[Value], value: Value) -> None:
        """Raises InputError for a value that the device rejects in any case."""


class FingertipObjects:
    """The dictionary of a fingertip with so many gauges."""

    def __init__(self, node_id: int, gauges: int = 3) -> None:
        self._node_id, self._gauges = node_id, gauges

    @cached_property
    def settings(self) -> Mapping[Place, Setting]:
        """The objects stored by 1010h:2 and 1010h:3. The calibration is not among them."""
        found: dict[Place, Setting] = {}
        for place, row in rows(self._gauges, True).items():
            if row.access != "rw" or row.flags & _NO_SETTING:
                continue
            adds, default = bool(row.flags & table.ADD_NODE_ID), row.default
            if adds and isinstance(default, int):
                default += self._node_id
            entry = Entry[Value](row.index, row.sub, row.letter, row.dotted, row.access, row.unit)
            found[place] = Setting(entry, default, adds, row.slug)
        return found

    def resolve(self, text: str) -> Entry[Value]:
        """As ``dictionary.names``."""
        return names.resolve(text, self._gauges)

    def name(self, index: int, sub: int) -> str | None:
        """The dotted name."""
        found = names.describe(index, sub, self._gauges)
        return None if found is None else found.dotted or None

    def check(self, entry: Entry[Value], value: Value) -> None:
        """TPDOs do not support RTR."""
        from tipforce.device import codes

        of_tpdo = communication.TPDO <= entry.index <= communication.LAST_TPDO
        if of_tpdo and entry.sub == 1 and not int(value) & codes.NO_RTR:
            raise InputError(
                f"{entry.name} ({entry}) is 0x{int(value):X}: TPDOs do not support RTR, so bit 30 must be "
                f"set: 0x{int(value) | codes.NO_RTR:X}"
            )


class EdsObjects:
    """What the EDS or DCF of a device of any manufacturer says."""

    def __init__(self, described: eds.Description) -> None:
        self.described = described

    @cached_property
    def settings(self) -> Mapping[Place, Setting]:
        """The entries that can be read and written, without commands: what an RPDO sets, the controlword, DOMAINs."""
        mapped = self._mapped_by_rpdos()
        found: dict[Place, Setting] = {}
        for one in self.described.entries():
            command = one.access == "rww" or (one.index, one.sub) in mapped or one.index == _CONTROLWORD
            if one.access in ("rw", "rwr") and not command and one.index not in _ACTIONS and one.letter != "D":
                found[one.index, one.sub] = Setting(
                    self._entry(one), one.default, one.has_node_id, f"0x{one.index:04X}"
                )
        return found

    def _mapped_by_rpdos(self) -> set[Place]:
        first, last = communication.RPDO_MAPPING, communication.LAST_RPDO_MAPPING
        words = [
            one.initial for one in self.described.entries() if first <= one.index <= last and one.sub
        ]  # fmt: skip
        return {(word >> 16, word >> 8 & 0xFF) for word in words if isinstance(word, int)}

    def resolve(self, text: str) -> Entry[Value]:
        """As ``Description.find``; ``Name:3`` is sub-index 3 of the object ``Name``."""
        try:
            return self._entry(self.described.find(text))
        except InputError:
            match = _COUNTED.fullmatch(text.strip())
            index = None if match is None else self._object(match[1])
            if match is None or index is None:
                raise
            return self._entry(self.described.find((index, int(match[2]))))

    def _object(self, text: str) -> int | None:
        from tipforce.eds.names import folded

        found = [index for index, one in self.described.objects.items() if folded(one.name) == folded(text)]
        return found[0] if len(found) == 1 else None

    def name(self, index: int, sub: int) -> str | None:
        """The ParameterName where it is unique, otherwise the number."""
        one = self.described.entry(index, sub)
        return None if one is None else self._entry(one).name

    def _entry(self, one: eds.Entry) -> Entry[Value]:
        access = "rw" if one.access.startswith("rw") else one.access
        return Entry[Value](one.index, one.sub, one.letter, self._name(one), access, one.unit)

    def _name(self, one: eds.Entry) -> str:
        from tipforce.eds.names import folded

        parent = self.described.objects[one.index]
        text = parent.name if set(parent.entries) == {0} else f"{parent.name}/{one.name}"
        return text if len(self._known.get(folded(text), ())) == 1 and not _COUNTED.fullmatch(text) else one.place

    @cached_property
    def _known(self) -> Mapping[str, list[eds.Entry]]:
        from tipforce.eds.names import names as by_name

        return by_name(self.described)

    def check(self, entry: Entry[Value], value: Value) -> None:
        """LowLimit and HighLimit."""
        one = self.described.entry(entry.index, entry.sub)
        if one is None or isinstance(value, str | bytes):
            return
        if (one.low is not None and value < one.low) or (one.high is not None and value > one.high):
            low, high = ("any" if limit is None else limit for limit in (one.low, one.high))
            raise InputError(f"{entry.name} ({entry}) is {value}: allowed are {low} to {high}")
