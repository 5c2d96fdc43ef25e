"""Settings of a node as TOML: read, compare, and apply a file (TOML or DCF) in the order of CiA 301. No calibration."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec
import tomli_w

from canopen_device import types
from canopen_device.core import codes, communication
from canopen_device.toml_table import convert, read_table
from canopen_device.types import Value
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import describe
from tipforce.errors import InputError, SdoAbortError, TipforceError, placed
from tipforce.host.configuration.device_objects import DeviceObjects, EdsObjects, FingertipObjects, Place
from tipforce.host.network.sdo import SdoChannel, finished


def read_settings(
    sdo: SdoChannel, objects: DeviceObjects, advance: Callable[[], None] = lambda: None
) -> dict[Place, Value]:
    """Return every setting that a node has; ``advance()`` after each. Raises NoResponseError, for a fingertip also
    SdoAbortError. What another device does not give as in its EDS, or a text shown with escapes, is left out."""
    values: dict[Place, Value] = {}
    for place, entry in objects.settings.items():
        try:
            content = sdo.upload(*place)
            value = entry.decode(content)
            if entry.type not in "su" or entry.encode(value).rstrip(b"\0") == content.rstrip(b"\0"):
                values[place] = value
        except (SdoAbortError, InputError) as error:
            is_missing = isinstance(error, SdoAbortError) and error.code == codes.NO_OBJECT
            if isinstance(objects, FingertipObjects) and not is_missing:
                raise
        advance()
    return values


def changed_settings(settings: Mapping[Place, Value], objects: DeviceObjects) -> dict[Place, Value]:
    """Return the settings that differ from their default; of a remapped PDO its whole mapping."""
    known = objects.settings
    changed = {place for place, value in settings.items() if not _same(known[place], value, known[place].default)}
    remapped = {index for index, _ in changed if communication.is_mapping(index)}
    return {
        (index, sub): value
        for (index, sub), value in settings.items()
        if (index, sub) in changed or (index in remapped and sub <= int(settings.get((index, 0), 0)))
    }


def compare(node: Mapping[Place, Value], wanted: Configuration, objects: DeviceObjects) -> list[dict[str, str | None]]:
    """Return the differences between a node and a file, both ways: also changes missing in the file. Each has name,
    entry, node and other (in the file), as text; None: that side does not contain it."""
    differences = []
    for place in sorted({*changed_settings(node, objects), *wanted} & objects.settings.keys()):
        entry, here, there = objects.settings[place], node.get(place), wanted[place][1] if place in wanted else None
        if here is None or there is None or not _same(entry, here, there):
            node_has, file_has = (v if v is None else types.format_value(entry.type, v) for v in (here, there))
            differences.append({"name": entry.name, "entry": str(entry), "node": node_has, "other": file_has})
    return differences


def settings_toml(settings: Mapping[Place, Value], objects: DeviceObjects, node_id: int) -> str:
    """Return a file for `tipforce config apply`. COB-IDs that depend on the node-id are relative, to fit any node."""
    known = objects.settings
    written: dict[str, object] = {}
    for (index, sub), value in sorted(settings.items()):
        if not communication.is_mapping(index):
            entry, shown = known[index, sub], value
            if isinstance(value, bytes):
                shown = types.format_value(entry.type, value)
            elif entry.flags & table.ADD_NODE_ID and isinstance(value, int) and value & codes.NODE_ID_MASK == node_id:
                shown = f"{NODE_ID_MARK}+0x{value - node_id:X}"
            elif entry.stem.endswith("cob_id") and isinstance(value, int):
                shown = f"0x{value:X}"
            written[entry.name] = shown
        elif sub == 0:
            words = [int(settings[index, k]) for k in range(1, int(value) + 1) if (index, k) in settings]
            array = known[index, 1].stem if (index, 1) in known else f"0x{index:04X}"
            named = [objects.name(word >> 16, word >> 8 & 0xFF) or word for word in words]
            written[array] = [n if _mapped(n, objects) == word else word for n, word in zip(named, words, strict=True)]
    return tomli_w.dumps({"objects": written}, multiline_strings=False)


def _same(entry: Entry[Value], a: Value, b: Value) -> bool:
    """Whether both are equal on the wire: a REAL32 default is compared as REAL32."""
    try:
        return entry.encode(a) == entry.encode(b)
    except InputError:  # an EDS may have a default that its type does not
        return a == b


Configuration = dict[Place, tuple[Entry[Value], Value]]
"""By (index, sub), in index order: the entry and its required value."""

NODE_ID_MARK = "$NODEID"
"""In a value: the node-id to which the file is applied, as in a DCF (CiA 306): "$NODEID+0x40000180"."""

_NUMBER = r"(0[xX][0-9a-fA-F]+|\d+)"
_FOLLOWS_NODE_ID = re.compile(rf"(?i:\$NODEID)(?:\s*\+\s*{_NUMBER})?|{_NUMBER}\s*\+\s*(?i:\$NODEID)")


class _File(msgspec.Struct, forbid_unknown_fields=True):
    objects: dict[str, int | float | str | list[int | float | str]]


def read_configuration(
    path: str | Path, node_id: int, gauges: int = 3, objects: DeviceObjects | None = None,
    note: Callable[[str], object] = lambda _warning: None,
) -> Configuration:  # fmt: skip
    """Return the content of a file: a DCF or XDC by its extension, otherwise TOML with a table [objects]. ``objects``:
    by default a fingertip's; ``note`` gets the warnings of a DCF. Raises InputError naming the file, the object, the
    value and what is allowed, also for a value that the file sets twice."""
    known = FingertipObjects(node_id, gauges) if objects is None else objects
    is_dcf = str(path).lower().endswith((".dcf", ".eds", ".xdc", ".xdd"))
    in_toml = {} if is_dcf else convert(_File, read_table(path, str(path)), str(path)).objects
    stated: Mapping[str, object] = dict(_of_dcf(path, node_id, known, note)) if is_dcf else in_toml
    wanted: Configuration = {}
    with placed(str(path)):
        for name, value in stated.items():
            for entry, single in _single_values(name, value if is_dcf else _numbered(value, node_id), known):
                if entry.access in ("rw", "wo"):
                    entry.encode(single)
                    known.check(entry, single)
                    if entry.key in wanted and not _same(entry, wanted[entry.key][1], single):
                        raise InputError(f"{entry.name} ({entry}) is set to {wanted[entry.key][1]!r} and to {single!r}")
                    wanted[entry.key] = entry, single
                elif not is_dcf:  # there it is a fact of the device
                    raise InputError(f"{entry.name} ({entry}) is {entry.access} and cannot be configured")
        if not wanted:
            raise InputError("no object is set")
    return dict(sorted(wanted.items()))


def _of_dcf(
    path: str | Path, node_id: int, known: DeviceObjects, note: Callable[[str], object]
) -> Iterator[tuple[str, Value]]:
    from canopen_device.eds.reader import read_eds

    described = read_eds(path, node_id)
    for warning in described.warnings:
        note(f"warning: {warning}")
    for of in described.entries():
        is_fact = of.access in ("ro", "const") or (isinstance(known, EdsObjects) and known.refuses_write(of))
        if of.value is not None and not is_fact:
            if of.is_other:
                raise InputError(f"{path}:{of.remark.partition('; ')[0]}")
            yield of.place, of.value


def _numbered(value: object, node_id: int) -> object:
    if not isinstance(value, str) or NODE_ID_MARK not in value.upper():
        return value
    match = _FOLLOWS_NODE_ID.fullmatch(value.strip())
    if match is None:
        raise InputError(f"{value!r}: write {NODE_ID_MARK}+0x180 or 0x180+{NODE_ID_MARK}")
    return int(match[1] or match[2] or "0", 0) + node_id


def _single_values(name: str, value: object, objects: DeviceObjects) -> list[tuple[Entry[Value], Value]]:
    """Return a value, or a list for an array from sub-index 1; a list for a PDO mapping also sets its length."""
    if not isinstance(value, list):
        entry = objects.resolve(name)
        return [(entry, _typed(entry, value))]
    first = objects.resolve(f"{name}:1")
    # By number from here on: after a dotted name a sub-index is decimal, after an index hexadecimal.
    entries = [objects.resolve(f"0x{first.index:04X}:{k + 1:02X}") for k in range(len(value))]
    if not communication.is_mapping(first.index):
        return [(entry, _typed(entry, item)) for entry, item in zip(entries, value, strict=True)]
    words = [_mapped(item, objects) for item in value]
    return [(objects.resolve(f"0x{first.index:04X}:00"), len(words)), *zip(entries, words, strict=True)]


def _mapped(item: Value, objects: DeviceObjects) -> Value:
    """Return index, sub-index and length in bits of an entry by its name (CiA 301, 7.5.2.36); a number as it is."""
    of = objects.resolve(item) if isinstance(item, str) else None
    return item if of is None else of.index << 16 | of.sub << 8 | 8 * (types.data_type(of.type).size or 0)


def _typed(entry: Entry[Value], value: object) -> Value:
    kind = types.data_type(entry.type).python
    if isinstance(value, str) and kind is not str:
        with placed(f"{entry.name} ({entry})"):
            return types.parse_value(entry.type, value)
    return value  # type: ignore[return-value]  # entry.encode checks its type


def apply_configuration(sdo: SdoChannel, wanted: Configuration) -> None:
    """Write every object; PDO parameters by the procedure of 7.5.2.36. Raises NoResponseError and SdoAbortError. If it
    ends before the last, also by Ctrl-C, the previous values are restored as far as the node accepts them."""
    finished(apply_configuration_async(sdo, wanted, blocks=True))


async def apply_configuration_async(sdo: SdoChannel, wanted: Configuration, *, blocks: bool = False) -> None:
    """Apply for asyncio: several nodes are configured at once; ``blocks`` as of ``SdoChannel.read_async``. Raises as
    ``apply_configuration``."""
    before = await _present(sdo, wanted, blocks)
    try:
        for entry, value in _in_order(wanted, before):
            await sdo.write_async(entry, value, blocks=blocks)
    except BaseException:
        with contextlib.suppress(TipforceError):
            for entry, value in _in_order(before, wanted):
                with contextlib.suppress(SdoAbortError):
                    await sdo.write_async(entry, value, blocks=blocks)
        raise


async def _present(sdo: SdoChannel, wanted: Configuration, blocks: bool) -> Configuration:
    """Return the node's present values of the objects that ``wanted`` changes; of a PDO its whole mapping."""
    entries = {key: entry for key, (entry, _) in wanted.items() if entry.access != "wo"}
    for pdo in _pdos(wanted):
        mapping = pdo + communication.MAPPING
        entries[pdo, 1] = _entry(pdo, 1, "I")
        if any(index == mapping for index, _ in wanted):
            entries[mapping, 0] = count = _entry(mapping, 0, "B")
            for sub in range(1, int(await sdo.read_async(count, blocks=blocks)) + 1):
                entries[mapping, sub] = _entry(mapping, sub, "I")
    return {place: (entry, await sdo.read_async(entry, blocks=blocks)) for place, entry in sorted(entries.items())}


