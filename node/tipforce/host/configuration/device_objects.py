"""The dictionary of the node that is configured: that of a fingertip, or what an EDS says of another device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

from canopen_device.core import codes, communication
from canopen_device.types import Value
from tipforce.dictionary import names, table
from tipforce.dictionary.entries import Entry
from tipforce.errors import InputError

if TYPE_CHECKING:
    from canopen_device.eds import description as eds

Place = tuple[int, int]

_NO_SETTING = table.VIEW | table.NOT_STORED | table.STAGED
_ACTIONS = (communication.ERROR_HISTORY, communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS)
_CONTROLWORD = 0x6040  # of CiA 402
_REFUSE_WRITE = 1  # of ObjFlags


class FingertipObjects:
    """The dictionary of a fingertip with so many gauges."""

    def __init__(self, node_id: int, gauges: int = 3) -> None:
        self._node_id, self.gauges = node_id, gauges

    @cached_property
    def settings(self) -> Mapping[Place, Entry[Value]]:
        """The objects stored by 1010h:2 and 1010h:3, by (index, sub). The calibration is not among them. A default
        includes the node-id where the flag ``ADD_NODE_ID`` is set; a stem names the object of a list."""
        settings: dict[Place, Entry[Value]] = {}
        for place, entry in names.entries(self.gauges, True).items():
            if entry.access == "rw" and not entry.flags & _NO_SETTING:
                default = entry.default
                if entry.flags & table.ADD_NODE_ID and isinstance(default, int):
                    default += self._node_id
                settings[place] = replace(entry, default=default)
        return settings

    def resolve(self, text: str) -> Entry[Value]:
        """The entry that a person names, as ``dictionary.names``. Raises InputError."""
        return names.resolve(text, self.gauges)

    def name(self, index: int, sub: int) -> str | None:
        """The dotted name, which ``resolve`` reads; None for an entry without one."""
        entry = names.describe(index, sub, self.gauges)
        return None if entry is None else entry.name

    def check(self, entry: Entry[Value], value: Value) -> None:
        """Raises InputError for a value that the device rejects in any case: TPDOs do not support RTR."""
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
    def settings(self) -> Mapping[Place, Entry[Value]]:
        """The entries that can be read and written, without commands: what an RPDO sets, the controlword, DOMAINs."""
        first, last = communication.RPDO_MAPPING, communication.LAST_RPDO_MAPPING
        words = [of.initial for of in self.described.entries() if first <= of.index <= last and of.sub]
        mapped = {(word >> 16, word >> 8 & 0xFF) for word in words if isinstance(word, int)}  # by RPDOs
        settings: dict[Place, Entry[Value]] = {}
        for of in self.described.entries():
            command = of.access == "rww" or (of.index, of.sub) in mapped or of.index == _CONTROLWORD
            if of.access in ("rw", "rwr") and not command and not self.refuses_write(of) and of.letter != "D":
                settings[of.index, of.sub] = self._entry(of)
        return settings

    def resolve(self, text: str) -> Entry[Value]:
        """As ``Description.find``."""
        return self._entry(self.described.find(text))

    def name(self, index: int, sub: int) -> str | None:
        """The ParameterName where it is unique, otherwise the number."""
        of = self.described.entry(index, sub)
        return None if of is None else self._entry(of).name

    def refuses_write(self, of: eds.Entry) -> bool:
        """Whether a DCF does not set the entry: 1003h, 1010h, 1011h, and what ObjFlags refuse (CiA 306-1)."""
        known = self.described.entry(of.index, of.sub) or of
        return of.index in _ACTIONS or bool(known.flags & _REFUSE_WRITE)

    def _entry(self, of: eds.Entry) -> Entry[Value]:
        from canopen_device.eds.description import COUNTED, folded

        parent = self.described.objects[of.index]
        text = parent.name if set(parent.entries) == {0} else f"{parent.name}/{of.name}"
        name = text if len(self._known.get(folded(text), ())) == 1 and not COUNTED.fullmatch(text) else of.place
        return Entry[Value](
            of.index, of.sub, of.letter, name, "rw" if of.access.startswith("rw") else of.access, of.unit, of.name,
            f"0x{of.index:04X}", table.ADD_NODE_ID if of.has_node_id else 0, of.default, of.low, of.high,
        )  # fmt: skip

    @cached_property
    def _known(self) -> Mapping[str, list[eds.Entry]]:
        from canopen_device.eds.description import names

        return names(self.described)

    def check(self, entry: Entry[Value], value: Value) -> None:
        """LowLimit and HighLimit."""
        if isinstance(value, str | bytes):
            return
        if (entry.low is not None and value < entry.low) or (entry.high is not None and value > entry.high):
            low, high = ("any" if limit is None else limit for limit in (entry.low, entry.high))
            raise InputError(f"{entry.name} ({entry}) is {value}: allowed are {low} to {high}")


DeviceObjects: TypeAlias = FingertipObjects | EdsObjects
"""Names, types and settings of one node."""
