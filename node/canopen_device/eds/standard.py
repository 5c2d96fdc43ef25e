"""What CiA 301 fixes for the communication area (7.5.2) where a file omits or changes it."""

from __future__ import annotations

from canopen_device.core import codes
from canopen_device.core import communication as at
from canopen_device.eds import values
from canopen_device.eds.description import ARRAY, RECORD, VAR, Description, Entry, Object
from canopen_device.eds.sections import EdsFile

_U8, _U16, _U32 = "B", "H", "I"
_VARIABLES = {
    at.DEVICE_TYPE: _U32, at.ERROR_REGISTER: _U8, at.MANUFACTURER_STATUS: _U32, at.COB_ID_SYNC: _U32,
    at.SYNC_PERIOD: _U32, at.SYNC_WINDOW: _U32, at.DEVICE_NAME: "s", at.HARDWARE_VERSION: "s",
    at.SOFTWARE_VERSION: "s", at.GUARD_TIME: _U16, at.LIFE_TIME_FACTOR: _U8, at.COB_ID_TIME: _U32,
    at.HIGH_RESOLUTION_TIME: _U32, at.COB_ID_EMCY: _U32, at.EMCY_INHIBIT_TIME: _U16, at.PRODUCER_HEARTBEAT: _U16,
    at.SYNC_OVERFLOW: _U8, at.STORED_EDS: "D", at.EDS_FORMAT: _U16, at.NMT_STARTUP: _U32,
}  # fmt: skip
_LISTS = {
    at.ERROR_HISTORY: _U32, at.STORE_PARAMETERS: _U32, at.RESTORE_DEFAULTS: _U32, at.CONSUMER_HEARTBEAT: _U32,
    at.IDENTITY: _U32, at.VERIFY_CONFIGURATION: _U32, at.ERROR_BEHAVIOUR: _U8,
}  # fmt: skip
_PDO_PARAMETER = {0: _U8, 1: _U32, 2: _U8, 3: _U16, 4: _U8, 5: _U16, 6: _U8}
_SDO_PARAMETER = {0: _U8, 1: _U32, 2: _U32, 3: _U8}
_MANDATORY = {  # the names of objects, and of the entries of a record
    at.DEVICE_TYPE: ["Device type"], at.ERROR_REGISTER: ["Error register"],
    at.IDENTITY: ["Identity", "Highest sub-index supported", "Vendor-ID", "Product code", "Revision number"],
}  # fmt: skip
_LAST_SDO = at.SDO_SERVER | 0xFF


def standard_letter(index: int, sub: int) -> str | None:
    """Return the type of an entry of the communication area, None where CiA 301 fixes none."""
    if index in _VARIABLES:
        return _VARIABLES[index] if sub == 0 else None
    if at.RPDO <= index <= at.LAST_RPDO or at.TPDO <= index <= at.LAST_TPDO:
        return _PDO_PARAMETER.get(sub)
    if at.SDO_SERVER <= index <= _LAST_SDO:
        return _SDO_PARAMETER.get(sub)
    if index in _LISTS or is_mapping(index):
        return _LISTS.get(index, _U32) if sub else _U8
    return None


def is_mapping(index: int) -> bool:
    """Return whether an object is the mapping of a PDO."""
    return at.RPDO_MAPPING <= index <= at.LAST_RPDO_MAPPING or at.TPDO_MAPPING <= index <= at.LAST_TPDO_MAPPING


def add_mandatory(eds: Description) -> None:
    """Add the objects that every device has (CiA 301, 7.5.2) where the file has none, and report them."""
    for index, (name, *entry_names) in _MANDATORY.items():
        if index in eds.objects:
            continue
        made = eds.objects[index] = Object(index, name, RECORD if entry_names else VAR, 0)
        for sub, entry_name in enumerate(entry_names or [name]):
            letter, default = standard_letter(index, sub) or _U8, 0 if sub else max(0, len(entry_names) - 1)
            made.entries[sub] = Entry(index, sub, entry_name, letter, "ro", default, has_default=not sub)
        value = "the numbers of [DeviceInfo]" if entry_names else "the value 0"
        eds.add(0, f"no object 0x{index:04X}, which is mandatory (CiA 301, 7.5.2); added with {value}")


