"""Send NMT commands and wait for their effect in the heartbeats (CiA 301, 7.3.2.2)."""

from __future__ import annotations

import time
from collections.abc import Collection

from tipforce.device.codes import INITIALISING, OPERATIONAL, PRE_OPERATIONAL, STOPPED
from tipforce.dictionary.dbc import NMT_STATES
from tipforce.errors import NoResponseError
from tipforce.host.network.bus import Bus

_REACHED = {
    "start": (OPERATIONAL,),
    "stop": (STOPPED,),
    "preop": (PRE_OPERATIONAL,),
    # A reset ends with the boot-up message.
    "reset-node": (INITIALISING,),
    "reset-comm": (INITIALISING,),
}


_AGAIN_S = 0.5


class NotReachedError(NoResponseError):
    """Some nodes did not report the state; ``reached`` has the states of the others, by node-id."""

    def __init__(self, message: str, reached: dict[int, str]) -> None:
        super().__init__(message)
        self.reached = reached


def command_and_wait(
    connection: Bus, command: str, node_ids: Collection[int], timeout_s: float = 2.0
) -> dict[int, str]:
    """Send an NMT command to each node and wait for its heartbeat; return the state that each reported.

    NMT is not confirmed: a command other than a reset is repeated until the heartbeat reports the state, so a node may
    boot meanwhile. Raises InputError for an unknown command, and NotReachedError naming the nodes whose heartbeat did
    not report it in time: they are off, or their heartbeat (1017h) is slower or 0.
    """
    since_s = time.monotonic()
    wanted, found = _REACHED[command], dict[int, str]()
    again_s = timeout_s if command.startswith("reset") else _AGAIN_S
    waiting = sorted(node_ids)
    while waiting:
        now_s = time.monotonic()
        if now_s >= since_s + timeout_s:
            break
        for node_id in waiting:
            connection.nmt(command, node_id)
        until_s = min(now_s + again_s, since_s + timeout_s)
        for node_id in waiting:
            if connection.heartbeats.wait(node_id, wanted, since_s, max(0.0, until_s - time.monotonic())):
                found[node_id] = NMT_STATES[wanted[0]]
        waiting = [node_id for node_id in waiting if node_id not in found]
    missing = [f"{node_id} ({_last(connection, node_id)})" for node_id in waiting]
    if missing:
        raise NotReachedError(
            f"nmt {command}: no heartbeat with the new state within {timeout_s:g} s from node {', '.join(missing)}; "
            "check that its heartbeat (1017h) is on and faster than this",
            found,
        )
    return found


def _last(connection: Bus, node_id: int) -> str:
    state = connection.heartbeats.state(node_id)
    return "silent" if state is None else f"last reported {NMT_STATES.get(state, f'state {state}')}"
