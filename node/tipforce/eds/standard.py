"""Data types that CiA 301 fixes for the communication area (7.5.2): a file that omits or changes them is read so."""

from __future__ import annotations

from tipforce.device import communication as at
from tipforce.eds.description import RECORD, VAR, Description, Entry, Object

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
_PDO_PARAMETER = {1: _U32, 2: _U8, 3: _U16, 4: _U8, 5: _U16, 6: _U8}
_SDO_PARAMETER = {1: _U32, 2: _U32, 3: _U8}
_MANDATORY = {at.DEVICE_TYPE: "Device type", at.ERROR_REGISTER: "Error register", at.IDENTITY: "Identity"}
_IDENTITY = ("Vendor-ID", "Product code", "Revision number")
_LAST_SDO = at.SDO_SERVER | 0xFF
_TEXT_OR_DATA = ("s", "D")


def standard_letter(index: int, sub: int) -> str | None:
    """Return the type of an entry of the communication area, None where CiA 301 fixes none."""
    if index in _VARIABLES:
        return _VARIABLES[index] if sub == 0 else None
    if index in _LISTS:
        return _LISTS[index] if sub else _U8
    if at.RPDO <= index <= at.LAST_RPDO or at.TPDO <= index <= at.LAST_TPDO:
        return _PDO_PARAMETER.get(sub) if sub else _U8
    if is_mapping(index):
        return _U32 if sub else _U8
    if at.SDO_SERVER <= index <= _LAST_SDO:
        return _SDO_PARAMETER.get(sub) if sub else _U8
    return None


def is_mapping(index: int) -> bool:
    """Return whether an object is the mapping of a PDO."""
    return at.RPDO_MAPPING <= index <= at.LAST_RPDO_MAPPING or at.TPDO_MAPPING <= index <= at.LAST_TPDO_MAPPING


def is_needed_integer(index: int, sub: int) -> bool:
    """Return whether the services of the device compute with an entry: it must be an unsigned integer."""
    letter = standard_letter(index, sub)
    return letter is not None and letter not in _TEXT_OR_DATA


def add_mandatory(found: Description) -> None:
    """Add the objects that every device has (CiA 301, 7.5.2) where the file has none, and report them."""
    for index, name in _MANDATORY.items():
        if index in found.objects:
            continue
        is_record = index == at.IDENTITY
        made = found.objects[index] = Object(index, name, RECORD if is_record else VAR, 0)
        for sub in range(len(_IDENTITY) + 1 if is_record else 1):
            letter, default = standard_letter(index, sub) or _U8, len(_IDENTITY) if is_record and sub == 0 else 0
            entry_name = name if not is_record else ("Highest sub-index supported", *_IDENTITY)[sub]
            made.entries[sub] = Entry(index, sub, entry_name, letter, "ro", default, has_default=not sub)
        value = "the numbers of [DeviceInfo]" if is_record else "the value 0"
        found.add(0, f"no object 0x{index:04X}, which is mandatory (CiA 301, 7.5.2); added with {value}")
