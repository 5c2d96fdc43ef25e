"""What is wrong with the PDOs of an EDS: mapped objects that are not there, can't be mapped, don't fit."""

from __future__ import annotations

from collections.abc import Iterator

from tipforce.device import communication
from tipforce.dictionary import types
from tipforce.eds.sections import EdsFile, Section
from tipforce.errors import InputError

MAX_BITS = 64
# direction: (communication, mapping, count in [DeviceInfo], access types that this direction can't carry)
_DIRECTIONS = (
    (communication.RPDO, communication.RPDO_MAPPING, "NrOfRXPDO", ("ro", "const", "rwr")),
    (communication.TPDO, communication.TPDO_MAPPING, "NrOfTXPDO", ("wo", "rww")),
)
_MOST_PDOS = 512


def lint_pdos(eds: EdsFile) -> Iterator[str]:
    """Complaints about the PDO parameters and the default mappings (CiA 301, 7.5.2.33 to 7.5.2.38)."""
    for parameters, mapping, key, refused in _DIRECTIONS:
        pdos = {i - parameters for i in eds.objects if 0 <= i - parameters < _MOST_PDOS}
        mapped = {i - mapping for i in eds.objects if 0 <= i - mapping < _MOST_PDOS}
        for k in sorted(pdos - mapped):
            yield f"[{parameters + k:04X}]: its mapping [{mapping + k:04X}] is missing"
        for k in sorted(mapped - pdos):
            yield f"[{mapping + k:04X}]: its communication parameters [{parameters + k:04X}] are missing"
        info = eds.sections.get("deviceinfo")
        if info is not None and _number(info.get(key)) != len(pdos):
            yield info.complaint(key, f"there are {len(pdos)} such PDOs")
        for k in sorted(mapped):
            yield from _mapping(eds, mapping + k, refused)


def _mapping(eds: EdsFile, index: int, refused: tuple[str, ...]) -> Iterator[str]:
    subs = eds.subs.get(index, {})
    count = _number(subs[0].get("DefaultValue")) if 0 in subs else None
    bits = 0
    for sub in range(1, (count or 0) + 1):
        section = subs.get(sub)
        if section is None:
            yield f"[{index:04X}]: {count} objects are mapped, [{index:04X}sub{sub:X}] is missing"
            continue
        value = _number(section.get("DefaultValue"))
        if value is None:
            yield section.complaint("DefaultValue", "allowed is index, sub-index, bits: 0xIIIISSBB")
            continue
        bits += value & 0xFF
        yield from _mapped(eds, section, value, refused)
    if bits > MAX_BITS:
        yield f"[{index:04X}]: the mapping has {bits} bits, allowed are at most {MAX_BITS}"


def _mapped(eds: EdsFile, section: Section, value: int, refused: tuple[str, ...]) -> Iterator[str]:
    index, sub, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
    if index < 0x20:
        dummy = eds.sections.get("dummyusage")
        if dummy is None or dummy.get(f"Dummy{index:04d}") != "1":
            yield section.complaint("DefaultValue", f"[DummyUsage] does not have Dummy{index:04d}=1")
        return
    target = eds.entry(index, sub)
    if target is None:
        yield section.complaint("DefaultValue", f"there is no 0x{index:04X}:{sub:02X}")
        return
    if _number(target.get("PDOMapping")) != 1:
        yield section.complaint("DefaultValue", f"[{target.name}] is not mappable, PDOMapping is not 1")
    if (target.get("AccessType") or "").lower() in refused:
        yield section.complaint("DefaultValue", f"[{target.name}] is {target.get('AccessType')}")
    letter = types.LETTER_OF_CODE.get(_number(target.get("DataType")) or 0)
    size = types.data_type(letter).size if letter else None
    if size is not None and bits != 8 * size:
        yield section.complaint("DefaultValue", f"{bits} bits, [{target.name}] has {8 * size}")


def _number(text: str | None) -> int | None:
    try:
        value = types.parse_value("I", text or "")
    except InputError:
        return None
    return value if isinstance(value, int) else None
