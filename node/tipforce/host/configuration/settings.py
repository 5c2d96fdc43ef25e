"""The settings that a node holds: read all, compare with a file or with the defaults, write them as TOML or DCF.

Settings are what 1010h:2 and 1010h:3 store. The calibration is not among them: `tipforce calibrate` moves it, guarded
by its CRC-32.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import tomli_w

from tipforce.device import codes
from tipforce.dictionary import names, table, types
from tipforce.dictionary.eds import dcf_text
from tipforce.dictionary.rows import Row, rows
from tipforce.dictionary.signals import is_mapping
from tipforce.dictionary.types import Value
from tipforce.errors import SdoAbortError
from tipforce.host.configuration.configuration_file import NODE_ID_MARK, Configuration
from tipforce.host.network.sdo import SdoChannel

_NO_SETTING = table.VIEW | table.NOT_STORED | table.STAGED

Place = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Difference:
    """One setting that is not the same on both sides; None where a side says nothing about it."""

    name: str
    entry: str
    node: str | None
    other: str | None


def setting_rows(gauges: int = 3) -> dict[Place, Row]:
    """The table's rows that are settings, by (index, sub)."""
    found = rows(gauges, True)
    return {place: row for place, row in found.items() if row.access == "rw" and not row.flags & _NO_SETTING}


def default_settings(node_id: int, gauges: int = 3) -> dict[Place, Value]:
    """What a node that was never configured holds."""
    defaults: dict[Place, Value] = {}
    for place, row in setting_rows(gauges).items():
        value = row.default
        defaults[place] = value + node_id if row.flags & table.ADD_NODE_ID and isinstance(value, int) else value
    return defaults


def read_settings(sdo: SdoChannel, gauges: int = 3, advance: Callable[[], None] = lambda: None) -> dict[Place, Value]:
    """Every setting of a node; an object that it does not have is left out. ``advance()`` after each read.

    Raises NoResponseError, and SdoAbortError for any other abort.
    """
    found: dict[Place, Value] = {}
    for place, row in setting_rows(gauges).items():
        try:
            found[place] = types.decode(row.letter, sdo.upload(*place))
        except SdoAbortError as error:
            if error.code != codes.NO_OBJECT:
                raise
        advance()
    return found


def changed_settings(settings: Mapping[Place, Value], node_id: int, gauges: int = 3) -> dict[Place, Value]:
    """Those that are not at their default; of a remapped PDO its whole mapping."""
    defaults = default_settings(node_id, gauges)
    changed = {place for place, value in settings.items() if not _same(gauges, place, value, defaults[place])}
    remapped = {index for index, _ in changed if is_mapping(index)}
    return {
        (index, sub): value
        for (index, sub), value in settings.items()
        if (index, sub) in changed or (index in remapped and sub <= int(settings[index, 0]))
    }


def compare(node: Mapping[Place, Value], wanted: Configuration, node_id: int, gauges: int = 3) -> list[Difference]:
    """What differs between a node and a file, both ways: also what the node has changed and the file leaves alone."""
    differences = []
    known = setting_rows(gauges)
    changed = changed_settings(node, node_id, gauges)
    for place in sorted(set(changed) | set(wanted)):
        here = node.get(place)
        there = wanted[place][1] if place in wanted else None
        if place not in known or (here is not None and there is not None and _same(gauges, place, here, there)):
            continue
        row = known[place]
        shown = [None if value is None else types.format_value(row.letter, value) for value in (here, there)]
        differences.append(Difference(row.dotted, f"0x{row.index:04X}:{row.sub:02X}", shown[0], shown[1]))
    return differences


def settings_toml(settings: Mapping[Place, Value], node_id: int, gauges: int = 3) -> str:
    """A file for `tipforce config apply`. COB-IDs that follow the node-id say so, so that it fits any finger."""
    known = setting_rows(gauges)
    objects: dict[str, object] = {}
    for (index, sub), value in sorted(settings.items()):
        row = known[index, sub]
        if not is_mapping(index):
            objects[row.dotted] = _portable(row, value, node_id)
        elif sub == 0:
            words = [int(settings[index, k]) for k in range(1, int(value) + 1) if (index, k) in settings]
            objects[known[index, 1].slug] = [_mapped_name(word, gauges) for word in words]
    return tomli_w.dumps({"objects": objects}, multiline_strings=False)


def settings_dcf(settings: Mapping[Place, Value], node_id: int, gauges: int = 3, simulated: bool = False) -> str:
    """The DCF (CiA 306) of the node with these settings."""
    return dcf_text(gauges, node_id, settings, simulated)


def _portable(row: Row, value: Value, node_id: int) -> Value:
    if row.flags & table.ADD_NODE_ID and isinstance(value, int) and value & codes.NODE_ID_MASK == node_id:
        return f"{NODE_ID_MARK}+0x{value - node_id:X}"
    return f"0x{value:X}" if row.slug.endswith("cob_id") and isinstance(value, int) else value


def _mapped_name(word: int, gauges: int) -> str | int:
    found = names.describe(word >> 16, word >> 8 & 0xFF, gauges)
    return word if found is None or not found.dotted else found.dotted


def _same(gauges: int, place: Place, a: Value, b: Value) -> bool:
    """Equal on the wire: a REAL32 default is compared as REAL32."""
    letter = setting_rows(gauges)[place].letter
    return types.encode(letter, a) == types.encode(letter, b)
