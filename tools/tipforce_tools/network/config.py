"""`tipforce config show|apply|diff|save|verify`: write, save and compare node settings as TOML or DCF."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tipforce.errors import InputError, SdoAbortError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice
from tipforce_tools.cli.eds_flag import description

if TYPE_CHECKING:
    from tipforce.dictionary.rows import Row
    from tipforce.dictionary.types import Value
    from tipforce.eds.description import Description
    from tipforce.host.configuration.configuration_file import Configuration
    from tipforce.host.network.sdo import SdoChannel

ACTIONS = {
    "show": "print the settings of a node that differ from their default (--all: every setting)",
    "apply": "write a file to the node and read it back; if the node refuses a setting, restore the previous ones",
    "diff": "print all differences, also settings changed in the node that are not in the file",
    "save": "save the settings of the node to a file: TOML, or DCF by its suffix",
    "verify": "compare the settings in the file with the node (exit code 1 on a difference)",
}
WITH_FILE = ("apply", "diff", "save", "verify")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce config`."""
    parser.epilog = (
        "A TOML file has a table [objects] of names (docs/objects.md) or indices, and values:\n"
        "  [objects]\n"
        '  "heartbeat.producer_ms" = 500\n'
        '  "0x6114:01" = 1000\n'
        '  "tpdo1.mapping" = ["process_value_int16:7", "status", "counter"]\n'
        '  "tpdo3.cob_id" = "$NODEID+0x40000380"\n'
        "PDOs are changed by the procedure of CiA 301: made invalid, remapped, made valid again.\n"
        "The calibration is not included: see `tipforce calibrate apply`.\n\n"
        "  tipforce config save 5 finger.toml -i socketcan -c can0\n"
        "  tipforce config apply 6 finger.toml -i socketcan -c can0 --store"
    )
    add_choice(parser, "action", ACTIONS)
    parser.add_argument("node", type=common.node_id, metavar="ID")
    parser.add_argument("file", nargs="?", metavar="FILE", help="*.dcf, or TOML; save: - is stdout")
    parser.add_argument("--store", action="store_true", help="apply: store all parameters on the node afterwards")
    parser.add_argument("--all", action="store_true", help="show, save: include settings at their default")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="of the node (default 3)")
    parser.add_argument("--eds", metavar="FILE", help="show: EDS or DCF of a node of any manufacturer (default: 1021h)")
    common.add_confirm_argument(parser)
    common.add_sdo_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the action; return 0, or for apply, verify and diff 1 after a line per difference."""
    common.set_up_logging(args)
    if (args.file is None) is (args.action in WITH_FILE):
        needs = "which FILE? For example" if args.file is None else "takes no FILE; did you mean"
        raise InputError(f"config {args.action}: {needs}: tipforce config save {args.node} finger.toml")
    if args.action == "show":
        return _show(args)
    if args.eds:
        raise InputError(f"config {args.action}: --eds is for show")
    return _save(args) if args.action == "save" else _with_file(args)


def _with_file(args: argparse.Namespace) -> int:
    from tipforce.host.configuration.configuration_file import (
        apply_configuration,
        read_configuration,
        verify_configuration,
    )
    from tipforce.host.network.finger import FingertipClient

    wanted = read_configuration(args.file, args.node, args.gauges)
    if args.action == "apply" and args.store:
        common.confirm(args, f"node {common.shown_id(args.node)}: this replaces its stored parameters")
    with common.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        if args.action == "diff":
            return _diff(args, sdo, wanted)
        if args.action == "apply":
            apply_configuration(sdo, wanted)
        differences = verify_configuration(sdo, wanted)
        if args.action == "apply" and args.store and not differences:
            FingertipClient(sdo).store()
    for difference in differences:
        if args.json:
            common.print_json(difference)
        else:
            print(f"{difference['object']}: expected {difference['expected']}, the node has {difference['found']}")
    common.note(args, f"node {common.shown_id(args.node)}: {len(wanted)} objects, {len(differences)} different")
    return 1 if differences else 0


def _diff(args: argparse.Namespace, sdo: SdoChannel, wanted: Configuration) -> int:
    from dataclasses import asdict

    from tipforce.host.configuration.settings import compare

    differences = compare(_read(args, sdo), wanted, args.node, args.gauges)
    for found in differences:
        if args.json:
            common.print_json(asdict(found))
        else:
            there = "is not in the file" if found.other is None else f"{args.file} has {found.other}"
            print(f"{found.name} ({found.entry}): the node has {found.node}, {there}")
    common.note(args, f"node {common.shown_id(args.node)}: {len(differences)} different")
    return 1 if differences else 0


def _show(args: argparse.Namespace) -> int:
    from tipforce.host.configuration.settings import changed_settings, default_settings, setting_rows

    with common.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        if args.eds or not _is_fingertip(sdo):
            described = description(args, sdo)
            return _show_foreign(args, sdo) if described is None else _show_described(args, sdo, described)
        settings = _read(args, sdo)
    known, defaults = setting_rows(args.gauges), default_settings(args.node, args.gauges)
    shown = settings if args.all else changed_settings(settings, args.node, args.gauges)
    for place, value in sorted(shown.items()):
        row, texts = known[place], [_shown(known[place], v) for v in (value, defaults[place])]
        if args.json:
            common.print_json(
                {"index": f"0x{row.index:04X}", "sub": row.sub, "name": row.dotted, "value": value,
                 "default": defaults[place], "unit": row.unit}
            )  # fmt: skip
        else:
            default = "" if texts[0] == texts[1] else f"   (default {texts[1]})"
            shown_value = f"{texts[0]} {row.unit}".rstrip()
            print(f"0x{row.index:04X}:{row.sub:02X}  {row.dotted:32} {shown_value}{default}")
    common.note(args, f"node {common.shown_id(args.node)}: {len(settings)} settings, {len(shown)} shown")
    return 0


def _is_fingertip(sdo: SdoChannel) -> bool:
    from tipforce.dictionary import objects as od
    from tipforce.dictionary.rows import gauges_of

    try:
        return gauges_of(sdo.read(od.IDENTITY_PRODUCT)) > 0
    except SdoAbortError:  # CiA 301 requires the vendor alone
        return False


def _show_described(args: argparse.Namespace, sdo: SdoChannel, described: Description) -> int:
    """Print the writable objects that differ from the DefaultValue of the EDS (--all: each), under its names."""
    from tipforce.device import communication
    from tipforce.dictionary import types

    read = shown = 0
    actions = (communication.ERROR_HISTORY, communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS)
    for entry in described.entries():
        if not entry.access.startswith("rw") or entry.index in actions:
            continue
        try:
            value = types.decode(entry.letter, sdo.upload(entry.index, entry.sub, entry.letter == "D"))
        except (SdoAbortError, InputError):  # the node lacks the object, or has one of another length
            continue
        read += 1
        if not args.all and value == entry.default:
            continue
        shown += 1
        texts = [data.hex(" ").upper() if isinstance(data, bytes) else data for data in (value, entry.default)]
        name = described.objects[entry.index].name
        name = name if set(described.objects[entry.index].entries) == {0} else f"{name}/{entry.name}"
        if args.json:
            common.print_json(
                {"index": f"0x{entry.index:04X}", "sub": entry.sub, "name": name, "value": texts[0],
                 "default": texts[1], "unit": entry.unit}
            )  # fmt: skip
        else:
            default = "" if value == entry.default else f"   (default {texts[1]})"
            print(f"{entry.place}  {name:32} {f'{texts[0]} {entry.unit}'.rstrip()}{default}")
    common.note(args, f"node {common.shown_id(args.node)}: {read} settings of its EDS, {shown} shown")
    return 0


def _show_foreign(args: argparse.Namespace, sdo: SdoChannel) -> int:
    """Print the objects of CiA 301 that a device of another type has; only its manufacturer knows their defaults."""
    from tipforce.device import communication
    from tipforce.dictionary import types
    from tipforce.host.configuration.settings import setting_rows

    shown = 0
    for (index, sub), row in setting_rows().items():
        if index > communication.LAST:
            continue
        try:
            value = types.decode(row.letter, sdo.upload(index, sub))
        except (SdoAbortError, InputError):  # it lacks the object, or has one of another length
            continue
        shown += 1
        if args.json:
            common.print_json({"index": f"0x{index:04X}", "sub": sub, "name": row.dotted, "value": value})
        else:
            print(f"0x{index:04X}:{sub:02X}  {row.dotted:32} {_shown(row, value)} {row.unit}".rstrip())
    node = f"node {common.shown_id(args.node)} is not a fingertip"
    common.note(args, f"{node}: {shown} communication settings (CiA 301), compared with nothing")
    return 0


def _shown(row: Row, value: Value) -> str:
    """Return a value as text; COB-IDs and mapped objects in hexadecimal with the meaning of their parts."""
    from tipforce.dictionary import types
    from tipforce.dictionary.signals import is_mapping

    if row.slug.endswith("cob_id") and isinstance(value, int):
        return cob_id_text(row.index, value)
    if is_mapping(row.index) and row.sub and isinstance(value, int) and value:
        return f"0x{value:08X} (0x{value >> 16:04X}:{value >> 8 & 0xFF:02X}, {value & 0xFF} bits)"
    return types.format_value(row.letter, value)


def cob_id_text(index: int, value: int) -> str:
    """Return a COB-ID parameter in hexadecimal: its bits by name, and the identifier (CiA 301, 7.5.2)."""
    from tipforce.device import codes, communication

    high = {
        communication.COB_ID_SYNC: ("", "produced"),
        communication.COB_ID_TIME: ("consumed", "produced"),
    }.get(index, ("off", "no RTR"))
    bits = (codes.COB_ID_INVALID, high[0]), (codes.NO_RTR, high[1]), (1 << 29, "29 bits")
    names = [name for bit, name in bits if value & bit and name]
    return f"0x{value:08X} ({', '.join([f'0x{value & codes.STANDARD_MASK:03X}', *names])})"


def _save(args: argparse.Namespace) -> int:
    from tipforce.host.configuration.settings import changed_settings, settings_dcf, settings_toml
    from tipforce.host.network.finger import FingertipClient
    from tipforce.output_file import EDS, SETTINGS, check_output, write_file

    as_dcf = str(args.file).lower().endswith((".dcf", ".eds"))
    kind = EDS if as_dcf else SETTINGS
    if args.file != "-":
        check_output(args.file, kind)
    with common.open_connection(args) as connection:
        sdo = connection.sdo(args.node)
        simulated = FingertipClient(sdo).identity().simulated
        settings = _read(args, sdo)
    chosen = settings if args.all else changed_settings(settings, args.node, args.gauges)
    if as_dcf:
        text = settings_dcf(chosen, args.node, args.gauges, simulated)
    else:
        text = settings_toml(chosen, args.node, args.gauges)
    if args.file == "-":
        print(text, end="")
        return 0
    write_file(args.file, text, kind)
    common.note(args, f"{args.file}: {len(chosen)} of {len(settings)} settings of node {common.shown_id(args.node)}")
    return 0


def _read(args: argparse.Namespace, sdo: SdoChannel) -> dict[tuple[int, int], Value]:
    """Read all settings, one transfer each, with a progress bar on a terminal."""
    from tipforce.host.configuration.settings import read_settings, setting_rows

    with common.progress(args, "read", len(setting_rows(args.gauges))) as advance:
        return read_settings(sdo, args.gauges, advance)
