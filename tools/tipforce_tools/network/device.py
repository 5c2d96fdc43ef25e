"""The device that `tipforce sdo` and `tipforce config` name: its connection, and its dictionary by identity or EDS."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from canopen_device.core import communication
from tipforce.errors import InputError, NoResponseError, SdoAbortError, TipforceError
from tipforce_tools.cli import common
from tipforce_tools.cli.request import SdoRequest

if TYPE_CHECKING:
    from canopen_device.eds.description import Description
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.sdo import SdoChannel


@dataclass(frozen=True, kw_only=True)
class DeviceRequest(SdoRequest):
    """One node, and the file that describes it if it is no fingertip."""

    node: int
    eds: str | None
    yes: bool

    @property
    def shown(self) -> str:
        """The node in a message: `node 10 (0x0A)`."""
        return f"node {common.shown_id(self.node)}"


def description(request: DeviceRequest, sdo: SdoChannel) -> Description | None:
    """Return what ``--eds FILE``, or without it the EDS that the node stores, says; None without either.

    Its warnings are notes. Raises InputError for a file that is no EDS, NoResponseError.
    """
    from canopen_device.eds.reader import read_eds

    described = read_eds(request.eds, request.node) if request.eds else _stored(sdo)
    for warning in described.warnings if described is not None else ():
        common.note(request, f"warning: {warning}")
    return described


def is_fingertip(sdo: SdoChannel, error: InputError | None = None) -> bool:
    """Return whether 1018h:2 is a product code of tipforce. Raises ``error``, or NoResponseError: no response."""
    from tipforce.dictionary import objects as od
    from tipforce.dictionary.entries import gauges_of

    try:
        return gauges_of(sdo.read(od.IDENTITY_PRODUCT)) > 0
    except SdoAbortError:  # CiA 301 requires the vendor alone
        return False
    except NoResponseError:
        if error is not None:
            raise error from None
        raise


@contextmanager
def connection_or(request: DeviceRequest, error: InputError | None) -> Iterator[Bus]:
    """Open the connection. Where that fails, raise ``error`` if there is one: it does not depend on the bus."""
    with ExitStack() as opened:
        try:
            connection = opened.enter_context(common.open_connection(request))
        except TipforceError:
            if error is not None:
                raise error from None
            raise
        yield connection


def _stored(sdo: SdoChannel) -> Description | None:
    """Return the EDS of 1021h; None where the node has none, or a compressed one (CiA 301, 7.5.2.21 and 7.5.2.22)."""
    from canopen_device.eds.reader import describe
    from canopen_device.eds.sections import decoded, parse

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