def _in_order(values: Configuration, before: Configuration) -> Iterator[tuple[Entry[Value], Value]]:
    """The writes PDO by PDO: switched off, remapped, its other parameters, its COB-ID (7.5.2.36); then what changes of
    other services is switched off, and all else is written, 1006h last: 1019h needs 0 there (7.5.2.22)."""
    final = before | values
    for pdo in _pdos(values):
        mapping = pdo + communication.MAPPING
        cob_id, count = _entry(pdo, 1, "I"), _entry(mapping, 0, "B")  # of any device (7.5.2.35)
        _, can_id = final[cob_id.key]
        yield cob_id, int(can_id) | codes.COB_ID_INVALID
        if any(index == mapping for index, _ in values):
            yield count, 0
            yield from (write for (index, sub), write in values.items() if index == mapping and sub)
            yield count, final[count.key][1]
        yield from (write for (index, sub), write in values.items() if index == pdo and sub != 1)
        yield cob_id, can_id
    period = communication.SYNC_PERIOD, 0
    for place, (entry, value) in values.items():
        off = _switched_off(*place, value)
        differs = place == period or place not in before or before[place][1] != value
        if off is not None and off != value and differs:
            yield entry, off
    yield from (write for place, write in values.items() if not _is_pdo(place[0]) and place != period)
    yield from (write for place, write in values.items() if place == period)


