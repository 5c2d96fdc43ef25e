"""What the PDO values of a finger mean: read from the node, compared, and written back.

2126h counts the changes of it, by whomever; a hand shows values only while it knows what they mean.
"""

from __future__ import annotations

from dataclasses import dataclass

from tipforce.device import communication
from tipforce.dictionary import indices, names, objects, types
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.rows import rows
from tipforce.dictionary.types import Value
from tipforce.errors import RefusedError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.configuration_file import Configuration, apply_differences
from tipforce.host.configuration.settings import same
from tipforce.host.network.finger import FingertipClient
from tipforce.host.network.sdo import SdoChannel

_SETTINGS = (
    indices.SCALING_1_FIELD, indices.SCALING_1_PROCESS, indices.SCALING_2_FIELD, indices.SCALING_2_PROCESS,
    indices.PROCESS_OFFSET, indices.FILTER_TYPE, indices.FILTER_CONSTANT,
)  # fmt: skip
IN_WORDS = "calibration, tare, offsets, scaling, filter and PDOs"
_CALIBRATION = (objects.CALIBRATION_ACTIVE_CRC.index, objects.CALIBRATION_ACTIVE_CRC.sub)
_TARE = {(entry.index, entry.sub) for entry in (objects.TARE_F1, objects.TARE_F2, objects.TARE_F3)}
_OTHERS = {_CALIBRATION, *_TARE, (communication.SYNC_OVERFLOW, 0)}
_TRIES = 5


Difference = tuple[Entry[Value], Value, Value]
"""Entry, value before and after."""


@dataclass(frozen=True, slots=True)
class Meaning:
    """``values`` holds while 2126h is ``counter``."""

    counter: int
    values: Configuration


def meaning_entries(wanted: Configuration, gauges: int) -> list[Entry[Value]]:
    """Return what gives the values of a finger their meaning: its PDOs as in ``wanted``, CRC, tare, settings, 1019h."""
    places = [one for one in rows(gauges) if one in _OTHERS or (one[0] in _SETTINGS and one[1])]
    found = [names.resolve(f"0x{index:04X}:{sub:02X}", gauges) for index, sub in places]
    pdos = [
        entry for entry, _ in wanted.values() if communication.TPDO <= entry.index <= communication.LAST_TPDO_MAPPING
    ]
    return found + [entry for entry in pdos if entry.index > communication.LAST_TPDO or entry.sub <= 2]


def read_meaning(sdo: SdoChannel, entries: list[Entry[Value]]) -> Meaning:
    """Read the entries. Raises as SdoChannel, and RefusedError for a finger that is changed again and again."""
    for _ in range(_TRIES):
        counter = sdo.read(objects.CONFIGURATION_COUNTER)
        values: Configuration = {(entry.index, entry.sub): (entry, sdo.read(entry)) for entry in entries}
        if sdo.read(objects.CONFIGURATION_COUNTER) == counter:
            return Meaning(counter, values)
    raise RefusedError(f"node {sdo.node_id}: its configuration changes while it is read; stop the other master")


def as_wanted(found: Meaning, wanted: Configuration, calibration: Calibration | None) -> bool:
    """Return whether the settings read are those ``wanted``, and the calibration is this one (None: any)."""
    asked = [
        (entry, value, found.values[place][1]) for place, (entry, value) in wanted.items() if place in found.values
    ]
    known = calibration is None or found.values[_CALIBRATION][1] == calibration.crc32()
    return known and all(same(*one) for one in asked)


def differences(before: Meaning, after: Meaning) -> list[Difference]:
    """Return the entries whose values differ, and their values."""
    both = [(entry, value, after.values[place][1]) for place, (entry, value) in before.values.items()]
    return [one for one in both if one[1] != one[2]]


def in_words(changes: list[Difference]) -> str:
    """Return differences as text: name, value before and after."""
    shown = [
        f"{entry.name} {types.format_value(entry.type, old)} -> {types.format_value(entry.type, new)}"
        for entry, old, new in changes
    ]
    return ", ".join(shown[:3]) + (f" and {len(shown) - 3} more" if len(shown) > 3 else "")


def only_tare(changes: list[Difference]) -> bool:
    """Return whether nothing but the tare is another."""
    return all((entry.index, entry.sub) in _TARE for entry, _, _ in changes)


def of_pdos(changes: list[Difference]) -> bool:
    """Return whether the PDOs are others: the hand cannot use these."""
    return any(entry.index <= communication.LAST_TPDO_MAPPING for entry, _, _ in changes)


def write_back(
    client: FingertipClient, before: Meaning, changes: list[Difference], calibration: Calibration | None
) -> None:
    """Undo the changes. Raises RefusedError for a calibration without a file, and a tare that was not zero."""
    places = {(entry.index, entry.sub) for entry, _, _ in changes}
    if _CALIBRATION in places:
        if calibration is None or calibration.crc32() != before.values[_CALIBRATION][1]:
            raise RefusedError(f"node {client.node_id}: another calibration, and the hand file names none to restore")
        client.apply_calibration(calibration, store=False)
    if _TARE & places:
        if any(before.values[place][1] for place in _TARE):
            raise RefusedError(f"node {client.node_id}: its tare before cannot be set again; tare it by the hand")
        client.clear_tare()
    rest = {place: one for place, one in before.values.items() if place != _CALIBRATION and place not in _TARE}
    apply_differences(client.sdo, dict(sorted(rest.items())))


def set_overflow(sdo: SdoChannel, value: int) -> int:
    """Write 1019h and read it back; return its value before. Raises RefusedError if it reads back otherwise."""
    before = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
    if before != value:
        sdo.write(objects.SYNC_COUNTER_OVERFLOW, value)
        found = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
        if found != value:
            raise RefusedError(f"node {sdo.node_id}: 1019h reads back {found}, written was {value}")
    return before
