"""`tipforce config show|apply|diff|save|verify`: write, save and compare node settings as TOML or DCF."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from canopen_device import types
from canopen_device.core import codes, communication
from canopen_device.types import Value
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry
from tipforce.errors import InputError, SdoAbortError
from tipforce.host.configuration.device_objects import DeviceObjects, EdsObjects, FingertipObjects
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.actions import add_choice
from tipforce_tools.network.sdo import connection_or, description, gauges_read, record_of

if TYPE_CHECKING:
    from tipforce.host.configuration.configuration_file import Configuration
    from tipforce.host.network.finger import Finger
    from tipforce.host.network.sdo import SdoChannel

ACTIONS = {
    "show": "print the settings of a node that differ from their default (--all: every setting)",
    "apply": "write a file to the node and read it back; if the node refuses a setting, restore the previous ones",
    "diff": "print all differences, also settings changed in the node that are not in the file",
    "save": "save the settings of the node to a file: TOML, or DCF by its suffix",
    "verify": "compare the settings in the file with the node (exit code 1 on a difference)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A TOML file has a table [objects] of names (docs/objects.md) or indices, and values:
      [objects]
      "heartbeat.producer_ms" = 500
      "0x6114:01" = 1000
      "tpdo1.mapping" = ["process_value_int16:7", "status", "counter"]
      "tpdo3.cob_id" = "$NODEID+0x40000380"
    The calibration is not included: see `tipforce calibrate apply`.
      tipforce config apply 6 finger.toml -i socketcan -c can0 --store
      tipforce config save 7 drive.dcf --eds drive.eds -i socketcan -c can0
    """
    add_choice(parser, "action", ACTIONS)
    parser.add_argument("node", type=common.node_id, metavar="ID")
    parser.add_argument("file", nargs="?", default="", metavar="FILE", help="*.dcf, or TOML; save: - is stdout")
    parser.add_argument("--store", action="store_true", help="apply: store all parameters on the node afterwards")
    parser.add_argument("--all", action="store_true", help="show, save: include settings at their default")
    parser.add_argument("--gauges", type=int, metavar="N", help="of the node (default: read from the node)")
    parser.add_argument("--eds", metavar="FILE", help="EDS, DCF or XDD of a node of any manufacturer (default: 1021h)")
    bus_flags.add_bus_arguments(parser, sdo=True, confirm=True)


def run(args: argparse.Namespace) -> int:
    """Run the action; return 0, or for apply, verify and diff 1 after a line per difference."""
    if bool(args.file) is (args.action == "show"):
        needs = "takes no FILE; did you mean" if args.file else "which FILE? For example"
        raise InputError(f"config {args.action}: {needs}: tipforce config save {args.node} finger.toml")
    if args.action not in ("show", "save"):
        common.InputFile().check(args.file)
    actions = {"show": _show, "save": _save, "diff": _diff}
    return actions.get(args.action, _apply_or_verify)(args)


@contextmanager
def _opened(args: argparse.Namespace) -> Iterator[tuple[Finger, DeviceObjects, Configuration]]:
    from tipforce.host.configuration.configuration_file import read_configuration

    error = None
    try:
        read_configuration(args.file, args.node, args.gauges or table.MIN_GAUGES)
    except InputError as reason:
        error = reason  # it may be a file of another device
    if args.action == "apply" and args.store:
        bus_flags.confirm(args, f"{common.shown_node(args.node)}: this replaces its stored parameters")
    with connection_or(args, error) as connection:
        finger = connection.finger(args.node)
        objects = _objects(finger.sdo, args.gauges, args.eds, error)
        yield finger, objects, read_configuration(args.file, args.node, objects=objects, note=common.note)


def _diff(args: argparse.Namespace) -> int:
    from tipforce.host.configuration.configuration_file import compare

    with _opened(args) as (finger, objects, wanted):
        lines = compare(_read(finger.sdo, objects), wanted, objects)
    for line in lines:
        there = "is not in the file" if line["other"] is None else f"{args.file} has {line['other']}"
        common.print_record(line, f"{line['name']} ({line['entry']}): the node has {line['node']}, {there}")
    common.note(f"{common.shown_node(args.node)}: {len(lines)} different")
    return 1 if lines else 0


def _apply_or_verify(args: argparse.Namespace) -> int:
    from tipforce.host.configuration.configuration_file import apply_configuration, verify_configuration

    with _opened(args) as (finger, _, wanted):
        if args.action == "apply":
            apply_configuration(finger.sdo, wanted)
        differences = verify_configuration(finger.sdo, wanted)
        if args.action == "apply" and args.store and not differences:
            finger.store()
    for difference in differences:
        text = "{object}: expected {expected}, the node has {found}".format(**difference)
        common.print_record(difference, text)
    unread = sum(entry.access == "wo" for entry, _ in wanted.values())
    shown = f"{len(differences)} different" + (f", {unread} write-only, not compared" if unread else "")
    common.note(f"{common.shown_node(args.node)}: {len(wanted)} objects, {shown}")
    return 1 if differences else 0


def _objects(sdo: SdoChannel, gauges: int | None, eds: str | None, error: InputError | None = None) -> DeviceObjects:
    if not eds and (own := gauges_read(sdo, error)):
        if gauges not in (None, own):
            raise InputError(f"--gauges {gauges}: {common.shown_node(sdo.node_id)} has {own}")
        return FingertipObjects(sdo.node_id, own)
    described = description(eds, sdo)
    if described is None:
        raise InputError(f"{common.shown_node(sdo.node_id)} is not a fingertip and stores no EDS; add --eds FILE")
    return EdsObjects(described)


