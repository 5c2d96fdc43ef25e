"""Settings of a node: read all, compare with a file or with the defaults, write them as TOML.

``tipforce calibrate`` transfers the calibration of a fingertip, protected by its CRC-32; it is none of the settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import tomli_w

from tipforce.device import codes
from tipforce.dictionary import types
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.signals import is_mapping
from tipforce.dictionary.types import Value
from tipforce.errors import InputError, SdoAbortError
from tipforce.host.configuration.configuration_file import NODE_ID_MARK, Configuration
from tipforce.host.configuration.device_objects import DeviceObjects, FingertipObjects, Place, Setting
from tipforce.host.network.sdo import SdoChannel

_TEXT = "s"  # VISIBLE_STRING


@dataclass(frozen=True, slots=True)
class Difference:
    """One setting that differs between two sides; None if a side does not contain it."""

    name: str
    entry: str
    node: str | None
    other: str | None


def read_settings(
    sdo: SdoChannel, objects: DeviceObjects, advance: Callable[[], None] = lambda: None
) -> dict[Place, Value]:
    """Return every setting of a node, without objects that it lacks. ``advance()`` after each read.

    Raises NoResponseError; for a fingertip also SdoAbortError for any other abort. What another device does not
    provide as its EDS has it is left out, and a text outside ASCII, which could not be written back.
    """
    found: dict[Place, Value] = {}
    for place, setting in objects.settings.items():
        try:
            content = sdo.upload(*place)
            if setting.entry.type != _TEXT or content.isascii():
                found[place] = setting.entry.decode(content)
        except SdoAbortError as error:
            if isinstance(objects, FingertipObjects) and error.code != codes.NO_OBJECT:
                raise
        except InputError:
            if isinstance(objects, FingertipObjects):
                raise
        advance()
    return found


def changed_settings(settings: Mapping[Place, Value], objects: DeviceObjects) -> dict[Place, Value]:
    """Return the settings that differ from their default; of a remapped PDO its whole mapping."""
    known = objects.settings
    changed = {place for place, value in settings.items() if not same(known[place].entry, value, known[place].default)}
    remapped = {index for index, _ in changed if is_mapping(index)}
    return {
        (index, sub): value
        for (index, sub), value in settings.items()
        if (index, sub) in changed or (index in remapped and sub <= int(settings.get((index, 0), 0)))
    }


def compare(node: Mapping[Place, Value], wanted: Configuration, objects: DeviceObjects) -> list[Difference]:
    """Return the differences between a node and a file, both ways: also changes missing in the file."""
    differences = []
    known = objects.settings
    changed = changed_settings(node, objects)
    for place in sorted(set(changed) | set(wanted)):
        here = node.get(place)
        there = wanted[place][1] if place in wanted else None
        if place not in known:
            continue
        entry = known[place].entry
        if here is not None and there is not None and same(entry, here, there):
            continue
        shown = [None if value is None else types.format_value(entry.type, value) for value in (here, there)]
        differences.append(Difference(entry.name, str(entry), shown[0], shown[1]))
    return differences


def settings_toml(settings: Mapping[Place, Value], objects: DeviceObjects, node_id: int) -> str:
    """Return a file for `tipforce config apply`. COB-IDs that depend on the node-id are relative, to fit any node."""
    known = objects.settings
    written: dict[str, object] = {}
    for (index, sub), value in sorted(settings.items()):
        setting = known[index, sub]
        if not is_mapping(index):
            written[setting.entry.name] = _portable(setting, value, node_id)
        elif sub == 0:
            words = [int(settings[index, k]) for k in range(1, int(value) + 1) if (index, k) in settings]
            array = known[index, 1].array if (index, 1) in known else f"0x{index:04X}"
            written[array] = [objects.name(word >> 16, word >> 8 & 0xFF) or word for word in words]
    return tomli_w.dumps({"objects": written}, multiline_strings=False)


def _portable(setting: Setting, value: Value, node_id: int) -> Value:
    if isinstance(value, bytes):
        return types.format_value(setting.entry.type, value)
    if setting.adds_node_id and isinstance(value, int) and value & codes.NODE_ID_MASK == node_id:
        return f"{NODE_ID_MARK}+0x{value - node_id:X}"
    return f"0x{value:X}" if setting.array.endswith("cob_id") and isinstance(value, int) else value


def same(entry: Entry[Value], a: Value, b: Value) -> bool:
    """Return whether both are equal on the wire: a REAL32 default is compared as REAL32."""
    try:
        return entry.encode(a) == entry.encode(b)
    except InputError:  # an EDS may have a default that its type does not
        return a == b
