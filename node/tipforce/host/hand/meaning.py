"""What a finger sends and what it means: read from the node, compared as the wire carries it, and written back. Every
setting of the dictionary is watched; a new object is, too, without a word here."""

from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import Any

from canopen_device import types
from canopen_device.core import codes, communication
from canopen_device.types import Value
from tipforce.dictionary import indices, objects, table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import entries
from tipforce.errors import RefusedError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.configuration_file import Configuration, apply_differences
from tipforce.host.configuration.device_objects import FingertipObjects, Place
from tipforce.host.hand.trust import COMMANDED, COUNTER, SERIAL
from tipforce.host.network.finger import Finger
from tipforce.host.network.sdo import SdoChannel

_NO_EFFECT = (communication.VERIFY_CONFIGURATION,)  # the date of a configuration: settings that nothing follows
TARE = {entry.key for entry in COMMANDED[1:]}
_CALIBRATION = objects.CALIBRATION_ACTIVE_CRC.key
_INTERRUPTS = range(indices.INTERRUPT_DELTA & 0xFFF, (indices.INTERRUPT_HYSTERESIS & 0xFFF) + 1)
_TRIES = 5

Meaning = Mapping[Place, int]
"""Objects as the wire carries them, little-endian; they hold while 2126h is that among them."""
Changes = dict[Place, tuple[int, int | None]]
"""Values before and after; None: there is none."""


@lru_cache
def watched(gauges: int) -> dict[Place, Entry[Value]]:
    """What decides whether and what a finger sends: settings with several values, what commands change, its serial."""
    watched_entries: list[Entry[Any]] = [
        entry
        for entry in FingertipObjects(0, gauges).settings.values()
        if entry.index not in _NO_EFFECT and (entry.low is None or entry.low != entry.high)
    ]
    watched_entries += [*COMMANDED, objects.IDENTITY_SERIAL]
    return {entry.key: entry for entry in watched_entries}


@lru_cache
def of_values(gauges: int) -> frozenset[Place]:
    """Return what decides, besides the settings of a hand file, which values a finger sends and what they mean."""
    profile = {
        place
        for place, entry in entries(gauges).items()
        if entry.flags & table.COUNTED and entry.index >= indices.FIELD_VALUE and entry.index & 0xFFF not in _INTERRUPTS
    }
    pdos = range(communication.RPDO, communication.LAST_TPDO + 1)
    cob_ids = {(index, sub) for index, sub in watched(gauges) if sub == 1 and index in pdos}
    read = (*COMMANDED, objects.IDENTITY_SERIAL)
    return frozenset(profile | cob_ids | {entry.key for entry in read}) & watched(gauges).keys()


def read_meaning(sdo: SdoChannel, gauges: int, places: Collection[Place] | None = None) -> Meaning:
    """Read what is watched, or some of it. Raises as SdoChannel, and RefusedError for a finger that keeps changing."""
    for _ in range(_TRIES):
        meaning = {COUNTER: sdo.read(objects.CONFIGURATION_COUNTER)}
        for index, sub in watched(gauges):
            # The number of mapped objects of a PDO comes before its mapping: the rest of it is not used.
            unused = communication.is_mapping(index) and sub > meaning.get((index, 0), sub)
            if unused or (places is not None and (index, sub) not in places):
                continue
            try:
                meaning[index, sub] = int.from_bytes(sdo.upload(index, sub), "little")
            except SdoAbortError as error:
                if error.code != codes.NO_OBJECT:
                    raise
        if sdo.read(objects.CONFIGURATION_COUNTER) == meaning[COUNTER]:
            return meaning
    raise RefusedError(f"node {sdo.node_id}: its configuration changes while it is read; stop the other master")


def numbers(wanted: Configuration) -> dict[Place, int]:
    """Return settings as the wire carries them."""
    return {place: int.from_bytes(entry.encode(value), "little") for place, (entry, value) in wanted.items()}


def as_wanted(present: Meaning, wanted: Configuration, calibration: Calibration | None) -> bool:
    """Return whether the settings read are those ``wanted``, and the calibration is this one (None: any)."""
    settings = numbers(wanted).items()
    return _has(present, calibration) and all(present.get(place, number) == number for place, number in settings)


def differences(before: Meaning, after: Meaning) -> Changes:
    """Return what differs, besides 2126h."""
    return {
        place: (value, after.get(place)) for place, value in before.items()
        if place != COUNTER and value != after.get(place)
    }  # fmt: skip


def in_words(changes: Changes, gauges: int) -> str:
    """Return differences as text: name, value before and after."""
    shown = []
    for place, values in changes.items():
        entry = watched(gauges)[place]
        old, new = ("none" if n is None else types.format_value(entry.type, _value(entry, n)) for n in values)
        shown.append(f"{entry.name} {old} -> {new}")
    return ", ".join(shown[:3]) + (f" and {len(shown) - 3} more" if len(shown) > 3 else "")


def _value(entry: Entry[Value], number: int) -> Value:
    return entry.decode(number.to_bytes(types.data_type(entry.type).size or 0, "little"))


def needed(changes: Changes, wanted: Configuration) -> bool:
    """Return whether the communication of the finger is not that of the hand, which cannot use another."""
    communicated = {(index, sub) for index, sub in changes if index <= communication.LAST}
    return bool(communicated & (wanted.keys() | {objects.SYNC_COUNTER_OVERFLOW.key}))


def write_back(finger: Finger, gauges: int, before: Meaning, changes: Changes, calibration: Calibration | None) -> None:
    """Undo the changes. Raises RefusedError for what cannot be written: see there."""
    if SERIAL in changes:
        raise RefusedError(f"node {finger.node_id}: it is another finger")
    if _CALIBRATION in changes:
        if calibration is None or not _has(before, calibration):
            raise RefusedError(f"node {finger.node_id}: another calibration, and the hand file names none to restore")
        finger.apply_calibration(calibration, store=False)
    if TARE & changes.keys():
        if any(before[place] for place in TARE):
            raise RefusedError(f"node {finger.node_id}: its tare before cannot be set again; tare it by the hand")
        finger.clear_tare()
    objects_changed = {_with_mapping(index) for index, _ in changes}
    rest = {
        place: (entry, _value(entry, before[place]))
        for place, entry in sorted(watched(gauges).items())
        if place in before and entry.access == "rw" and _with_mapping(entry.index) in objects_changed
    }
    apply_differences(finger.sdo, rest)


def _with_mapping(index: int) -> int:
    """Return the index; of a PDO that of its communication parameter, for its mapping too."""
    return index & ~communication.MAPPING if communication.RPDO <= index <= communication.LAST_TPDO_MAPPING else index


def _has(present: Meaning, calibration: Calibration | None) -> bool:
    return calibration is None or present[_CALIBRATION] == calibration.crc32()


def set_overflow(sdo: SdoChannel, value: int) -> int:
    """Write 1019h and read it back; return its value before. Raises RefusedError if it reads back otherwise."""
    before = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
    if before != value:
        sdo.write(objects.SYNC_COUNTER_OVERFLOW, value)
        present = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
        if present != value:
            raise RefusedError(f"node {sdo.node_id}: 1019h reads back {present}, written was {value}")
    return before
