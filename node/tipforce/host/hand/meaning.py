"""What the PDO values of a finger mean: read from the node, compared, and written back.

2126h counts the changes of it, by whomever; a hand shows values only while it knows what they mean.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from tipforce.device import codes, communication
from tipforce.dictionary import indices, names, objects, types
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.rows import rows
from tipforce.errors import RefusedError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.configuration_file import Configuration, apply_configuration
from tipforce.host.network.finger import FingertipClient
from tipforce.host.network.sdo import SdoChannel

_SETTINGS = (
    indices.SCALING_1_FIELD, indices.SCALING_1_PROCESS, indices.SCALING_2_FIELD, indices.SCALING_2_PROCESS,
    indices.PROCESS_OFFSET, indices.FILTER_TYPE, indices.FILTER_CONSTANT,
)  # fmt: skip
IN_WORDS = "calibration, tare, offsets, scaling, filter and PDOs"
_CALIBRATION = (objects.CALIBRATION_ACTIVE_CRC.index, objects.CALIBRATION_ACTIVE_CRC.sub)
_TARE = (objects.TARE_F1, objects.TARE_F2, objects.TARE_F3)
_TRIES = 5


@dataclass(frozen=True, slots=True)
class Meaning:
    """``values`` holds while 2126h is ``counter``."""

    counter: int
    values: Configuration


def read_meaning(sdo: SdoChannel, gauges: int, known: Configuration | None = None) -> Meaning:
    """Read calibration CRC, tare, settings of the channels, PDOs and 1019h. Raises NoResponseError, SdoAbortError.

    ``known``: values that were compared just before and are not read. Raises RefusedError for a finger that is changed
    again and again meanwhile.
    """
    entries = _entries(gauges)
    for _ in range(_TRIES):
        counter = sdo.read(objects.CONFIGURATION_COUNTER)
        values: Configuration = {key: one for key, one in (known or {}).items() if key in entries}
        for (index, sub), entry in entries.items():
            if (index, sub) in values:
                continue
            parameters = index - communication.MAPPING
            if _is_mapping(index) and int(values[parameters, 1][1]) & codes.COB_ID_INVALID:
                continue  # not sent
            if not _is_mapping(index) or sub <= int(values[index, 0][1] if sub else 0):
                values[index, sub] = entry, sdo.read(entry)
        if sdo.read(objects.CONFIGURATION_COUNTER) == counter:
            return Meaning(counter, values)
    raise RefusedError(f"node {sdo.node_id}: its configuration changes while it is read; stop the other master")


def _entries(gauges: int) -> dict[tuple[int, int], Entry[types.Value]]:
    found: dict[tuple[int, int], Entry[types.Value]] = {}
    for index, sub in rows(gauges):
        tpdo = communication.TPDO <= index <= communication.LAST_TPDO
        wanted = (index, sub) == _CALIBRATION or (index in _SETTINGS and sub) or index == communication.SYNC_OVERFLOW
        wanted = wanted or (tpdo and sub in (1, 2)) or (index == indices.TARE and 1 <= sub <= 3)
        if wanted or _is_mapping(index):
            found[index, sub] = names.resolve(f"0x{index:04X}:{sub:02X}", gauges)
    return found


def _is_mapping(index: int) -> bool:
    return communication.TPDO_MAPPING <= index <= communication.LAST_TPDO_MAPPING


def differences(before: Meaning, after: Meaning) -> list[tuple[int, int]]:
    """Return the keys of the entries whose values differ."""
    keys = sorted(before.values.keys() | after.values.keys())
    return [key for key in keys if _value(before, key) != _value(after, key)]


def in_words(before: Meaning, after: Meaning, keys: Iterable[tuple[int, int]]) -> str:
    """Return the differences as text: name, value before and after."""
    parts = []
    for key in keys:
        entry = (before.values.get(key) or after.values[key])[0]
        old, new = (
            "none" if (value := _value(one, key)) is None else types.format_value(entry.type, value)
            for one in (before, after)
        )
        parts.append(f"{entry.name} {old} -> {new}")
    more = f" and {len(parts) - 3} more" if len(parts) > 3 else ""
    return ", ".join(parts[:3]) + more


def _value(one: Meaning, key: tuple[int, int]) -> types.Value | None:
    found = one.values.get(key)
    return None if found is None else found[1]


def acceptable(keys: Iterable[tuple[int, int]]) -> bool:
    """Return whether the hand can use the changed values: not if the PDOs themselves are others."""
    return all(index > communication.LAST_TPDO_MAPPING for index, _ in keys)


def write_back(client: FingertipClient, before: Meaning, after: Meaning, calibration: Calibration | None) -> None:
    """Undo the differences. Raises RefusedError for a calibration without a file, and a tare that was not zero."""
    keys = differences(before, after)
    if _CALIBRATION in keys:
        if calibration is None or calibration.crc32() != _value(before, _CALIBRATION):
            raise RefusedError(f"node {client.node_id}: another calibration, and the hand file names none to restore")
        client.apply_calibration(calibration, store=False)
    tare = {(entry.index, entry.sub) for entry in _TARE}
    if tare & set(keys):
        if any(_value(before, key) for key in tare):
            raise RefusedError(f"node {client.node_id}: its tare before cannot be set again; tare it by the hand")
        client.clear_tare()
    wanted: Configuration = {
        key: before.values[key] for key in keys if key in before.values and key not in tare and key != _CALIBRATION
    }
    for index, _ in list(wanted):
        if _is_mapping(index):  # a mapping is written as a whole
            wanted |= {key: value for key, value in before.values.items() if key[0] == index}
    apply_configuration(client.sdo, dict(sorted(wanted.items())))


def set_overflow(sdo: SdoChannel, value: int) -> int:
    """Write 1019h and read it back; return its value before. Raises RefusedError if it reads back otherwise."""
    before = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
    if before != value:
        sdo.write(objects.SYNC_COUNTER_OVERFLOW, value)
        found = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
        if found != value:
            raise RefusedError(f"node {sdo.node_id}: 1019h reads back {found}, written was {value}")
    return before
