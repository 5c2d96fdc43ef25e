"""A DCF: the EDS of a device with the values of one node (CiA 306-1, 4.7)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tipforce.dictionary.types import Value, format_value
from tipforce.eds.description import Description
from tipforce.eds.sections import EdsFile, Section, decoded, parse

_COMMISSIONING = "devicecomissioning"  # this is the spelling of CiA 306
_NODE_ID_BITS = 0x7F


def dcf_text(described: Description, values: Mapping[tuple[int, int], Value]) -> str:
    """Return the DCF of ``described.node_id`` with these values by (index, sub); comments of the EDS are left out."""
    file = parse(decoded(described.content)[0])
    lists: dict[int, dict[int, str]] = {}
    sections = dict(file.sections)
    sections.pop(_COMMISSIONING, None)
    for one in sections.values():
        one.keys.pop("parametervalue", None)
    without = {index for index, _ in values} - file.objects.keys() - file.subs.keys()  # such as those of CompactPDO
    for (index, sub), value in sorted(values.items()):
        section = file.entry(index, sub) if sub == 0 or index in file.subs else None
        if index in without:
            continue
        if section is None:
            lists.setdefault(index, {})[sub] = _text(described, index, sub, value)
        else:
            section.keys["parametervalue"] = _text(described, index, sub, value)
            section.written["parametervalue"] = "ParameterValue"
    _list_objects(file, without)
    lines = [line for one in sections.values() for line in _lines(file, one, lists)]
    lines += [line for index in sorted(without) for line in _object_lines(described, index, values)]
    commissioning = ["[DeviceComissioning]", f"NodeID={described.node_id}", f"NodeName={described.node_name}"]
    if described.bit_rate is not None:
        commissioning.append(f"Baudrate={described.bit_rate // 1000}")
    return "\n".join([*lines, *commissioning, "CANopenManager=0", ""])


def _lines(file: EdsFile, section: Section, lists: Mapping[int, Mapping[int, str]]) -> list[str]:
    """Return a section; behind that of a compact object the list of its values."""
    found = section.text_lines()
    index = next((number for number, one in file.objects.items() if one is section), None)
    if index is not None and index in lists:
        values = lists[index]
        found += [f"[{section.name}Value]", f"NrOfEntries={len(values)}"]
        found += [*(f"{sub}={text}" for sub, text in sorted(values.items())), ""]
    return [] if any(section is one.get("value") for k, one in file.lists.items() if k in lists) else found


def _list_objects(file: EdsFile, indices: Iterable[int]) -> None:
    """Add objects to the list of optional objects, where the file has one."""
    section = file.sections.get("optionalobjects")
    if section is None:
        return
    for index in sorted(indices):
        count = sum(key.isdigit() for key in section.keys) + 1
        for key, text in ((str(count), f"0x{index:04X}"), ("supportedobjects", str(count))):
            section.keys[key] = text
            section.written.setdefault(key, key)


def _object_lines(described: Description, index: int, values: Mapping[tuple[int, int], Value]) -> list[str]:
    """Return the sections of an object that the file does not have."""
    one = described.objects[index]
    found = [f"[{index:04X}]", f"ParameterName={one.name}", f"ObjectType=0x{one.code:X}"]
    found += [f"SubNumber={len(one.entries)}", ""]
    for sub, entry in sorted(one.entries.items()):
        found += [f"[{index:04X}sub{sub:X}]", f"ParameterName={entry.name}", f"DataType=0x{entry.type.code:04X}"]
        found += [f"AccessType={entry.access}", f"DefaultValue={_text(described, index, sub, entry.default)}"]
        if (index, sub) in values:
            found.append(f"ParameterValue={_text(described, index, sub, values[index, sub])}")
        found.append("")
    return found


def _text(described: Description, index: int, sub: int, value: Value) -> str:
    entry = described.entry(index, sub)
    if entry is None:
        raise AssertionError((index, sub))
    number = value if isinstance(value, int) else None
    if number is not None and entry.has_node_id and number & _NODE_ID_BITS == described.node_id:
        return f"$NODEID+0x{number - described.node_id:X}"
    return format_value(entry.letter, value)
