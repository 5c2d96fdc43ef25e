"""`tipforce export eds|dbc|dcf|xdd|ros2|c|mjcf`: files for other tools, C firmware and simulators."""

from __future__ import annotations

import argparse
import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canopen_device import types
from tipforce.dictionary import table, table_objects
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import objects
from tipforce.errors import InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.actions import add_choice

if TYPE_CHECKING:
    from tipforce.dictionary.eds import Values
    from tipforce.dictionary.table import Converter

FORMATS = {
    "eds": "objects of a node, for configuration tools",
    "dbc": "PDOs of the nodes, for log and bus tools",
    "dcf": "EDS with the settings of one node",
    "xdd": "objects of a node, or of --eds FILE, in XML (CiA 311)",
    "ros2": "bus configuration of ros2_canopen for a hand, and its EDS files, in one folder",
    "c": "C99 sources of the dictionary and the estimator, in one folder",
    "mjcf": "body of the fingertip for MuJoCo: outline, mass, tip site, beams as springs",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """examples: tipforce export dbc --nodes 1-5 -o hand.dbc; tipforce export c --gauges 4 -o firmware/;
    tipforce export ros2 --hand hand.toml -o bus/
    """
    add_choice(parser, "format", FORMATS)
    parser.add_argument("-o", "--output", metavar="PATH", help="default: stdout; c, ros2: a folder, required")
    what = "eds, dcf: REAL32 as decimals, or as hexadecimal bits for Lely's dcfgen (default %(default)s)"
    parser.add_argument("--dialect", choices=("decimal", "lely"), default="decimal", help=what)
    parser.add_argument("--eds", type=common.InputFile(), metavar="FILE", help="xdd: the EDS, DCF or XDD of any device")
    parser.add_argument("--hand", type=common.InputFile(), metavar="FILE", help="ros2: the hand in TOML, required")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="gauges, 3 to 8 (default %(default)s)")
    parser.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="dbc: 1,2,5-9 (default 1-15)")
    parser.add_argument("--node-id", type=common.node_id, metavar="ID", help="dcf: 1 to 127, required")
    what = "dcf: TOML or DCF with the settings that are not at their default, as for `config apply`"
    parser.add_argument("--settings", type=common.InputFile(), metavar="FILE", help=what)
    parser.add_argument("--bits", type=int, choices=(16, 24), default=16, help="converter resolution (default 16)")
    parser.add_argument("--simulated", action="store_true", help="eds, dcf, xdd: 2200h and 2201h of a simulated node")
    what = "eds, dcf, xdd: add 1F50h to 1F57h of firmware with program slots"
    parser.add_argument("--programs", action="store_true", help=what)
    parser.add_argument("--prefix", default="", metavar="TEXT", help="mjcf: in front of every name")
    parser.add_argument("--rigid", action="store_true", help="mjcf: no springs, the tip is fixed to the fixture")
    what = "mjcf: of the lowest mode (default 0.05)"
    parser.add_argument("--damping-ratio", type=float, default=0.05, metavar="RATIO", help=what)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write the file or files; return 0."""
    from tipforce.output_file import DBC, EDS, MJCF, XDD, new_file

    if args.programs and args.format not in ("eds", "dcf", "xdd"):
        others = "the exported C has no program slots, and other formats list no objects"
        raise InputError(f"export {args.format}: --programs is for eds, dcf and xdd; {others}")
    for name in ("programs", "simulated"):
        if getattr(args, name) and args.eds:
            raise InputError(f"--{name}: the objects are those of the file of --eds; leave one out")
    of = {"eds": "xdd", "settings": "dcf", "hand": "ros2", "node-id": "dcf, xdd", "simulated": "eds, dcf, xdd",
          "nodes": "dbc"}  # fmt: skip
    for name, only in of.items():
        if getattr(args, name.replace("-", "_")) and args.format not in only.split(", "):
            instead = "a DBC has --nodes" if (name, args.format) == ("node-id", "dbc") else "leave it out"
            raise InputError(f"export {args.format}: --{name} is for {only} alone; {instead}")
    converter = table.CONVERTER_24 if args.bits == 24 else table.CONVERTER_16
    if args.format in ("c", "ros2"):
        return _write_folder(args, converter)
    text = _text(args, converter)
    if not args.output or args.output == "-":
        print(text, end="")
        return 0
    kind = {"dbc": DBC, "xdd": XDD, "mjcf": MJCF}.get(args.format, EDS)
    inputs = [name for name in (args.settings, args.eds) if name]
    with new_file(args.output, kind, inputs) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
    common.note(f"{args.output}: {len(text.splitlines())} lines")
    return 0


def _text(args: argparse.Namespace, converter: Converter) -> str:
    if args.format == "mjcf":
        from tipforce_robots.mujoco.models import fingertip_mjcf

        return fingertip_mjcf(args.prefix, rigid=args.rigid, damping_ratio=args.damping_ratio)
    if not args.eds:
        objects(args.gauges)  # the error for a wrong number, before the PDOs of millions of gauges are made
    if args.format == "dbc":
        from tipforce.dictionary.dbc import dbc_text

        return dbc_text(args.nodes or range(1, 16), args.gauges)
    from tipforce.dictionary.eds import dcf_text, eds_text, lely_dialect

    if args.format == "xdd":
        return _xdd(args, converter)
    if args.format == "eds":
        text = eds_text(args.gauges, args.simulated, converter, args.programs)
    elif args.node_id is None:
        raise InputError("--node-id: a DCF belongs to one node; add it, for example --node-id 5")
    else:
        values: Values = {}  # without --settings the DCF has no ParameterValue: all defaults apply
        if args.settings:
            from tipforce.host.configuration.configuration_file import read_configuration

            wanted = read_configuration(args.settings, args.node_id, args.gauges)
            values = {place: value for place, (_entry, value) in wanted.items()}
        text = dcf_text(args.gauges, args.node_id, values, args.simulated, converter=converter, programs=args.programs)
    return lely_dialect(text) if args.dialect == "lely" else text


def _xdd(args: argparse.Namespace, converter: Converter) -> str:
    from canopen_device.eds.reader import describe, read
    from canopen_device.eds.sections import parse
    from canopen_device.eds.xdd import xdd_text
    from tipforce.dictionary.eds import eds_text, file_name

    if args.eds:
        file = read(args.eds)
    else:
        text = eds_text(args.gauges, args.simulated, converter, args.programs)
        file = parse(text.encode(), Path(file_name(args.gauges, args.simulated, bits=converter[0])))
    names_node = {"devicecomissioning", "devicecommissioning"} & file.sections.keys()
    described = describe(file, args.node_id or (None if names_node else 1))
    for warning in described.warnings:
        common.note(f"warning: {warning}")
    return xdd_text(described, "tipforce")


def _write_folder(args: argparse.Namespace, converter: Converter) -> int:
    if args.format == "ros2" and not args.hand:
        raise InputError("--hand: `export ros2` needs the hand; add its file, for example --hand hand.toml")
    if not args.output or args.output == "-":
        raise InputError(f"--output: `export {args.format}` writes several files; name a folder")
    if args.format == "ros2":
        from tipforce.host.hand.file import read_hand
        from tipforce_robots.ros2.bridge import write_ros2_bus

        paths = write_ros2_bus(read_hand(args.hand), Path(args.output))
    else:
        paths = write_c_files(Path(args.output), args.gauges, converter)
    for path in paths:
        common.note(str(path))
    return 0


ESTIMATOR = (
    "tipforce_estimator.h", "tipforce_status.c", "tipforce_float.c", "tipforce_fixed.c", "tipforce_fixed_setup.c",
    "tipforce_judge.h", "tipforce_judge.c",
)  # fmt: skip


def c_files(n: int = 3, converter: Converter = table.CONVERTER_16) -> dict[str, str]:
    """The text of each file by its name. Raises InputError for an ``n`` outside 3..8."""
    generated = {"tipforce_od.h": header_text(n, converter), "tipforce_od.c": table_text(n, converter)}
    return generated | {name: (Path(__file__).parent / name).read_text(encoding="ascii") for name in ESTIMATOR}


def write_c_files(folder: Path, n: int, converter: Converter = table.CONVERTER_16) -> list[Path]:
    """Write them into ``folder``, which is created if it is missing. Raises InputError, WriteError."""
    from tipforce.output_file import C_SOURCE, write_files

    return write_files(folder, {name: (text, C_SOURCE) for name, text in c_files(n, converter).items()})


_FLAGS = (
    ("TPDO", table.TPDO), ("RPDO", table.RPDO), ("ADD_NODE_ID", table.ADD_NODE_ID), ("STAGED", table.STAGED),
    ("VIEW", table.VIEW), ("NOT_STORED", table.NOT_STORED),
)  # fmt: skip
_ACCESS = {"ro": 1, "wo": 2, "rw": 3, "const": 5}
_EXPORTED = sum(bit for _, bit in _FLAGS)
LOW, HIGH = 64, 128  # the entry has that limit


def header_text(n: int, converter: Converter = table.CONVERTER_16) -> str:
    """tipforce_od.h: gauges, an index for each object by name, the form of an entry. Raises InputError for ``n``."""
    known = objects(n, False, converter)
    indices = "\n".join(
        f"#define TIPFORCE_OD_{re.sub('[^A-Za-z0-9]+', '_', each.stem).upper()}_{each.index:04X} "
        f"0x{each.index:04X}u /* {each.name} */"
        for each in known
    )
    # The fields of the calibration record lie one after the other, in the order of the table.
    record_bytes = struct.calcsize("<" + "".join(kind for _index, _sub, kind in table_objects.staged(n)))
    flags = "\n".join(f"    TIPFORCE_OD_{name} = {bit}," for name, bit in _FLAGS)
    return f"""\
