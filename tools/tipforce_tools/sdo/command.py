"""`tipforce sdo read|write|dump`: one object of a node, by number or name, or all objects."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tipforce.device import communication
from tipforce.errors import InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice
from tipforce_tools.cli.eds_flag import connection_or, description, is_fingertip

if TYPE_CHECKING:
    from tipforce.eds.description import Description
    from tipforce.host.network.sdo import SdoChannel

ACTIONS = {"read": "print one object", "write": "change one object", "dump": "print all readable objects"}
PERSISTENT = {
    communication.STORE_PARAMETERS: "stores parameters",
    communication.RESTORE_DEFAULTS: "restores defaults at the next reset",
}


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
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Read or write, and print a value that was read. Raises NoResponseError and SdoAbortError."""
    from tipforce.dictionary import types

    if args.action == "dump":
        return _dump(args)
    words = list(args.words)
    if not words:
        raise InputError(f"sdo {args.action}: object missing; write NAME, or INDEX SUB [TYPE]; `sdo dump` reads all")
    value_text = words.pop() if args.action == "write" and len(words) > 1 else None
    if args.action == "write" and value_text is None:
        raise InputError("sdo write: expected NAME VALUE, or INDEX SUB TYPE VALUE")
    found, error = _known(words, args)
    common.set_up_logging(args)
    data = None if found is None else _data(args, found, value_text)
    with connection_or(args, error) as connection:
        sdo = connection.sdo(args.node)
        if found is None:
            found = _stored_entry(words, args, sdo, error)
            data = _data(args, found, value_text)
        index, sub, letter, name = found
        if data is not None:
            sdo.download(index, sub, data)
            common.note(args, f"node {common.shown_id(args.node)} 0x{index:04X}:{sub:02X} = {value_text}")
            return 0
        value = types.decode(letter, sdo.upload(index, sub, letter == "D"))
    text = types.format_value(letter, value)
    if args.json:
        shown = text if isinstance(value, bytes) else value
        common.print_json({"node": args.node, "index": f"0x{index:04X}", "sub": sub, "name": name, "value": shown})
    else:
        print(text)
    return 0


_Known = tuple[int, int, str, str]


def _known(words: list[str], args: argparse.Namespace) -> tuple[_Known | None, InputError | None]:
    """Return (index, sub, type letter, name) by --eds or the dictionary; or why not, for a node that stores its EDS."""
    if args.eds:
        from tipforce.eds.reader import read_eds

        return _eds_entry(words, read_eds(args.eds, args.node)), None
    try:
        return _entry(words, 3 if args.gauges is None else args.gauges), None
    except InputError as error:
        if len(words) > 2:
            raise
        return None, error


def _stored_entry(words: list[str], args: argparse.Namespace, sdo: SdoChannel, error: InputError | None) -> _Known:
    """Return the object by the EDS that another device stores. Raises ``error`` if it stores none."""
    found = None if is_fingertip(sdo, error) else description(args, sdo)
    if found is None:
        assert error is not None
        raise error
    return _eds_entry(words, found)


def _data(args: argparse.Namespace, found: _Known, value_text: str | None) -> bytes | None:
    """Return the bytes to write, None for a read; ask first where the write persists."""
    from tipforce.dictionary import types

    if value_text is None:
        return None
    data = types.encode(found[2], types.parse_value(found[2], value_text))
    if found[0] in PERSISTENT:
        common.confirm(args, f"node {common.shown_id(args.node)}: this {PERSISTENT[found[0]]}")
    return data


def _eds_entry(words: list[str], found: Description) -> _Known:
    """Return an object of an EDS: by its name, or INDEX [SUB]."""
    if len(words) > 2:
        raise InputError(f"sdo: {' '.join(words)!r}: with --eds write NAME, or INDEX SUB; the type is in the file")
    try:
        key: str | tuple[int, int] = words[0] if len(words) == 1 else (int(words[0], 0), int(words[1], 0))
    except ValueError:
        raise InputError(f"sdo: {words[0]!r} {words[1]!r} is not INDEX SUB; write 0x6064 0, or one NAME") from None
    entry = found.find(key)
    return entry.index, entry.sub, entry.letter, entry.name


def _dump(args: argparse.Namespace) -> int:
    from tipforce_tools.sdo.dump import dump

    if args.words:
        raise InputError(f"sdo dump: reads all objects; for one: tipforce sdo read {args.node} {' '.join(args.words)}")
    common.set_up_logging(args)
    return dump(args)


def _entry(words: list[str], gauges: int) -> tuple[int, int, str, str]:
    """Return (index, sub, type letter, dotted name or "") of NAME, or of INDEX SUB [TYPE]."""
    from tipforce.dictionary import names, types

    if len(words) == 1:
        entry = names.resolve(words[0], gauges)
        return entry.index, entry.sub, entry.type, entry.name
    if len(words) > 3:
        raise InputError(f"sdo: {' '.join(words)!r}: too many words; expected NAME, or INDEX SUB [TYPE]")
    try:
        index, sub = int(words[0], 0), int(words[1], 0)
    except ValueError:
        raise InputError(f"sdo: {words[0]!r} {words[1]!r} is not INDEX SUB; write 0x1017 0, or one NAME") from None
    if not (0 <= index <= 0xFFFF and 0 <= sub <= 0xFF):
        raise InputError(f"sdo: index {words[0]} sub {words[1]}: allowed are 0 to 0xFFFF and 0 to 0xFF")
    known = names.describe(index, sub, gauges)
    if len(words) == 3:
        return index, sub, types.letter_of_word(words[2]), known.dotted if known else ""
    if known is None:
        raise InputError(f"sdo: 0x{index:04X}:{sub:02X} is not in the dictionary; add its type, for example u16")
    return index, sub, known.letter, known.dotted
