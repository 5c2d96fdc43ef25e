"""PDOs that an EDS only counts: CompactPDO, NrOfRXPDO and NrOfTXPDO of [DeviceInfo] (CiA 306-1)."""

from __future__ import annotations

from tipforce.device import codes, communication
from tipforce.eds import description as eds
from tipforce.eds import values
from tipforce.eds.description import Description, Entry, Object
from tipforce.eds.sections import EdsFile, Section

COUNTS = (
    ("NrOfRXPDO", communication.RPDO, communication.LAST_RPDO, codes.RPDO_BASES),
    ("NrOfTXPDO", communication.TPDO, communication.LAST_TPDO, codes.TPDO_BASES),
)
_PARAMETERS = (  # bit k of CompactPDO: sub-index k + 1 of the communication parameter
    ("COB-ID", "I"), ("Transmission type", "B"), ("Inhibit time", "H"), ("Compatibility entry", "B"),
    ("Event timer", "H"), ("SYNC start value", "B"),
)  # fmt: skip
_ALL, _MOST = 0x3F, 512
_EVENT_DRIVEN = 255
_BITS = 64


def add_compact_pdos(file: EdsFile, found: Description) -> None:
    """Add each PDO that is counted, but has no section; without CompactPDO report the count that differs."""
    section = file.sections.get("deviceinfo")
    if section is None:
        return
    mask = values.integer(section.get("CompactPDO") or "0").value or 0
    granularity = values.integer(section.get("Granularity") or "8").value or 8
    if not 0 <= mask <= _ALL:
        found.findings.append(section.finding("CompactPDO", f"allowed are 0x0 to 0x{_ALL:X}; read as {mask & _ALL:#x}"))
        mask &= _ALL
    for key, first, last, bases in COUNTS:
        if not section.get(key):
            continue
        count, _, remark = values.integer(section.get(key) or "")
        there = sum(first <= index <= last for index in found.objects)
        if remark or count is None or not 0 <= count <= _MOST:
            found.findings.append(section.finding(key, remark or f"allowed are 0 to {_MOST}"))
        elif mask:
            _add(section, found, first, count, mask, bases, granularity)
        elif count != there:
            kind = "1400h" if first == communication.RPDO else "1800h"
            found.findings.append(section.finding(key, f"the file has {there} PDOs from {kind} on; these apply"))


def _add(
    section: Section, found: Description, first: int, count: int, mask: int, bases: tuple[int, ...], granularity: int
) -> None:
    listed = {index for index in found.objects if first <= index <= first + _MOST - 1}
    missing = max(0, count - len(listed))
    number = 0
    while missing and number < _MOST:
        index = first + number
        mapping = index + communication.MAPPING
        made = []
        if index not in found.objects:
            made.append(_parameter(section, found, index, number, mask, bases))
            missing -= 1
        if mapping not in found.objects:
            made.append(_mapping(section, mapping, granularity))
        for one in made:
            found.objects[one.index] = one
            for entry in one.entries.values():
                found.take(entry)
        number += 1


def _parameter(
    section: Section, found: Description, index: int, number: int, mask: int, bases: tuple[int, ...]
) -> Object:
    """Return a communication parameter: the identifier of the pre-defined connection set for the first four PDOs."""
    made = Object(index, f"PDO parameter {number + 1}", eds.RECORD, section.line)
    subs = [k + 1 for k in range(len(_PARAMETERS)) if mask >> k & 1]
    made.entries[0] = Entry(index, 0, "Highest sub-index", "B", "const", max(subs), line=section.line)
    for sub in subs:
        name, letter = _PARAMETERS[sub - 1]
        entry = Entry(index, sub, name, letter, "rw", 0, line=section.line)
        if sub == 1 and number < len(bases):
            entry.default, entry.has_node_id = bases[number] + found.node_id, True
            if bases is codes.TPDO_BASES:
                entry.default |= codes.NO_RTR
        elif sub == 1:
            entry.default = codes.COB_ID_INVALID
        elif sub == 2:
            entry.default = _EVENT_DRIVEN
        made.entries[sub] = entry
    return made


def _mapping(section: Section, index: int, granularity: int) -> Object:
    made = Object(index, "PDO mapping", eds.ARRAY, section.line)
    most = _BITS // granularity if 1 <= granularity <= _BITS else 8
    made.entries[0] = Entry(index, 0, "Number of mapped objects", "B", "rw", 0, line=section.line)
    for sub in range(1, most + 1):
        made.entries[sub] = Entry(index, sub, f"Mapped object {sub}", "I", "rw", 0, line=section.line)
    return made