def _switched_off(index: int, sub: int, value: Value) -> Value | None:
    """Return what to write before a value of a service that only changes while it is off; None if it needs nothing."""
    if index == communication.COB_ID_EMCY or (index >> 8 == communication.SDO_SERVER >> 8 and sub in (1, 2)):
        return int(value) | codes.COB_ID_INVALID
    if index == communication.COB_ID_SYNC:
        return int(value) & ~codes.SYNC_PRODUCER
    return 0 if index in (communication.SYNC_PERIOD, communication.CONSUMER_HEARTBEAT) else None


def _pdos(values: Configuration) -> list[int]:
    return sorted({index & ~communication.MAPPING for index, _ in values if _is_pdo(index)})


def _entry(index: int, sub: int, letter: str) -> Entry[Value]:
    known = describe(index, sub, table.MAX_GAUGES)
    return Entry[Value](index, sub, letter, f"0x{index:04X}:{sub:02X}" if known is None else known.name, "rw", "")


def apply_differences(sdo: SdoChannel, wanted: Configuration) -> Configuration:
    """Apply only what differs on the node, a PDO mapping as a whole; return what was written. Raises as the above."""
    differing = finished(_differing(sdo, wanted, blocks=True))
    mappings = {index for index, _ in differing if communication.is_mapping(index)}
    written = {
        place: (entry, value)
        for place, (entry, value) in wanted.items()
        if place in differing or place[0] in mappings or entry.access == "wo"
    }
    if written:
        apply_configuration(sdo, written)
    return written


