"""Apply a configuration file (TOML or DCF) to a node in the order that CiA 301 requires, then compare."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import msgspec

from tipforce.device import codes, communication
from tipforce.dictionary import names, table, types
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.signals import is_mapping
from tipforce.dictionary.types import Value
from tipforce.errors import InputError, NoResponseError, SdoAbortError
from tipforce.host.network.sdo import Read, SdoChannel, Steps, Write
from tipforce.toml_table import convert, read_table

Configuration = dict[tuple[int, int], tuple[Entry[Value], Value]]
"""By (index, sub), in index order: the entry and its required value."""

NODE_ID_MARK = "$NODEID"
"""In a value: the node-id to which the file is applied, as in a DCF (CiA 306): "$NODEID+0x40000180"."""

_NUMBER = r"(0[xX][0-9a-fA-F]+|\d+)"
_FOLLOWS_NODE_ID = re.compile(rf"(?i:\$NODEID)(?:\s*\+\s*{_NUMBER})?|{_NUMBER}\s*\+\s*(?i:\$NODEID)")


class _File(msgspec.Struct, forbid_unknown_fields=True):
    objects: dict[str, int | float | str | list[int | float | str]]


def read_configuration(path: str | Path, node_id: int, gauges: int = 3) -> Configuration:
    """Return the content of a file: a DCF by its extension, otherwise TOML with a table [objects].

    Raises InputError naming the file, the object, the value and what is allowed.
    """
    found = (
        _read_dcf(path, node_id, gauges)
        if str(path).lower().endswith((".dcf", ".eds"))
        else _read_toml(path, node_id, gauges)
    )
    for entry, value in found.values():
        if entry.access not in ("rw", "wo"):
            raise InputError(f"{path}: {entry.name} ({entry}) is {entry.access} and cannot be configured")
        try:
            entry.encode(value)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        of_tpdo = communication.TPDO <= entry.index <= communication.LAST_TPDO
        if of_tpdo and entry.sub == 1 and not int(value) & codes.NO_RTR:
            raise InputError(
                f"{path}: {entry.name} ({entry}) is 0x{int(value):X}: TPDOs do not support RTR, so bit 30 must be "
                f"set: 0x{int(value) | codes.NO_RTR:X}"
            )
    if not found:
        raise InputError(f"{path}: no object is set")
    return dict(sorted(found.items()))


def _read_toml(path: str | Path, node_id: int, gauges: int) -> Configuration:
    content = convert(_File, read_table(path, str(path)), str(path))
    found: Configuration = {}
    for name, value in content.objects.items():
        try:
            for entry, single in _single_values(name, _numbered(value, node_id), gauges):
                found[entry.index, entry.sub] = entry, single
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return found


def _numbered(value: object, node_id: int) -> object:
    """Return a value that depends on the node-id, for this node-id."""
    if not isinstance(value, str) or NODE_ID_MARK not in value.upper():
        return value
    match = _FOLLOWS_NODE_ID.fullmatch(value.strip())
    if match is None:
        raise InputError(f"{value!r}: write {NODE_ID_MARK}+0x180 or 0x180+{NODE_ID_MARK}")
    return int(match[1] or match[2] or "0", 0) + node_id


def _single_values(name: str, value: object, gauges: int) -> list[tuple[Entry[Value], Value]]:
    """Return a value, or a list for an array from sub-index 1; a list for a PDO mapping also sets its length."""
    if not isinstance(value, list):
        entry = names.resolve(name, gauges)
        return [(entry, _typed(entry, value))]
    first = names.resolve(f"{name}:1", gauges)
    # By number from here on: after a dotted name a sub-index is decimal, after an index hexadecimal.
    entries = [names.resolve(f"0x{first.index:04X}:{k + 1:02X}", gauges) for k in range(len(value))]
    if not is_mapping(first.index):
        return [(entry, _typed(entry, item)) for entry, item in zip(entries, value, strict=True)]
    words = [_mapped(item, gauges) if isinstance(item, str) else item for item in value]
    return [(names.resolve(f"0x{first.index:04X}:00", gauges), len(words)), *zip(entries, words, strict=True)]


def _typed(entry: Entry[Value], value: object) -> Value:
    """Convert text to a type that TOML lacks: hex bytes, "nan", "0x0A"."""
    kind = types.data_type(entry.type).python
    if isinstance(value, str) and kind is not str:
        try:
            return types.parse_value(entry.type, value)
        except InputError as error:
            raise InputError(f"{entry.name} ({entry}): {error}") from None
    return value  # type: ignore[return-value]  # entry.encode checks its type


def _mapped(name: str, gauges: int) -> int:
    """Return the mapping word of an object: index, sub-index, length in bits (CiA 301, 7.5.2.36)."""
    entry = names.resolve(name, gauges)
    return entry.index << 16 | entry.sub << 8 | 8 * (types.data_type(entry.type).size or 0)


def _read_dcf(path: str | Path, node_id: int, gauges: int) -> Configuration:
    """Return the entries of a DCF that have a ParameterValue."""
    import canopen

    try:
        dictionary = canopen.import_od(str(path), node_id)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except Exception as error:
        raise InputError(f"{path}: not a DCF ({type(error).__name__}: {error})") from None
    found: Configuration = {}
    for obj in dictionary.values():
        variables = [obj] if isinstance(obj, canopen.objectdictionary.ODVariable) else list(obj.values())
        for variable in variables:
            value = getattr(variable, "value", None)
            if value is not None and getattr(variable, "value_raw", None) is not None:
                try:
                    entry = names.resolve(f"0x{variable.index:04X}:{variable.subindex:02X}", gauges)
                except InputError as error:
                    raise InputError(f"{path}: {error}") from None
                if entry.access in ("rw", "wo"):
                    found[entry.index, entry.sub] = entry, value
    return found


def apply_configuration(sdo: SdoChannel, wanted: Configuration) -> None:
    """Write every object; PDO parameters by the procedure of 7.5.2.36. Raises NoResponseError and SdoAbortError.

    If the node rejects one, the previous values are restored as far as the node accepts them.
    """
    sdo.run(_apply(wanted))


async def apply_configuration_async(sdo: SdoChannel, wanted: Configuration) -> None:
    """Apply for asyncio: several nodes are configured at once. Raises as ``apply_configuration``."""
    await sdo.run_async(_apply(wanted))


def _apply(wanted: Configuration) -> Steps[None]:
    before = yield from _present(wanted)
    try:
        yield from _write(wanted)
    except SdoAbortError:
        with contextlib.suppress(SdoAbortError, NoResponseError):
            yield from _write(before)
        raise


def _present(wanted: Configuration) -> Steps[Configuration]:
    """Return the node's present values of the objects that ``wanted`` changes; of a PDO its whole mapping."""
    entries = {key: entry for key, (entry, _) in wanted.items() if entry.access != "wo"}
    for pdo in _pdos(wanted):
        cob_id, count = _pdo_entries(pdo)
        entries[cob_id.index, cob_id.sub] = cob_id
        if any(index == count.index for index, _ in wanted):
            entries[count.index, 0] = count
            for sub in range(1, int((yield Read(count))) + 1):
                slot = names.resolve(f"0x{count.index:04X}:{sub:02X}", table.MAX_GAUGES)
                entries[slot.index, slot.sub] = slot
    present: Configuration = {}
    for key, entry in sorted(entries.items()):
        present[key] = entry, (yield Read(entry))
    return present


