"""`tipforce sdo read|write|dump`: one object of a node, by number or name, or every object that can be read."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from canopen_device.core import codes, communication
from tipforce.errors import InputError, SdoAbortError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice
from tipforce_tools.cli.request import request_of
from tipforce_tools.network.device import DeviceRequest, connection_or, description, is_fingertip

if TYPE_CHECKING:
    from canopen_device.eds.description import Description
    from canopen_device.types import Value
    from tipforce.dictionary.entries import Entry
    from tipforce.host.network.sdo import SdoChannel

ACTIONS = {"read": "print one object", "write": "change one object", "dump": "print all readable objects"}
PERSISTENT = {
    communication.STORE_PARAMETERS: "stores parameters",
    communication.RESTORE_DEFAULTS: "restores defaults at the next reset",
}
EDS = communication.STORED_EDS
_PROFILE_FREE = communication.FIRST_MANUFACTURER  # below it every CANopen device has the same objects (CiA 301)
_LAST_DIGIT = 9
_NOT_THERE = (codes.NO_OBJECT, codes.NO_SUB)  # SDO aborts: no such object, no such sub-index


@dataclass(frozen=True, kw_only=True)
class ObjectRequest(DeviceRequest):
    """``words``: NAME, or INDEX SUB [TYPE]; then the VALUE of a write. ``gauges``: None reads them from the node."""

    action: str
    words: list[str]
    gauges: int | None


class Reading(NamedTuple):
    """An entry of the dump: what the text calls it, its value and text, or the SDO abort of the node."""

    entry: Entry[Value]
    label: str
    value: Value | None
    text: str
    abort: SdoAbortError | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce sdo`."""
    parser.epilog = (
        "examples (CiA 309-3 words, or names of the dictionary; docs/objects.md lists them):\n"
        "  tipforce sdo read 10 0x1017 0 u16\n"
        "  tipforce sdo read 10 calibration.generation\n"
        "  tipforce sdo read 10 calibration.matrix:3\n"
        "  tipforce sdo write 10 0x1017 0 u16 500\n"
        "  tipforce sdo write 10 heartbeat.producer_ms 500\n"
        "  tipforce sdo dump 10                     all readable objects, with names and units\n"
        "types: u8 u16 u32 i8 i16 i32 r32 vs (string) d (domain, as hex bytes)"
    )
    add_choice(parser, "action", ACTIONS)
    parser.add_argument("node", type=common.node_id, metavar="ID")
    parser.add_argument("words", nargs="*", metavar="OBJECT", help="NAME or INDEX SUB [TYPE]; write: then VALUE")
    parser.add_argument("--gauges", type=int, metavar="N", help="of the node (default: 3; dump: read from the node)")
    parser.add_argument(
        "--eds", metavar="FILE", help="EDS, DCF or XDD of a node of any manufacturer: names and types (default: 1021h)"
    )
    common.add_confirm_argument(parser)
    common.add_sdo_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Transfer one object or read all, and print what was read. Raises NoResponseError and SdoAbortError."""
    request = request_of(ObjectRequest, args)
    words = list(request.words)
    if request.action == "dump":
        if words:
            raise InputError(
                f"sdo dump: reads all objects; for one: tipforce sdo read {request.node} {' '.join(words)}"
            )
        return _dump(request)
    if not words:
        raise InputError(f"sdo {request.action}: object missing; write NAME, or INDEX SUB [TYPE]; `sdo dump` reads all")
    value_text = words.pop() if request.action == "write" and len(words) > 1 else None
    if request.action == "write" and value_text is None:
        raise InputError("sdo write: expected NAME VALUE, or INDEX SUB TYPE VALUE")
    return _transfer(request, words, value_text)


# --- one object -----------------------------------------------------------------------------------------------------


def _transfer(request: ObjectRequest, words: list[str], value_text: str | None) -> int:
    from canopen_device import types

    entry, error = _known(words, request)
    data = None if entry is None else _data(request, entry, value_text)
    with connection_or(request, error) as connection:
        sdo = connection.sdo(request.node)
        if entry is None:  # only an EDS that another device stores can know the object
            described = None if is_fingertip(sdo, error) else description(request, sdo)
            if described is None:
                assert error is not None
                raise error
            entry = _eds_entry(words, described)
            data = _data(request, entry, value_text)
        if data is not None:
            sdo.download(entry.index, entry.sub, data)
            common.note(request, f"{request.shown} {entry} = {value_text}")
            return 0
        value = types.decode(entry.type, sdo.upload(entry.index, entry.sub, entry.type == "D"))
    text = types.format_value(entry.type, value)
    common.print_record(request, _record(request.node, entry, text if isinstance(value, bytes) else value), text)
    return 0


def _known(words: list[str], request: ObjectRequest) -> tuple[Entry[Value] | None, InputError | None]:
    """Return the object by --eds or the dictionary; or why not, for a node that stores its EDS."""
    if request.eds:
        from canopen_device.eds.reader import read_eds

        return _eds_entry(words, read_eds(request.eds, request.node)), None
    try:
        return _entry(words, 3 if request.gauges is None else request.gauges), None
    except InputError as error:
        if len(words) > 2:
            raise
        return None, error


def _data(request: ObjectRequest, entry: Entry[Value], value_text: str | None) -> bytes | None:
    """Return the bytes to write, None for a read; ask first where the write persists."""
    from canopen_device import types

    if value_text is None:
        return None
    data = types.encode(entry.type, types.parse_value(entry.type, value_text))
    if entry.index in PERSISTENT:
        common.confirm(request, f"{request.shown}: this {PERSISTENT[entry.index]}")
    return data


def _eds_entry(words: list[str], described: Description) -> Entry[Value]:
    """Return an object of an EDS: by its name, or INDEX [SUB]."""
    from tipforce.dictionary.entries import Entry

    if len(words) > 2:
        raise InputError(f"sdo: {' '.join(words)!r}: with --eds write NAME, or INDEX SUB; the type is in the file")
    entry = described.find(words[0] if len(words) == 1 else _index_sub(words, "0x6064"))
    return Entry(entry.index, entry.sub, entry.letter, entry.name, entry.access, entry.unit)


def _entry(words: list[str], gauges: int) -> Entry[Value]:
    """Return an object of a fingertip: NAME, or INDEX SUB [TYPE]."""
    from canopen_device import types
    from tipforce.dictionary.entries import Entry, describe, resolve

    if len(words) == 1:
        return resolve(words[0], gauges)
    if len(words) > 3:
        raise InputError(f"sdo: {' '.join(words)!r}: too many words; expected NAME, or INDEX SUB [TYPE]")
    index, sub = _index_sub(words, "0x1017")
    if not (0 <= index <= 0xFFFF and 0 <= sub <= 0xFF):
        raise InputError(f"sdo: index {words[0]} sub {words[1]}: allowed are 0 to 0xFFFF and 0 to 0xFF")
    known = describe(index, sub, gauges)
    if len(words) == 3:
        return Entry(index, sub, types.letter_of_word(words[2]), known.name if known else "", "", "")
    if known is None:
        raise InputError(f"sdo: 0x{index:04X}:{sub:02X} is not in the dictionary; add its type, for example u16")
    return known


def _index_sub(words: list[str], example: str) -> tuple[int, int]:
    try:
        return int(words[0], 0), int(words[1], 0)
    except ValueError:
        raise InputError(f"sdo: {words[0]!r} {words[1]!r} is not INDEX SUB; write {example} 0, or one NAME") from None


# --- all objects ----------------------------------------------------------------------------------------------------


def _dump(request: ObjectRequest) -> int:
    """Print the objects of the node; return 0. An entry that it refuses to read shows the abort, not a value."""
    with common.open_connection(request) as connection:
        sdo = connection.sdo(request.node)
        entries = _readable(request, sdo)
        readings = []
        with common.progress(request, "read", len(entries)) as advance:
            for entry, label in entries:
                reading = _read(sdo, entry, label)
                advance()
                if reading is not None:
                    readings.append(reading)
    width = max((len(reading.label) for reading in readings), default=0)
    for entry, label, value, text, abort in readings:
        record = _record(request.node, entry, text if isinstance(value, bytes) else value)
        record |= {"unit": entry.unit, "access": entry.access}
        record |= {} if abort is None else {"abort": f"0x{abort.code:08X}"}
        shown = f"{text} {entry.unit}" if abort is None else f"({str(abort).rpartition(': ')[2]})"
        if entry.type == "I" and not entry.unit and isinstance(value, int) and value > _LAST_DIGIT:
            shown += f"(0x{value:X})"  # COB-IDs, mappings, signatures
        common.print_record(request, record, f"{entry}  {label:{width}}  {shown}".rstrip())
    missing = len(entries) - len(readings)
    absent = f", {missing} of the dictionary it does not have" if missing else ""
    common.note(
        request,
        f"{request.shown}: {len(readings)} entries{absent}; left out: write-only entries, and the "
        f"EDS (0x{EDS:04X}: `tipforce sdo read {request.node} 0x{EDS:04X} 0`)",
    )
    return 0


def _record(node: int, entry: Entry[Value], value: object) -> dict[str, object]:
    return {"node": node, "index": f"0x{entry.index:04X}", "sub": entry.sub, "name": entry.name, "value": value}


def _readable(request: ObjectRequest, sdo: SdoChannel) -> list[tuple[Entry[Value], str]]:
    """Return the entries to read, each with its label: with --gauges those of such a fingertip, otherwise by identity.

    A label is the name that `sdo read` takes, or a description of a sub-index 0 that holds a count.
    """
    from tipforce.dictionary.entries import entries
    from tipforce.host.network.finger import FingertipClient

    gauges, below, described = request.gauges, 0x10000, None
    if request.eds:
        described = description(request, sdo)
    elif gauges is None:
        try:
            identity = FingertipClient(sdo).identity()
            gauges = identity.gauges if identity.is_fingertip else None
        except SdoAbortError:  # 1018h:2 to 4 are optional
            gauges = None
        described = description(request, sdo) if gauges is None else None
    if described is not None:
        return _described_entries(described)
    if gauges is None:
        gauges, below = 3, _PROFILE_FREE
        common.note(
            request,
            f"{request.shown} is not a fingertip: only the objects of CiA 301 are read "
            "(--gauges N: all objects of a fingertip)",
        )
    programs = False
    if below > communication.PROGRAM_DATA:
        with suppress(SdoAbortError):
            sdo.upload(communication.PROGRAM_DATA, 0)
            programs = True
    return [
        (entry, entry.name if entry.stem else entry.title)
        for entry in entries(gauges, True, programs).values()
        if entry.access != "wo" and entry.index < below and entry.index != EDS
    ]


def _described_entries(described: Description) -> list[tuple[Entry[Value], str]]:
    """Return the readable entries of the EDS, under its names."""
    from tipforce.dictionary.entries import Entry

    entries: list[tuple[Entry[Value], str]] = []
    for entry in described.entries():
        obj = described.objects[entry.index]
        name = obj.name if set(obj.entries) == {0} else f"{obj.name}/{entry.name}"
        if entry.access != "wo" and entry.index != EDS:
            entries.append((Entry(entry.index, entry.sub, entry.letter, name, entry.access, entry.unit), name))
    return entries


def _read(sdo: SdoChannel, entry: Entry[Value], label: str) -> Reading | None:
    """Read an entry; None for one that the node does not have."""
    from canopen_device import types

    try:
        data = sdo.upload(entry.index, entry.sub, entry.type == "D")
    except SdoAbortError as error:
        return None if error.code in _NOT_THERE else Reading(entry, label, None, "", error)
    try:
        value = types.decode(entry.type, data)
        return Reading(entry, label, value, types.format_value(entry.type, value), None)
    except InputError:  # another device's type for this object: show its bytes
        return Reading(entry, label, data, data.hex(" ").upper(), None)
