"""A device from its EDS or DCF, on the device core: dictionary, PDOs, store, identity as the file has them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import canopen_device.core.wide_types  # noqa: F401  (adds the types of CiA 301 that a fingertip does not use)
from canopen_device.core import communication
from canopen_device.core.node import Device
from canopen_device.core.object_dictionary import ADD_NODE_ID, ANY_FLOAT, NOT_STORED, ObjectDictionary
from canopen_device.core.storage import pack_settings, with_crc
from canopen_device.eds.description import CONSTANT, READ_ONLY, Description, Entry
from canopen_device.eds.reader import read_eds
from canopen_device.types import LETTER_OF_CODE, TYPES, Value

if TYPE_CHECKING:
    from canopen_device.core.object_dictionary import Value as CoreValue

Save = Callable[[str, bytes], bool]
Load = Callable[[str], bytes | None]

_GROUPS = (
    ("communication", communication.FIRST, communication.LAST),
    ("application", communication.FIRST_PROFILE, communication.LAST_PROFILE),
    ("manufacturer", communication.FIRST_MANUFACTURER, communication.LAST_MANUFACTURER),
)
MANUFACTURER = 4  # sub-index of 1010h and 1011h: the manufacturer's objects
_NEVER_STORED = (communication.ERROR_HISTORY, communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS)
_LONGEST_DOWNLOAD_BYTES = 16 << 20


class EdsWarning(UserWarning):
    """An EDS or DCF leaves CiA 306 or contradicts itself; the text names the file, the line, and how it is read."""


def device_from_eds(
    path: str | os.PathLike[str], node_id: int | None = None, save: Save | None = None, load: Load | None = None
) -> Device:
    """Return the CANopen device that an EDS, DCF, XDD or XDC describes, as node ``node_id`` (default: that of a DCF).

    A DCF's ParameterValues are its stored parameters at the start. ``save`` and ``load`` keep parameter groups, as
    ``FileStore`` does; without them 1010h and 1011h refuse. An ``EdsWarning`` names each line that leaves CiA 306, and
    how it is read. Raises InputError for a file that is no EDS, and a node-id outside 1 to 127 (255: none yet)."""
    description = read_eds(os.fspath(path), node_id)
    for text in description.warnings:
        warnings.warn(text, EdsWarning, stacklevel=2)
    return device_of(description, save, load)


def device_of(description: Description, save: Save | None = None, load: Load | None = None) -> Device:
    """Return the device of a description."""
    od = ObjectDictionary(description.node_id)
    for entry in description.entries():
        od.add(entry.index, entry.sub, _core_entry(entry, description.node_id))
    codes = range(1, 8) if description.dummies is None else sorted(description.dummies)
    od.dummies = {code: core_kind(LETTER_OF_CODE[code]) for code in codes if code in LETTER_OF_CODE}
    stored_eds = description.objects.get(communication.STORED_EDS)
    if stored_eds is not None and set(stored_eds.entries) == {0}:
        od.readers[communication.STORED_EDS] = lambda _sub: description.content
    given = [entry for entry in description.entries() if entry.value is not None]
    for entry in given:
        if entry.access not in (READ_ONLY, CONSTANT) and entry.value is not None:
            od.values[entry.index << 8 | entry.sub] = core_value(entry.letter, entry.value)
    stored = {name: with_crc(pack_settings(od, first, last)) for name, first, last in _GROUPS if given}

    def load_or_stored(group: str) -> bytes | None:
        data = None if load is None else load(group)
        return stored.get(group) if data is None else data

    device = Device(od, save, load_or_stored if stored else load)
    device.storage.add_range(MANUFACTURER, *_GROUPS[2])
    for index in (communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS):
        device.od.readers[index] = _capability(description, index, device.od.readers[index])
    device.has_lss = description.lss
    device.sdo.max_download_bytes = _LONGEST_DOWNLOAD_BYTES
    if description.bit_rate is not None:
        device.lss.bit_rate = description.bit_rate
    return device


def core_kind(letter: str) -> str:
    """Return the type letter of the device core: bytes for everything without a size, an integer for a time."""
    kind = TYPES[letter]
    if kind.size is None:
        return "D"
    return "u6" if kind.python is bytes else letter


def core_value(letter: str, value: Value) -> CoreValue:
    """Return a value as the device core holds it. A character outside ASCII becomes one byte, as in Latin-1."""
    kind = TYPES[letter]
    if isinstance(value, str):
        return value.encode("utf-16-le") if letter == "u" else value.encode("latin-1", "replace")
    if kind.python is bytes and kind.size is not None and isinstance(value, bytes):
        return int.from_bytes(value, "little")
    return value


def python_value(letter: str, value: CoreValue) -> Value:
    """Return a value of the device core as its data type has it: the inverse of ``core_value``."""
    kind = TYPES[letter]
    if kind.size is not None and kind.python is bytes:
        return int(value).to_bytes(kind.size, "little")
    if isinstance(value, bytes) and kind.python is str:
        return value.decode("utf-16-le", "replace") if letter == "u" else value.decode("latin-1").rstrip("\0")
    return int(value) if kind.python is int and isinstance(value, int) else value


def _capability(
    description: Description, index: int, computed: Callable[[int], CoreValue]
) -> Callable[[int], CoreValue]:
    """Return the reader of 1010h or 1011h: the DefaultValue of the file, where it has one."""
    entries = description.objects[index].entries if index in description.objects else {}
    given = {sub: core_value(entry.letter, entry.default) for sub, entry in entries.items() if entry.has_default}
    return lambda sub: given[sub] if sub in given else computed(sub)


def _core_entry(entry: Entry, node_id: int) -> tuple[str, str, int, CoreValue, int | float | None, int | float | None]:
    flags = entry.directions | ANY_FLOAT
    if entry.index in _NEVER_STORED:
        flags |= NOT_STORED
    default = core_value(entry.letter, entry.default)
    if entry.access in (READ_ONLY, CONSTANT) and entry.value is not None:
        default = core_value(entry.letter, entry.value)  # nothing stores it: the DCF says what the device has
    elif entry.has_node_id and isinstance(default, int):
        flags |= ADD_NODE_ID
        default -= node_id
    access = "rw" if entry.access.startswith("rw") else entry.access
    return core_kind(entry.letter), access, flags, default, entry.low, entry.high