/* Generated by `tipforce export c`: change the table of tipforce.dictionary, not this file. */
#ifndef TIPFORCE_OD_H
#define TIPFORCE_OD_H

#include <stdint.h>

#define TIPFORCE_GAUGES {n}
#define TIPFORCE_PRODUCT_CODE 0x{table.product_code(n, False, converter):08X}u
#define TIPFORCE_REVISION 0x{table.REVISION:08X}u
#define TIPFORCE_OD_COUNT {sum(len(each.entries) for each in known)}u
#define TIPFORCE_RECORD_BYTES {record_bytes}u /* of the calibration record 2140h */

/* Access: 1 read, 2 write, 3 both, 5 constant. */
enum {{
{flags}
    TIPFORCE_OD_LOW = {LOW}, /* the entry has a lower limit */
    TIPFORCE_OD_HIGH = {HIGH}
}};

typedef struct {{
    uint16_t index;
    uint8_t sub;
    uint8_t type;       /* CiA 301 data type: 2 to 8, 9 a string, 15 a DOMAIN */
    uint8_t access;
    uint8_t flags;      /* TIPFORCE_OD_... */
    uint32_t value;     /* default: the number's bytes on the wire, first byte lowest; a string's length */
    uint32_t low, high; /* in the same form */
    const char *text;   /* the default of a string, otherwise 0 */
}} tipforce_od_entry;

