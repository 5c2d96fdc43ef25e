"""A DCF: the EDS of a device with the values of part node (CiA 306-1, 4.7)."""

from collections.abc import Iterable, Mapping

from canopen_device.eds.description import Description
from canopen_device.eds.reader import listed
from canopen_device.eds.sections import EdsFile, Section, parse
from canopen_device.types import Value, format_value

_COMMISSIONING = "devicecomissioning"  # this is the spelling of CiA 306
_NODE_ID_BITS = 0x7F


def dcf_text(described: Description, values: Mapping[tuple[int, int], Value]) -> str:
    """Return the DCF of ``described.node_id`` with these values by (index, sub); comments of the EDS are left out."""
    file = parse(described.content)
    lists: dict[int, dict[int, str]] = {}
    sections = dict(file.sections)
    sections.pop(_COMMISSIONING, None)
    for part in sections.values():
        text = part.keys.pop("parametervalue", None)
        if text and not described.is_dcf and not part.get("DefaultValue"):  # it is the default, see ``reader``
            part.keys["defaultvalue"], part.written["defaultvalue"] = text, "DefaultValue"
    without = {index for index, _ in values} - file.objects.keys() - file.subs.keys()  # such as those of CompactPDO
    compact = {index for index, part in file.objects.items() if part.get("CompactSubObj") and not described.is_dcf}
    listed_defaults = {index for index in compact & described.objects.keys() if "value" in file.lists.get(index, {})}
    written_out = without | listed_defaults  # the list of a DCF has values alone
    for (index, sub), value in sorted(values.items()):
        section = file.entry(index, sub) if sub == 0 or index in file.subs else None
        if index in written_out:
            continue
        if section is None:
            known = file.lists.get(index, {}).get("value")  # its other entries stay as they are
            lists.setdefault(index, {} if known is None else listed(known))[sub] = _text(described, index, sub, value)
        else:
            section.keys["parametervalue"] = _text(described, index, sub, value)
            section.written["parametervalue"] = "ParameterValue"
    _list_objects(file, without)
    lines = _section_lines(file, sections.values(), lists, listed_defaults)
    lines += [line for index in sorted(written_out) for line in _object_lines(described, index, values)]
    commissioning = ["[DeviceComissioning]", f"NodeID={described.node_id}", f"NodeName={described.node_name}"]
    if described.bit_rate is not None:
        commissioning.append(f"Baudrate={described.bit_rate // 1000}")
    return "\n".join([*lines, *commissioning, "CANopenManager=0", ""])


def _section_lines(
    file: EdsFile, sections: Iterable[Section], lists: Mapping[int, Mapping[int, str]], left_out: Iterable[int]
) -> list[str]:
    """Return the lines of the sections without those of ``left_out``; ``lists``: new lists of values, by index."""
    replaced = {id(part["value"]) for index, part in file.lists.items() if index in lists and "value" in part}
    for index in left_out:
        replaced.update(map(id, (file.objects[index], *file.lists[index].values(), *file.subs.get(index, {}).values())))
    behind = {id(part): lists[index] for index, part in file.objects.items() if index in lists}
    lines: list[str] = []
    for part in sections:
        if id(part) not in replaced:
            lines += part.text_lines()
        if id(part) in behind:  # the list of the values of a compact object stands behind its section
            texts = [f"{sub}={text}" for sub, text in sorted(behind[id(part)].items())]
            lines += [f"[{part.name}Value]", f"NrOfEntries={len(texts)}", *texts, ""]
    return lines


def _list_objects(file: EdsFile, indices: Iterable[int]) -> None:
    section = file.sections.get("optionalobjects")
    if section is None:
        return
    first = sum(key.isdigit() for key in section.keys) + 1
    for count, index in enumerate(sorted(indices), first):
        for key, text in ((str(count), f"0x{index:04X}"), ("supportedobjects", str(count))):
            section.keys[key] = text
            section.written.setdefault(key, key)


def _object_lines(described: Description, index: int, values: Mapping[tuple[int, int], Value]) -> list[str]:
    added = described.objects[index]
    lines = [f"[{index:04X}]", f"ParameterName={added.name}", f"ObjectType=0x{added.code:X}"]
    lines += [f"SubNumber={len(added.entries)}", ""]
    for sub, entry in sorted(added.entries.items()):
        lines += [f"[{index:04X}sub{sub:X}]", f"ParameterName={entry.name}", f"DataType=0x{entry.type.code:04X}"]
        lines += [f"AccessType={entry.access}", f"DefaultValue={_text(described, index, sub, entry.default)}"]
        facts = ("PDOMapping", int(entry.mappable)), ("ObjFlags", entry.flags), ("Unit", entry.unit)
        limits = {"LowLimit": entry.low, "HighLimit": entry.high}
        lines += [f"{key}={fact}" for key, fact in (*facts, ("Denotation", entry.denotation)) if fact]
        lines += [f"{key}={format_value(entry.letter, end)}" for key, end in limits.items() if end is not None]
        if (index, sub) in values:
            lines.append(f"ParameterValue={_text(described, index, sub, values[index, sub])}")
        lines.append("")
    return lines


def _text(described: Description, index: int, sub: int, value: Value) -> str:
    entry = described.entry(index, sub)
    assert entry is not None
    if isinstance(value, int) and entry.has_node_id and value & _NODE_ID_BITS == described.node_id:
        return f"$NODEID+0x{value - described.node_id:X}"
    return format_value(entry.letter, value)
