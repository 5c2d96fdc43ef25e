"""`--eds ID=FILE`: the EDS or DCF of a node, of any manufacturer."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from tipforce.errors import InputError
from tipforce_tools.cli import common


def add_eds_argument(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the flag."""
    parser.add_argument(
        "--eds", action="append", metavar="ID=FILE", help="EDS, DCF or XDD of a node of any manufacturer; repeatable"
    )


def eds_files(given: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """Return (node-id, file) of each flag, after reading the files once: their warnings go to stderr.

    Raises InputError for another form, a repeated node-id, and a file that is no EDS.
    """
    from canopen_device.eds.reader import read_eds

    files: dict[int, str] = {}
    for text in given:
        head, equal, path = text.partition("=")
        try:
            node_id = common.node_id(head)
        except (argparse.ArgumentTypeError, ValueError):
            node_id = 0
        if not equal or not path or not node_id:
            raise InputError(f"--eds {text}: the form is ID=FILE, such as 5=drive.eds")
        if node_id in files:
            raise InputError(f"--eds {text}: node {node_id} has a file already")
        for warning in read_eds(path, node_id).warnings:
            print(f"warning: {warning}", file=sys.stderr)
        files[node_id] = path
    return tuple(files.items())
