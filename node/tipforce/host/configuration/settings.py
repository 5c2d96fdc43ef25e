"""Settings of a node: read all, compare with a file or with the defaults, write them as TOML or DCF.

Settings are the objects stored by 1010h:2 and 1010h:3. The calibration is not among them: `tipforce calibrate`
transfers it, protected by its CRC-32.
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
    """One setting that differs between two sides; None if a side does not contain it."""

    name: str
    entry: str
    node: str | None
    other: str | None


def setting_rows(gauges: int = 3) -> dict[Place, Row]:
    """Return the rows of the table that are settings, by (index, sub)."""
    found = rows(gauges, True)
    return {place: row for place, row in found.items() if row.access == "rw" and not row.flags & _NO_SETTING}


def default_settings(node_id: int, gauges: int = 3) -> dict[Place, Value]:
    """Return the settings of a node that was never configured."""
    defaults: dict[Place, Value] = {}
    for place, row in setting_rows(gauges).items():
        value = row.default
        defaults[place] = value + node_id if row.flags & table.ADD_NODE_ID and isinstance(value, int) else value
    return defaults


def read_settings(sdo: SdoChannel, gauges: int = 3, advance: Callable[[], None] = lambda: None) -> dict[Place, Value]:
    """Return every setting of a node, without objects that it lacks. ``advance()`` after each read.

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
    """Return the settings that differ from their default; of a remapped PDO its whole mapping."""
    defaults = default_settings(node_id, gauges)
    changed = {place for place, value in settings.items() if not _same(gauges, place, value, defaults[place])}
    remapped = {index for index, _ in changed if is_mapping(index)}
    return {
        (index, sub): value
        for (index, sub), value in settings.items()
        if (index, sub) in changed or (index in remapped and sub <= int(settings[index, 0]))
    }


def compare(node: Mapping[Place, Value], wanted: Configuration, node_id: int, gauges: int = 3) -> list[Difference]:
    """Return the differences between a node and a file, both ways: also changes missing in the file."""
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
    """Return a file for `tipforce config apply`. COB-IDs that depend on the node-id are relative, to fit any finger."""
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
    """Return the DCF (CiA 306) of the node with these settings."""
    return dcf_text(gauges, node_id, settings, simulated)


def _portable(row: Row, value: Value, node_id: int) -> Value:
    if row.flags & table.ADD_NODE_ID and isinstance(value, int) and value & codes.NODE_ID_MASK == node_id:
        return f"{NODE_ID_MARK}+0x{value - node_id:X}"
    return f"0x{value:X}" if row.slug.endswith("cob_id") and isinstance(value, int) else value


def _mapped_name(word: int, gauges: int) -> str | int:
    found = names.describe(word >> 16, word >> 8 & 0xFF, gauges)
    return word if found is None or not found.dotted else found.dotted


def _same(gauges: int, place: Place, a: Value, b: Value) -> bool:
    """Return whether both are equal on the wire: a REAL32 default is compared as REAL32."""
    letter = setting_rows(gauges)[place].letter
    return types.encode(letter, a) == types.encode(letter, b)
