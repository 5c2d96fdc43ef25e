"""What a finger sends and what it means: read from the node, compared as the wire carries it, and written back.

Every setting of the dictionary is watched; a new object is, too, without a word here.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from canopen_device import types
from canopen_device.core import codes, communication
from canopen_device.types import Value
from tipforce.dictionary import indices, objects, table
from tipforce.dictionary.entries import Entry, entries
from tipforce.dictionary.signals import is_mapping
from tipforce.errors import RefusedError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.configuration_file import Configuration, apply_differences
from tipforce.host.configuration.device_objects import FingertipObjects, Place
from tipforce.host.hand.trust import COMMANDED, COUNTER, SERIAL
from tipforce.host.network.finger import FingertipClient
from tipforce.host.network.sdo import SdoChannel

_NO_EFFECT = (communication.VERIFY_CONFIGURATION,)  # the date of a configuration: settings that nothing follows
_TARE = {entry.key for entry in COMMANDED[1:]}
_CALIBRATION = objects.CALIBRATION_ACTIVE_CRC.key
_INTERRUPTS = range(indices.INTERRUPT_DELTA & 0xFFF, (indices.INTERRUPT_HYSTERESIS & 0xFFF) + 1)
_LAST_PDO = communication.LAST_TPDO
_TRIES = 5


Difference = tuple[Entry[Value], bytes, bytes]
"""Entry, value before and after as the wire carries them."""


@dataclass(frozen=True, slots=True)
class Meaning:
    """``values`` (bytes of the wire) hold while 2126h is ``counter``."""

    counter: int
    values: dict[Place, tuple[Entry[Value], bytes]]

    def numbers(self) -> dict[Place, int]:
        """Return the values as ``Trust`` compares them; 2126h included."""
        numbers = {place: int.from_bytes(data, "little") for place, (_, data) in self.values.items()}
        return numbers | {COUNTER: self.counter}


@lru_cache
def watched(gauges: int) -> dict[Place, Entry[Value]]:
    """Return what decides whether and what a finger sends: every setting, what commands change, and its serial.

    A setting with one allowed value is none.
    """
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
    cob_ids = {place for place in watched(gauges) if place[1] == 1 and communication.RPDO <= place[0] <= _LAST_PDO}
    read = (*COMMANDED, objects.IDENTITY_SERIAL)
    return frozenset(profile | cob_ids | {entry.key for entry in read}) & watched(gauges).keys()


def read_meaning(sdo: SdoChannel, gauges: int, places: Collection[Place] | None = None) -> Meaning:
    """Read what is watched, or some of it.

    Raises as SdoChannel, and RefusedError for a finger that is changed again and again.
    """
    for _ in range(_TRIES):
        counter = sdo.read(objects.CONFIGURATION_COUNTER)
        values: dict[Place, tuple[Entry[Value], bytes]] = {}
        for place, entry in watched(gauges).items():
            index, sub = place
            # The number of mapped objects of a PDO comes before its mapping: the rest of it is not used.
            unused = is_mapping(index) and sub > 0 and (index, 0) in values and sub > values[index, 0][1][0]
            if unused or (places is not None and place not in places):
                continue
            try:
                values[place] = entry, sdo.upload(*place)
            except SdoAbortError as error:
                if error.code != codes.NO_OBJECT:
                    raise
        if sdo.read(objects.CONFIGURATION_COUNTER) == counter:
            return Meaning(counter, values)
    raise RefusedError(f"node {sdo.node_id}: its configuration changes while it is read; stop the other master")


def as_wanted(present: Meaning, wanted: Configuration, calibration: Calibration | None) -> bool:
    """Return whether the settings read are those ``wanted``, and the calibration is this one (None: any)."""
    return _has(present, calibration) and all(
        place not in present.values or entry.encode(value) == present.values[place][1]
        for place, (entry, value) in wanted.items()
    )


def differences(before: Meaning, after: Meaning) -> list[Difference]:
    """Return the entries whose values differ, and their values."""
    both = [(entry, data, after.values.get(place, (entry, b""))[1]) for place, (entry, data) in before.values.items()]
    return [(entry, old, new) for entry, old, new in both if old != new]


def in_words(changes: list[Difference]) -> str:
    """Return differences as text: name, value before and after."""
    shown = [
        f"{entry.name} {types.format_value(entry.type, entry.decode(old))} -> "
        + (types.format_value(entry.type, entry.decode(new)) if new else "none")
        for entry, old, new in changes
    ]
    return ", ".join(shown[:3]) + (f" and {len(shown) - 3} more" if len(shown) > 3 else "")


def only_tare(changes: list[Difference]) -> bool:
    """Return whether nothing but the tare is another."""
    return all(entry.key in _TARE for entry, _, _ in changes)


def needed(changes: list[Difference], wanted: Configuration) -> bool:
    """Return whether the communication of the finger is not that of the hand, which cannot use another."""
    communicated = [entry for entry, _, _ in changes if entry.index <= communication.LAST]
    return any(entry.key in wanted or entry.index == communication.SYNC_OVERFLOW for entry in communicated)


def write_back(
    client: FingertipClient, before: Meaning, changes: list[Difference], calibration: Calibration | None
) -> None:
    """Undo the changes. Raises RefusedError for what cannot be written: see there."""
    places = {entry.key for entry, _, _ in changes}
    if SERIAL in places:
        raise RefusedError(f"node {client.node_id}: it is another finger")
    if _CALIBRATION in places:
        if calibration is None or not _has(before, calibration):
            raise RefusedError(f"node {client.node_id}: another calibration, and the hand file names none to restore")
        client.apply_calibration(calibration, store=False)
    if _TARE & places:
        if any(any(before.values[place][1]) for place in _TARE):
            raise RefusedError(f"node {client.node_id}: its tare before cannot be set again; tare it by the hand")
        client.clear_tare()
    objects_changed = {_with_mapping(index) for index, _ in places}
    rest = {
        place: (entry, entry.decode(data))
        for place, (entry, data) in before.values.items()
        if entry.access == "rw" and _with_mapping(entry.index) in objects_changed
    }
    apply_differences(client.sdo, dict(sorted(rest.items())))


def _with_mapping(index: int) -> int:
    """Return the index; of a PDO that of its communication parameter, for its mapping too."""
    return index & ~communication.MAPPING if communication.RPDO <= index <= communication.LAST_TPDO_MAPPING else index


def _has(present: Meaning, calibration: Calibration | None) -> bool:
    entry, data = present.values[_CALIBRATION]
    return calibration is None or entry.decode(data) == calibration.crc32()


def set_overflow(sdo: SdoChannel, value: int) -> int:
    """Write 1019h and read it back; return its value before. Raises RefusedError if it reads back otherwise."""
    before = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
    if before != value:
        sdo.write(objects.SYNC_COUNTER_OVERFLOW, value)
        present = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
        if present != value:
            raise RefusedError(f"node {sdo.node_id}: 1019h reads back {present}, written was {value}")
    return before