def _show(args: argparse.Namespace) -> int:
    from tipforce.host.configuration.configuration_file import changed_settings

    with bus_flags.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        try:
            objects = _objects(sdo, args.gauges, args.eds)
        except InputError:
            if args.eds or args.gauges:
                raise
            return _show_foreign(sdo)
        settings = _read(sdo, objects)
    shown = settings if args.all else changed_settings(settings, objects)
    for place, value in sorted(shown.items()):
        entry = objects.settings[place]
        text, usual = (_shown(entry, number) for number in (value, entry.default))
        values = (text, usual) if isinstance(value, bytes) else (value, entry.default)
        line = _line(entry, value) + ("" if text == usual else f"   (default {usual})")
        common.print_record(record_of(entry, values[0]) | {"default": values[1], "unit": entry.unit}, line)
    common.note(f"{common.shown_node(args.node)}: {len(settings)} settings, {len(shown)} shown")
    return 0


def _show_foreign(sdo: SdoChannel) -> int:
    """Print the objects of CiA 301 that a device of another type has; only its manufacturer knows their defaults."""
    shown = 0
    for (index, sub), entry in FingertipObjects(sdo.node_id).settings.items():
        if index <= communication.LAST:
            with suppress(SdoAbortError, InputError):  # it lacks the object, or has one of another length
                value = entry.decode(sdo.upload(index, sub))
                shown += 1
                common.print_record(record_of(entry, value), _line(entry, value))
    communication_settings = f"{shown} communication settings (CiA 301), compared with nothing"
    common.note(f"{common.shown_node(sdo.node_id)} is not a fingertip: {communication_settings}")
    return 0


def _line(entry: Entry[Value], value: Value) -> str:
    return f"{entry}  {entry.name:32} {f'{_shown(entry, value)} {entry.unit}'.rstrip()}"


def _shown(entry: Entry[Value], value: Value) -> str:
    if entry.stem.endswith("cob_id") and isinstance(value, int):  # CiA 301, 7.5.2: bits by name, and the identifier
        meanings = {communication.COB_ID_SYNC: ("", "produced"), communication.COB_ID_TIME: ("consumed", "produced")}
        high = meanings.get(entry.index, ("off", "no RTR"))
        bits = (codes.COB_ID_INVALID, high[0]), (codes.NO_RTR, high[1]), (1 << 29, "29 bits")
        names = [name for bit, name in bits if value & bit and name]
        return f"0x{value:08X} ({', '.join([f'0x{value & codes.STANDARD_MASK:03X}', *names])})"
    if communication.is_mapping(entry.index) and entry.sub and isinstance(value, int) and value:
        return f"0x{value:08X} (0x{value >> 16:04X}:{value >> 8 & 0xFF:02X}, {value & 0xFF} bits)"
    try:
        return types.format_value(entry.type, value)
    except InputError:  # text outside ASCII, a default outside its type
        return str(value)


def _save(args: argparse.Namespace) -> int:
    from canopen_device.eds import dcf
    from tipforce.dictionary import eds as fingertip_eds
    from tipforce.host.configuration.configuration_file import changed_settings, settings_toml
    from tipforce.output_file import EDS, SETTINGS, check_output, write_file

    as_dcf = args.file.lower().endswith((".dcf", ".eds"))
    if args.file.lower().endswith((".xdc", ".xdd")):
        raise InputError(f"config save {args.file}: allowed are TOML, and a DCF by the suffix .dcf")
    kind = EDS if as_dcf else SETTINGS
    if args.file != "-":
        check_output(args.file, kind)
    with bus_flags.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        objects = _objects(sdo, args.gauges, args.eds)
        settings = _read(sdo, objects)
        chosen = settings if args.all else changed_settings(settings, objects)
        if not as_dcf:
            text = settings_toml(chosen, objects, args.node)
        elif isinstance(objects, EdsObjects):
            had = {place for place in settings if objects.described.find(place).value is not None}  # of --eds FILE.dcf
            chosen = {place: value for place, value in settings.items() if place in chosen or place in had}
            _note_lost(args.file, chosen, objects)
            text = dcf.dcf_text(objects.described, chosen)
        else:
            simulated = connection.finger(args.node).identity().simulated
            text = fingertip_eds.dcf_text(objects.gauges, args.node, chosen, simulated)
    if args.file == "-":
        print(text, end="")
        return 0
    write_file(args.file, text, kind)
    common.note(f"{args.file}: {len(chosen)} of {len(settings)} settings of {common.shown_node(args.node)}")
    return 0


def _note_lost(file: str, chosen: Mapping[tuple[int, int], Value], objects: EdsObjects) -> None:
    for place, value in chosen.items():
        entry, kept = objects.settings[place], value.strip() if isinstance(value, str) else value
        if (kept != value or value in ("", b"")) and value != entry.default:
            common.note(f"{file}: a DCF cannot hold {entry} = {value!r}, empty or with outer blanks; TOML can")


def _read(sdo: SdoChannel, objects: DeviceObjects) -> dict[tuple[int, int], Value]:
    from tipforce.host.configuration.configuration_file import read_settings

    with common.progress("read", len(objects.settings)) as advance:
        return read_settings(sdo, objects, advance)