def verify_configuration(sdo: SdoChannel, wanted: Configuration) -> list[dict[str, object]]:
    """Return the differences: object, expected, found; write-only objects cannot be compared and are excluded."""
    return finished(verify_configuration_async(sdo, wanted, blocks=True))


async def verify_configuration_async(
    sdo: SdoChannel, wanted: Configuration, *, blocks: bool = False
) -> list[dict[str, object]]:
    """Verify for asyncio; ``blocks`` as of ``apply_configuration_async``."""
    differences: list[dict[str, object]] = []
    for place, present in (await _differing(sdo, wanted, blocks)).items():
        entry, value = wanted[place]
        shown, expected = types.format_value(entry.type, present), types.format_value(entry.type, value)
        differences.append({"object": f"{entry.name} ({entry})", "expected": expected, "found": shown})
    return differences


async def _differing(sdo: SdoChannel, wanted: Configuration, blocks: bool) -> dict[Place, Value]:
    differing: dict[Place, Value] = {}
    for place, (entry, value) in wanted.items():
        if entry.access != "wo":
            present = await sdo.read_async(entry, blocks=blocks)
            if entry.encode(value) != entry.encode(present):
                differing[place] = present
    return differing


def _is_pdo(index: int) -> bool:
    return communication.RPDO <= index <= communication.LAST_TPDO_MAPPING
