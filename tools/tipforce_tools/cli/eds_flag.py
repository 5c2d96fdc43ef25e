"""`--eds ID=FILE`: the EDS or DCF of a node, of any manufacturer."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.device import communication
from tipforce.errors import InputError, NoResponseError, SdoAbortError, TipforceError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.eds.description import Description
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.sdo import SdoChannel


def add_eds_argument(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the flag."""
    parser.add_argument(
        "--eds", action="append", metavar="ID=FILE", help="EDS, DCF or XDD of a node of any manufacturer; repeatable"
    )


def eds_files(given: Sequence[str]) -> tuple[tuple[int, str], ...]:
    """Return (node-id, file) of each flag, after reading the files once: their warnings go to stderr.

    Raises InputError for another form, a repeated node-id, and a file that is no EDS.
    """
    from tipforce.eds.reader import read_eds

    found: list[tuple[int, str]] = []
    for text in given:
        head, equal, path = text.partition("=")
        try:
            node_id = common.node_id(head)
        except (argparse.ArgumentTypeError, ValueError):
            node_id = 0
        if not equal or not path or not node_id:
            raise InputError(f"--eds {text}: the form is ID=FILE, such as 5=drive.eds")
        if node_id in dict(found):
            raise InputError(f"--eds {text}: node {node_id} has a file already")
        for warning in read_eds(path, node_id).warnings:
            print(f"warning: {warning}", file=sys.stderr)
        found.append((node_id, path))
    return tuple(found)


def description(args: argparse.Namespace, sdo: SdoChannel) -> Description | None:
    """Return what ``--eds FILE``, or without it the EDS that the node stores, says; None without either.

    Its warnings are notes. Raises InputError for a file that is no EDS, NoResponseError.
    """
    from tipforce.eds.reader import read_eds

    found = read_eds(args.eds, args.node) if args.eds else _stored(sdo)
    for warning in found.warnings if found is not None else ():
        common.note(args, f"warning: {warning}")
    return found


def is_fingertip(sdo: SdoChannel, error: InputError | None = None) -> bool:
    """Return whether 1018h:2 is a product code of tipforce. Raises ``error``, or NoResponseError: no response."""
    from tipforce.dictionary import objects as od
    from tipforce.dictionary.rows import gauges_of

    try:
        return gauges_of(sdo.read(od.IDENTITY_PRODUCT)) > 0
    except SdoAbortError:  # CiA 301 requires the vendor alone
        return False
    except NoResponseError:
        if error is not None:
            raise error from None
        raise


@contextmanager
def connection_or(args: argparse.Namespace, error: InputError | None) -> Iterator[Bus]:
    """Open the connection. Where that fails, raise ``error`` if there is one: it does not depend on the bus."""
    with ExitStack() as opened:
        try:
            connection = opened.enter_context(common.open_connection(args))
        except TipforceError:
            if error is not None:
                raise error from None
            raise
        yield connection


def _stored(sdo: SdoChannel) -> Description | None:
    """Return the EDS of 1021h; None where the node has none, or a compressed one (CiA 301, 7.5.2.21 and 7.5.2.22)."""
    from tipforce.eds.reader import describe
    from tipforce.eds.sections import decoded, parse

    with suppress(SdoAbortError):  # without 1022h the format is 0
        if any(sdo.upload(communication.EDS_FORMAT, 0)):
            return None
    try:
        content = sdo.upload(communication.STORED_EDS, 0, True)
    except SdoAbortError:
        return None
    text, findings = decoded(content)
    try:  # the node does not choose files of this machine: its UploadFile is below no folder
        file = parse(text)
        file.findings[:0] = findings
        return describe(file, Path(os.devnull, "1021h"), content, sdo.node_id)
    except InputError:
        return None
