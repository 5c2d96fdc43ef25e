"""`tipforce sdo read|write|dump`: one object of a node, by number or name, or every object that can be read."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from canopen_device import types
from canopen_device.core import codes, communication
from canopen_device.types import Value
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Entry, gauges_of
from tipforce.dictionary.names import describe, entries, resolve
from tipforce.errors import InputError, NoResponseError, SdoAbortError, TipforceError
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.actions import add_choice

if TYPE_CHECKING:
    from canopen_device.eds.description import Description
    from tipforce.host.network.bus import Bus
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """examples (CiA 309-3 words, or names of the dictionary; docs/objects.md lists them):
      tipforce sdo read 10 0x1017 0 u16
      tipforce sdo read 10 P                    also calibration.generation, calibration.matrix:3, 0x2103:04
      tipforce sdo write 10 heartbeat.producer_ms 500
    types: u8 u16 u32 i8 i16 i32 r32 vs (string) d (domain, as hex bytes)
    """
    add_choice(parser, "action", ACTIONS)
    parser.add_argument("node", type=common.node_id, metavar="ID")
    parser.add_argument("words", nargs="*", metavar="OBJECT", help="NAME or INDEX SUB [TYPE]; write: then VALUE")
    parser.add_argument("--gauges", type=int, metavar="N", help="of the node (default: 3; dump: read from the node)")
    parser.add_argument("--eds", metavar="FILE", help="EDS, DCF or XDD of any node: names and types (default: 1021h)")
    bus_flags.add_bus_arguments(parser, sdo=True, confirm=True)


def run(args: argparse.Namespace) -> int:
    """Transfer one object or read all, and print what was read. Raises NoResponseError and SdoAbortError."""
    words = list(args.words)
    if args.action == "dump":
        if words:
            raise InputError(f"sdo dump: reads all objects; for one: tipforce sdo read {args.node} {' '.join(words)}")
        return _dump(args)
    if not words:
        raise InputError(f"sdo {args.action}: object missing; write NAME, or INDEX SUB [TYPE]; `sdo dump` reads all")
    value_text = words.pop() if args.action == "write" and len(words) > 1 else None
    if args.action == "write" and value_text is None:
        raise InputError("sdo write: expected NAME VALUE, or INDEX SUB TYPE VALUE")
    return _transfer(args, words, value_text)


@contextmanager
def connection_or(args: argparse.Namespace, error: InputError | None) -> Iterator[Bus]:
    """Open the connection. Where that fails, raise ``error`` if there is one: it does not depend on the bus."""
    with ExitStack() as opened:
        try:
            connection = opened.enter_context(bus_flags.open_connection(args))
        except TipforceError as reason:
            raise error or reason from None
        yield connection


def gauges_read(sdo: SdoChannel, error: InputError | None = None) -> int:
    """Return the gauges by the product code 1018h:2, 0 for another device. Raises ``error`` or NoResponseError."""
    try:
        return gauges_of(sdo.read(od.IDENTITY_PRODUCT))
    except SdoAbortError:  # CiA 301 requires the vendor alone
        return 0
    except NoResponseError as reason:
        raise error or reason from None


def description(eds: str | None, sdo: SdoChannel) -> Description | None:
    """Return what the file of --eds, or without one the EDS that the node stores, says; None without either. Its
    warnings are notes. Raises InputError for a file that is no EDS, NoResponseError."""
    from canopen_device.eds.reader import read_eds

    described = read_eds(eds, sdo.node_id) if eds else _stored(sdo)
    for warning in described.warnings if described is not None else ():
        common.note(f"warning: {warning}")
    return described


def _stored(sdo: SdoChannel) -> Description | None:
    """Return the EDS of 1021h; None where the node has none, or a compressed one (CiA 301, 7.5.2.21 and 7.5.2.22)."""
    from canopen_device.eds.reader import describe
    from canopen_device.eds.sections import parse

    with suppress(SdoAbortError):  # without 1022h the format is 0
        if any(sdo.upload(communication.EDS_FORMAT, 0)):
            return None
    with suppress(SdoAbortError, InputError):
        content = sdo.upload(EDS, 0, True)
        # The node does not choose files of this machine: its UploadFile is below no folder.
        return describe(parse(content, Path(os.devnull, "1021h")), sdo.node_id)
    return None


def _transfer(args: argparse.Namespace, words: list[str], value_text: str | None) -> int:
    entry = error = None
    try:
        entry = _known(words, args.node, args.gauges, args.eds)
    except InputError as reason:
        if args.eds or len(words) > 2:
            raise
        error = reason  # only an EDS that another device stores can know the object
    data = None if entry is None else _data(args, entry, value_text)
    with connection_or(args, error) as connection:
        sdo = connection.sdo(args.node)
        if entry is None:
            described = None if gauges_read(sdo, error) else description(args.eds, sdo)
            if described is None:
                assert error is not None
                raise error
            entry = _eds_entry(words, described)
            data = _data(args, entry, value_text)
        if data is not None:
            sdo.download(entry.index, entry.sub, data)
            common.note(f"{common.shown_node(args.node)} {entry} = {value_text}")
            return 0
        value = entry.decode(sdo.upload(entry.index, entry.sub, entry.type == "D"))
    text = types.format_value(entry.type, value)
    shown = text if isinstance(value, bytes) else value
    common.print_record({"node": args.node, **record_of(entry, shown)}, text)
    return 0


def _data(args: argparse.Namespace, entry: Entry[Value], value_text: str | None) -> bytes | None:
    if value_text is None:
        return None
    data = types.encode(entry.type, types.parse_value(entry.type, value_text))
    if entry.index in PERSISTENT:
        bus_flags.confirm(args, f"{common.shown_node(args.node)}: this {PERSISTENT[entry.index]}")
    return data


def _known(words: list[str], node_id: int, gauges: int | None, eds: str | None) -> Entry[Value]:
    if eds:
        from canopen_device.eds.reader import read_eds

        return _eds_entry(words, read_eds(eds, node_id))
    gauges = 3 if gauges is None else gauges
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


def _eds_entry(words: list[str], described: Description) -> Entry[Value]:
    if len(words) > 2:
        raise InputError(f"sdo: {' '.join(words)!r}: with --eds write NAME, or INDEX SUB; the type is in the file")
    entry = described.find(words[0] if len(words) == 1 else _index_sub(words, "0x6064"))
    return Entry(entry.index, entry.sub, entry.letter, entry.name, entry.access, entry.unit)


def _index_sub(words: list[str], example: str) -> tuple[int, int]:
    try:
        return int(words[0], 0), int(words[1], 0)
    except ValueError:
        raise InputError(f"sdo: {words[0]!r} {words[1]!r} is not INDEX SUB; write {example} 0, or one NAME") from None


def _dump(args: argparse.Namespace) -> int:
    with bus_flags.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        known = _entries(sdo, args.gauges, args.eds)
        readable = [entry for entry in known if entry.access != "wo" and entry.index != EDS]
        readings = []
        with common.progress("read", len(readable)) as advance:
            for entry in readable:
                value, text = _read(sdo, entry)
                advance()
                if not (isinstance(value, SdoAbortError) and value.code in _NOT_THERE):
                    label = entry.name if entry.stem else entry.title  # a sub-index 0 that holds a count has no name
                    readings.append((entry, label, value, text))
    width = max((len(label) for _, label, _, _ in readings), default=0)
    for entry, label, value, text in readings:
        extra, shown = {}, f"{text} {entry.unit}"
        if isinstance(value, SdoAbortError):
            extra, shown = {"abort": f"0x{value.code:08X}"}, f"({str(value).rpartition(': ')[2]})"
        elif entry.type == "I" and not entry.unit and isinstance(value, int) and value > _LAST_DIGIT:
            shown += f"(0x{value:X})"  # COB-IDs, mappings, signatures
        number = None if extra else text if isinstance(value, bytes) else value
        record = {"node": args.node, **record_of(entry, number), "unit": entry.unit, "access": entry.access, **extra}
        common.print_record(record, f"{entry}  {label:{width}}  {shown}".rstrip())
    missing = len(readable) - len(readings)
    absent = f", {missing} of the dictionary it does not have" if missing else ""
    common.note(
        f"{common.shown_node(args.node)}: {len(readings)} entries{absent}; left out: write-only entries, and the "
        f"EDS (0x{EDS:04X}: `tipforce sdo read {args.node} 0x{EDS:04X} 0`)"
    )
    return 0


def record_of(entry: Entry[Value], value: object) -> dict[str, object]:
    """Return the JSON record of a value of an entry."""
    return {"index": f"0x{entry.index:04X}", "sub": entry.sub, "name": entry.name, "value": value}


def _read(sdo: SdoChannel, entry: Entry[Value]) -> tuple[Value | SdoAbortError, str]:
    try:
        data = sdo.upload(entry.index, entry.sub, entry.type == "D")
    except SdoAbortError as error:
        return error, ""
    try:
        value = types.decode(entry.type, data)
        return value, types.format_value(entry.type, value)
    except InputError:  # another device's type for this object: show its bytes
        return data, data.hex(" ").upper()


def _entries(sdo: SdoChannel, gauges: int | None, eds: str | None) -> Iterable[Entry[Value]]:
    below, described = 0x10000, None
    if gauges is None and not eds:
        gauges = gauges_read(sdo) or None
    if eds or gauges is None:
        described = description(eds, sdo)
    if described is not None:
        known = []
        for each in described.entries():
            parent = described.objects[each.index]
            name = parent.name if set(parent.entries) == {0} else f"{parent.name}/{each.name}"
            known.append(Entry[Value](each.index, each.sub, each.letter, name, each.access, each.unit, name))
        return known
    if gauges is None:
        gauges, below = 3, _PROFILE_FREE
        common.note(
            f"{common.shown_node(sdo.node_id)} is not a fingertip: only the objects of CiA 301 are read "
            "(--gauges N: all objects of a fingertip)"
        )
    programs = False
    with suppress(SdoAbortError):
        programs = below > communication.PROGRAM_DATA and sdo.upload(communication.PROGRAM_DATA, 0) is not None
    return [entry for entry in entries(gauges, True, programs).values() if entry.index < below]
