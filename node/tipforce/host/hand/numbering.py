"""Decide whether the SYNC of a hand carries numbers: 1019h of its fingers."""

from __future__ import annotations

import time

from tipforce.device.codes import SYNC_COB_ID
from tipforce.dictionary import objects
from tipforce.errors import TipforceError
from tipforce.host.hand.bring_up import responding_nodes
from tipforce.host.hand.file import HandFile
from tipforce.host.hand.link import Link
from tipforce.host.hand.sync_numbers import LARGEST

_LISTEN_S = 0.5  # for the SYNC of another device


def wanted_overflow(link: Link, file: HandFile, nodes: set[int] | None) -> int | None:
    """Return 1019h for the fingers: LARGEST to number, 0 not to; None where no SYNC of another device is received.

    ``nodes``: node-ids of all nodes on the bus; None: they are searched.
    """
    plan = file.hand
    if not plan.sync_hz:
        return _of_other_producer(link)
    if plan.numbered_sync != "auto":
        return LARGEST if plan.numbered_sync else 0
    others = (responding_nodes(link.connection) if nodes is None else nodes) - set(file.node_ids)
    return LARGEST if all(_takes_numbers(link, node_id) for node_id in others) else 0


def _takes_numbers(link: Link, node_id: int) -> bool:
    try:
        return link.connection.sdo(node_id).read(objects.SYNC_COUNTER_OVERFLOW) > 1
    except TipforceError:
        return False


def _of_other_producer(link: Link) -> int | None:
    deadline_s = time.monotonic() + _LISTEN_S
    while (left_s := deadline_s - time.monotonic()) > 0:
        frames = link.receive(left_s)
        lengths = frames["length"][frames["can_id"] == SYNC_COB_ID]
        if len(lengths):
            return LARGEST if lengths[-1] == 1 else 0
    return None
