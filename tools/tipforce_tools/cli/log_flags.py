"""Flags that choose rows and columns of logs; files of nodes and of scenes."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tipforce.errors import InputError
from tipforce_tools.cli import common


def add_eds_argument(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the flag."""
    parser.add_argument("--eds", action="append", metavar="ID=FILE", help="EDS, DCF or XDD of a node; repeatable")


def add_choice_arguments(parser: argparse.ArgumentParser, signals: str) -> None:
    """Add the flags that choose rows and columns of logs, and the PDOs; ``signals`` is the help of --signals."""
    group = parser.add_argument_group("choice")
    group.add_argument("--signals", metavar="NAMES", help=signals)
    group.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="as 1,2,5-9")
    group.add_argument("--bus", metavar="NAMES", help="only of these interfaces: can0,can1")
    group.add_argument("--from", dest="start", metavar="TIME", help="seconds from the start or of the epoch, ISO time")
    group.add_argument("--to", dest="end", metavar="TIME", help="end, exclusive; same formats")
    calibration = "compute contact from the gauges; repeatable"
    group.add_argument("--calibration", action="append", metavar="[ID=]CAL.toml", help=calibration)
    group.add_argument("--gauges", type=int, choices=range(3, 9), metavar="N", help="3 (default) to 8")
    group.add_argument("--dcf", action="append", metavar="FILE", help="configuration of a node; repeatable")
    group.add_argument("--dbc", metavar="FILE", help="a DBC instead; tipforce: the shipped one")
    add_eds_argument(group)


def eds_files(given: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """Return (node-id, file) of each flag, after reading the files once: their warnings go to stderr. Raises InputError
    for another form, a repeated node-id, and a file that is no EDS."""
    from canopen_device.eds.reader import read_eds

    files: dict[int, str] = {}
    for text in given:
        head, _, path = text.partition("=")
        node = common.number(head, common.any_base)
        if not (path and 1 <= node <= 127):
            raise InputError(f"--eds {text}: the form is ID=FILE, such as 5=drive.eds")
        if node in files:
            raise InputError(f"--eds {text}: node {node} has a file already")
        for warning in read_eds(path, node).warnings:
            print(f"warning: {warning}", file=sys.stderr)
        files[node] = path
    return tuple(files.items())


def scene_or_file(text: str) -> Path:
    """Return the file, or the shipped scene of that name. Raises InputError if there is neither."""
    from tipforce.shipped_files import file_or_shipped

    path = file_or_shipped(text, "scenes")
    common.InputFile().check(str(path))
    return path
