"""`tipforce sdo dump`: every readable object of a node, with its name, value and unit."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from tipforce.device import codes, communication
from tipforce.errors import InputError, SdoAbortError
from tipforce_tools.cli import common
from tipforce_tools.cli.eds_flag import description

if TYPE_CHECKING:
    from tipforce.dictionary.rows import Row
    from tipforce.dictionary.types import Value
    from tipforce.eds.description import Description
    from tipforce.host.network.sdo import SdoChannel

EDS = communication.STORED_EDS
_PROFILE_FREE = communication.FIRST_MANUFACTURER  # below it every CANopen device has the same objects (CiA 301)
_LAST_DIGIT = 9
_NOT_THERE = (codes.NO_OBJECT, codes.NO_SUB)  # SDO aborts: no such object, no such sub-index


class Found(NamedTuple):
    """One entry: its value and text, or the SDO abort of the node."""

    row: Row
    value: Value | None
    text: str
    abort: SdoAbortError | None


def dump(args: argparse.Namespace) -> int:
    """Print the objects of the node; return 0. An entry that it refuses to read shows the abort instead of its value.

    Raises NoResponseError.
    """
    missing = 0
    with common.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        rows = _readable(args, sdo)
        shown = []
        with common.progress(args, "read", len(rows)) as advance:
            for found in _read(sdo, rows):
                advance()
                if found is None:
                    missing += 1
                else:
                    shown.append(found)
    width = max((len(_name(found.row)) for found in shown), default=0)
    for found in shown:
        _print(args, found, width)
    absent = f", {missing} of the dictionary it does not have" if missing else ""
    common.note(
        args,
        f"node {common.shown_id(args.node)}: {len(shown)} entries{absent}; left out: write-only entries, and the "
        f"EDS (0x{EDS:04X}: `tipforce sdo read {args.node} 0x{EDS:04X} 0`)",
    )
    return 0


def _readable(args: argparse.Namespace, sdo: SdoChannel) -> list[Row]:
    """Return the entries to read: with --gauges those of such a fingertip, otherwise by the node's identity."""
    from tipforce.dictionary.rows import rows
    from tipforce.host.network.finger import FingertipClient

    given = description(args, sdo) if args.eds else None
    if given is not None:
        return _rows_of(given)
    gauges, below = args.gauges, 0x10000
    if gauges is None:
        try:
            identity = FingertipClient(sdo).identity()
            gauges = identity.gauges if identity.is_fingertip else None
        except SdoAbortError:  # 1018h:2 to 4 are optional
            gauges = None
        stored = description(args, sdo) if gauges is None else None
        if stored is not None:
            return _rows_of(stored)
        if gauges is None:
            gauges, below = 3, _PROFILE_FREE
            common.note(
                args,
                f"node {common.shown_id(args.node)} is not a fingertip: only the objects of CiA 301 are read "
                "(--gauges N: all objects of a fingertip)",
            )
    programs = below > communication.PROGRAM_DATA and _has(sdo, communication.PROGRAM_DATA)
    found = rows(gauges, True, programs).values()
    return [row for row in found if row.access != "wo" and row.index < below and row.index != EDS]


def _has(sdo: SdoChannel, index: int) -> bool:
    try:
        sdo.upload(index, 0)
    except SdoAbortError:
        return False
    return True


def _rows_of(found: Description) -> list[Row]:
    """Return the readable entries of the EDS, under its names."""
    from tipforce.dictionary.rows import Row

    rows = []
    for entry in found.entries():
        one = found.objects[entry.index]
        name = one.name if set(one.entries) == {0} else f"{one.name}/{entry.name}"
        if entry.access != "wo" and entry.index != EDS:
            rows.append(
                Row(
                    entry.index, entry.sub, name, name, False, entry.letter, entry.access, 0, 0, entry.low,
                    entry.high, entry.unit,
                )
            )  # fmt: skip
    return rows


def _read(sdo: SdoChannel, rows: list[Row]) -> Iterator[Found | None]:
    """Read each entry; None for one that the node does not have."""
    from tipforce.dictionary import types

    for row in rows:
        try:
            data = sdo.upload(row.index, row.sub, row.letter == "D")
        except SdoAbortError as error:
            yield None if error.code in _NOT_THERE else Found(row, None, "", error)
            continue
        try:
            value = types.decode(row.letter, data)
            yield Found(row, value, types.format_value(row.letter, value), None)
        except InputError:  # another device's type for this object: show its bytes
            yield Found(row, data, data.hex(" ").upper(), None)


def _print(args: argparse.Namespace, found: Found, width: int) -> None:
    row, abort = found.row, found.abort
    if args.json:
        record: dict[str, object] = {"node": args.node, "index": f"0x{row.index:04X}", "sub": row.sub}
        value = found.text if isinstance(found.value, bytes) else found.value
        record |= {"name": row.dotted, "value": value, "unit": row.unit, "access": row.access}
        common.print_json(record if abort is None else record | {"abort": f"0x{abort.code:08X}"})
        return
    told = f"{found.text} {row.unit}" if abort is None else f"({str(abort).rpartition(': ')[2]})"
    if row.letter == "I" and not row.unit and isinstance(found.value, int) and found.value > _LAST_DIGIT:
        told += f"(0x{found.value:X})"  # COB-IDs, mappings, signatures
    print(f"0x{row.index:04X}:{row.sub:02X}  {_name(row):{width}}  {told}".rstrip())


def _name(row: Row) -> str:
    """Return the name that `sdo read` takes, or a description of a sub-index 0 that holds a count."""
    return row.dotted if row.slug else row.name
