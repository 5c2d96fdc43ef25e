"""`tipforce export eds|dbc`: files for other tools, from the one table of objects."""

from __future__ import annotations

import argparse
from pathlib import Path

from tipforce.errors import InputError
from tipforce_tools import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `tipforce export`."""
    parser.epilog = "example: tipforce export dbc --nodes 1-5 -o hand.dbc"
    parser.add_argument("format", choices=("eds", "dbc"))
    parser.add_argument("-o", "--output", metavar="FILE", help="default: stdout")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="3 to 8 (default %(default)s)")
    parser.add_argument(
        "--nodes", type=common.node_ids, default=list(range(1, 16)), metavar="IDS", help="dbc: 1,2,5-9 (default 1-15)"
    )
    parser.add_argument("--bits", type=int, choices=(16, 24), default=16, help="eds: of the converter (default 16)")
    parser.add_argument("--simulated", action="store_true", help="eds: of a simulated node, with 2200h and 2201h")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write the file; 0."""
    if args.format == "eds":
        from tipforce.dictionary import table
        from tipforce.dictionary.eds import eds_text

        converter = table.CONVERTER_24 if args.bits == 24 else table.CONVERTER_16
        text = eds_text(args.gauges, args.simulated, converter)
    else:
        from tipforce.dictionary.dbc import dbc_text

        text = dbc_text(args.nodes, args.gauges)
    if not args.output or args.output == "-":
        print(text, end="")
        return 0
    try:
        Path(args.output).write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(f"--output {args.output}: {error.strerror}") from None
    common.note(args, f"{args.output}: {len(text.splitlines())} lines")
    return 0