/* Ordered by index and sub-index. ADD_NODE_ID: the default is `value` plus the node-id. */
extern const tipforce_od_entry tipforce_od[TIPFORCE_OD_COUNT];

/* 0 where there is none. */
const tipforce_od_entry *tipforce_od_find(uint16_t index, uint8_t sub);

{indices}

#endif
"""


def table_text(n: int, converter: Converter = table.CONVERTER_16) -> str:
    """tipforce_od.c: the entries, and how one is found. Raises InputError for an ``n`` outside 3..8."""
    rows = "\n".join(_entry(entry) for each in objects(n, False, converter) for entry in each.entries)
    return f"""\
/* Generated by `tipforce export c`: change the table of tipforce.dictionary, not this file. */
#include "tipforce_od.h"

const tipforce_od_entry tipforce_od[TIPFORCE_OD_COUNT] = {{
{rows}
}};

const tipforce_od_entry *tipforce_od_find(uint16_t index, uint8_t sub)
{{
    uint32_t wanted = (uint32_t)index << 8 | sub, low = 0, high = TIPFORCE_OD_COUNT;
    while (low < high) {{
        uint32_t middle = (low + high) / 2;
        uint32_t key = (uint32_t)tipforce_od[middle].index << 8 | tipforce_od[middle].sub;
        if (key == wanted) {{
            return &tipforce_od[middle];
        }}
        if (key < wanted) {{
            low = middle + 1;
        }} else {{
            high = middle;
        }}
    }}
    return 0;
}}
"""


def wire_word(letter: str, value: types.Value) -> int:
    """A number's bytes on the wire as an unsigned word."""
    return int.from_bytes(types.encode(letter, value), "little")


def row_words(entry: Entry[Any]) -> tuple[int, int, int, int]:
    """(flags, default, low, high) of an entry, as the C table has them."""
    flags = entry.flags & _EXPORTED | (LOW if entry.low is not None else 0) | (HIGH if entry.high is not None else 0)
    if entry.type in "sD":
        return flags, len(str(entry.default)) if entry.type == "s" else 0, 0, 0
    low, high = (0 if limit is None else wire_word(entry.type, limit) for limit in (entry.low, entry.high))
    return flags, wire_word(entry.type, entry.default), low, high


def _entry(entry: Entry[Any]) -> str:
    flags, value, low, high = row_words(entry)
    kind = types.data_type(entry.type).code
    text = '"' + str(entry.default).replace("\\", "\\\\").replace('"', '\\"') + '"' if entry.type == "s" else "0"
    place = f"0x{entry.index:04X}u, {entry.sub}u, {kind}u, {_ACCESS[entry.access]}u, {flags}u"
    name = entry.title.replace("*/", "")
    return f"    {{{place}, 0x{value:X}u, 0x{low:X}u, 0x{high:X}u, {text}}}, /* {name} */"