# --- PDOs that an EDS only counts: CompactPDO, NrOfRXPDO and NrOfTXPDO of [DeviceInfo] (CiA 306-1) -------------

COUNTS = (
    ("NrOfRXPDO", at.RPDO, at.LAST_RPDO, codes.RPDO_BASES),
    ("NrOfTXPDO", at.TPDO, at.LAST_TPDO, codes.TPDO_BASES),
)
# Bit k of CompactPDO: sub-index k + 1 of the communication parameter.
_PARAMETERS = (
    "COB-ID", "Transmission type", "Inhibit time", "Compatibility entry", "Event timer", "SYNC start value",
)  # fmt: skip
_ALL, _MOST = 0x3F, 512
_EVENT_DRIVEN = 255
_BITS = 64


def add_compact_pdos(file: EdsFile, eds: Description) -> None:
    """Add each PDO that is counted, but has no section; without CompactPDO report the count that differs."""
    section = file.sections.get("deviceinfo")
    if section is None:
        return
    mask = values.integer(section.get("CompactPDO") or "0").value or 0
    granularity = values.integer(section.get("Granularity") or "8").value or 8
    if not 0 <= mask <= _ALL:
        section.say("CompactPDO", f"allowed are 0x0 to 0x{_ALL:X}; read as {mask & _ALL:#x}")
        mask &= _ALL
    for key, first, last, bases in COUNTS:
        if not section.get(key):
            continue
        count, _, remark = values.integer(section.get(key) or "")
        there = sum(first <= index <= last for index in eds.objects)
        if remark or count is None or not 0 <= count <= _MOST:
            section.say(key, remark or f"allowed are 0 to {_MOST}")
        elif mask:
            most = _BITS // granularity if 1 <= granularity <= _BITS else 8
            _add(eds, section.line, first, count, mask, bases, most)
        elif count != there:
            kind = "1400h" if first == at.RPDO else "1800h"
            section.say(key, f"the file has {there} PDOs from {kind} on; these apply")


def _add(eds: Description, line: int, first: int, count: int, mask: int, bases: tuple[int, ...], most: int) -> None:
    absent = [number for number in range(_MOST) if first + number not in eds.objects]
    missing = absent[: max(0, count - (_MOST - len(absent)))]
    for number in range(missing[-1] + 1 if missing else 0):
        index, made = first + number, []
        if number in missing:
            made.append(_parameter(eds, line, index, number, mask, bases))
        if index + at.MAPPING not in eds.objects:
            made.append(Object(index + at.MAPPING, "PDO mapping", ARRAY, line))
            for sub in range(most + 1):
                name, letter = (f"Mapped object {sub}", "I") if sub else ("Number of mapped objects", "B")
                made[-1].entries[sub] = Entry(index + at.MAPPING, sub, name, letter, "rw", 0, line=line)
        for added in made:
            eds.objects[added.index] = added
            for entry in added.entries.values():
                eds.take(entry)


def _parameter(eds: Description, line: int, index: int, number: int, mask: int, bases: tuple[int, ...]) -> Object:
    """Return a communication parameter: the identifier of the pre-defined connection set for the first four PDOs."""
    made = Object(index, f"PDO parameter {number + 1}", RECORD, line)
    subs = [k + 1 for k in range(len(_PARAMETERS)) if mask >> k & 1]
    made.entries[0] = Entry(index, 0, "Highest sub-index", "B", "const", max(subs), line=line)
    for sub in subs:
        name, default = _PARAMETERS[sub - 1], _EVENT_DRIVEN if sub == 2 else 0
        made.entries[sub] = Entry(index, sub, name, _PDO_PARAMETER[sub], "rw", default, line=line)
    if 1 in subs and number < len(bases):
        no_rtr = codes.NO_RTR if bases is codes.TPDO_BASES else 0
        made.entries[1].default, made.entries[1].has_node_id = bases[number] + eds.node_id | no_rtr, True
    elif 1 in subs:
        made.entries[1].default = codes.COB_ID_INVALID
    return made
