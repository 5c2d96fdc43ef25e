"""NMT commands whose effect is awaited: each node's heartbeat says what it became (CiA 301, 7.3.2.2)."""

from __future__ import annotations

import time
from collections.abc import Collection

from tipforce.device.codes import INITIALISING, OPERATIONAL, PRE_OPERATIONAL, STOPPED
from tipforce.dictionary.dbc import NMT_STATES
from tipforce.errors import NoResponseError
from tipforce.host.network.connection import Connection

_REACHED = {
    "start": (OPERATIONAL,),
    "stop": (STOPPED,),
    "preop": (PRE_OPERATIONAL,),
    # A reset ends with the boot-up message.
    "reset-node": (INITIALISING,),
    "reset-comm": (INITIALISING,),
}


class NotReachedError(NoResponseError):
    """Some nodes did not say that they reached the state; ``reached`` has what the others said, by node-id."""

    def __init__(self, message: str, reached: dict[int, str]) -> None:
        super().__init__(message)
        self.reached = reached


def command_and_wait(
    connection: Connection, command: str, node_ids: Collection[int], timeout_s: float = 2.0
) -> dict[int, str]:
    """Send an NMT command to each node and wait until its heartbeat says so; the state that each reported.

    Raises InputError for an unknown command, and NotReachedError naming the nodes that did not say so in time: they
    are off, or their heartbeat (1017h) is slower or 0.
    """
    since_s = time.monotonic()
    for node_id in sorted(node_ids):
        connection.nmt(command, node_id)
    wanted, found, missing = _REACHED[command], dict[int, str](), list[str]()
    for node_id in sorted(node_ids):
        left_s = max(0.0, since_s + timeout_s - time.monotonic())
        if connection.heartbeats.wait(node_id, wanted, since_s, left_s):
            found[node_id] = NMT_STATES[wanted[0]]
        else:
            state = connection.heartbeats.state(node_id)
            said = "silent" if state is None else f"last said {NMT_STATES.get(state, f'state {state}')}"
            missing.append(f"{node_id} ({said})")
    if missing:
        raise NotReachedError(
            f"nmt {command}: no heartbeat that says so within {timeout_s:g} s from node {', '.join(missing)}; "
            "is its heartbeat (1017h) on and faster than this?",
            found,
        )
    return found