def _write(values: Configuration) -> Steps[None]:
    for pdo in _pdos(values):
        yield from _apply_pdo(pdo, values)
    for (index, _), (entry, value) in values.items():
        if not _is_pdo(index):
            yield Write(entry, value)


def _pdos(values: Configuration) -> list[int]:
    """Return the communication parameter index of each PDO that is changed."""
    return sorted({index & ~communication.MAPPING for index, _ in values if _is_pdo(index)})


def _pdo_entries(parameters: int) -> tuple[Entry[Value], Entry[Value]]:
    """Return COB-ID and mapping count, in the largest dictionary: TPDO5 and TPDO6 need more than three gauges."""
    cob_id = names.resolve(f"0x{parameters:04X}:01", table.MAX_GAUGES)
    return cob_id, names.resolve(f"0x{parameters + communication.MAPPING:04X}:00", table.MAX_GAUGES)


def _apply_pdo(parameters: int, wanted: Configuration) -> Steps[None]:
    mapping = parameters + communication.MAPPING
    cob_id, count = _pdo_entries(parameters)
    final = wanted[parameters, 1][1] if (parameters, 1) in wanted else (yield Read(cob_id))
    assert isinstance(final, int)
    yield Write(cob_id, final | codes.COB_ID_INVALID)
    if any(index == mapping for index, _ in wanted):
        length = wanted[mapping, 0][1] if (mapping, 0) in wanted else (yield Read(count))
        yield Write(count, 0)
        for (index, sub), (entry, value) in wanted.items():
            if index == mapping and sub:
                yield Write(entry, value)
        yield Write(count, length)
    for (index, sub), (entry, value) in wanted.items():
        if index == parameters and sub != 1:
            yield Write(entry, value)
    yield Write(cob_id, final)


def apply_differences(sdo: SdoChannel, wanted: Configuration) -> Configuration:
    """Apply only what differs on the node, a PDO mapping as a whole; return what was written. Raises as the above."""
    differing = sdo.run(_differing(wanted))
    mappings = {index for index, _ in differing if is_mapping(index)}
    written = {
        key: one
        for key, one in wanted.items()
        if key in differing or key[0] in mappings or one[0].access == "wo"
    }  # fmt: skip
    if written:
        apply_configuration(sdo, written)
    return written


def verify_configuration(sdo: SdoChannel, wanted: Configuration) -> list[dict[str, object]]:
    """Return the differences: object, expected, found; write-only objects cannot be compared and are excluded."""
    return sdo.run(_verify(wanted))


async def verify_configuration_async(sdo: SdoChannel, wanted: Configuration) -> list[dict[str, object]]:
    """Verify for asyncio."""
    return await sdo.run_async(_verify(wanted))


def _verify(wanted: Configuration) -> Steps[list[dict[str, object]]]:
    differences: list[dict[str, object]] = []
    for key, found in (yield from _differing(wanted)).items():
        entry, value = wanted[key]
        shown, expected = types.format_value(entry.type, found), types.format_value(entry.type, value)
        differences.append({"object": f"{entry.name} ({entry})", "expected": expected, "found": shown})
    return differences


def _differing(wanted: Configuration) -> Steps[dict[tuple[int, int], Value]]:
    """Return the node's values of the objects that differ."""
    found: dict[tuple[int, int], Value] = {}
    for key, (entry, value) in wanted.items():
        if entry.access != "wo":
            present = yield Read(entry)
            if entry.encode(value) != entry.encode(present):
                found[key] = present
    return found


def _is_pdo(index: int) -> bool:
    return communication.RPDO <= index <= communication.LAST_TPDO_MAPPING
