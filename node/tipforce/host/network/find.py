"""Find the nodes on a bus and their state; bring nodes to a state by NMT."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from canopen_device.core import codes
from tipforce.dictionary import objects as od
from tipforce.dictionary.service_texts import state_text
from tipforce.dictionary.table import REVISION
from tipforce.errors import DuplicateNodeError, InputError, NoResponseError, SdoAbortError, TipforceError
from tipforce.host.network.finger import Finger
from tipforce.host.network.sdo import checked_time
from tipforce.samples import reasons

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray
    from tipforce.host.network.bus import Bus

FIND_S = 0.25
"""For the responses of all nodes to one request each."""
_DEVICE_TYPE = (0x00, 0x10, 0x00)  # 1000h:00 in bytes 1 to 3 of a request, and of its response or abort
_READ_DEVICE_TYPE = bytes((0x40, *_DEVICE_TYPE, 0, 0, 0, 0))
_IN_A_ROW, _GAP_S = 8, 1e-3  # requests without a pause, so that short transmit queues do not overflow
_AGAIN_S = 0.5  # an NMT command without its state
_STEP_S = 0.02  # between looks whether every node-id was heard
_FAILED: dict[type[TipforceError], str] = {
    SdoAbortError: "no identity object",
    NoResponseError: "stopped responding",
    InputError: "unknown object format",  # a device of another type whose objects have other lengths
}


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node found by a scan; texts are for display."""

    node_id: int
    state: str
    """NMT state from its heartbeat, or "no heartbeat"."""
    device: str
    serial: int = 0
    calibration: str = "unknown"
    eds: str = "unknown"
    """"match", or the difference."""
    faults: str = ""
    """Its faults (2124h), in words."""
    duplicate: str = ""
    """What shows that two nodes use this node-id, and what to do."""
    product: int = 0
    """Its product code (1018h:2); 0 where it is unknown."""


def find_nodes(
    connection: Bus, node_ids: Iterable[int], wait_s: float = 1.2,
    observe: Callable[[FrameArray], object] = lambda _frames: None,
) -> list[FoundNode]:  # fmt: skip
    """Request 1000h of every node-id, listen for ``wait_s`` or until all respond and beat, then identify the nodes; one
    that only beats (STOPPED) is listed. ``observe`` gets the frames. Raises InputError outside 1..127, and
    EnvironmentLackError for a bus that failed."""
    wanted = set(node_ids)
    if not wanted <= set(range(1, 128)):
        raise InputError(f"node-ids {sorted(wanted)}: allowed are 1 to 127")
    states: dict[int, int] = {}
    answered: set[int] = set()
    _request_device_types(connection, wanted)
    end_s, ended = time.monotonic() + checked_time("wait_s", wait_s), False
    while not ended:
        left_s = end_s - time.monotonic()
        time.sleep(max(min(_STEP_S, left_s), 0.0))
        frames = connection.buffer.take_all()
        observe(frames)
        parts = frames["can_id"].tolist(), frames["data"][:, 0].tolist(), frames["length"].tolist()
        for can_id, first, length in zip(*parts, strict=True):
            if can_id - codes.SDO_RESPONSE_BASE in wanted:
                answered.add(can_id - codes.SDO_RESPONSE_BASE)
            elif can_id - codes.HEARTBEAT_BASE in wanted and length == 1:
                states[can_id - codes.HEARTBEAT_BASE] = first & 0x7F
        ended = left_s <= _STEP_S or wanted <= answered & states.keys()
    connection.check_reception()
    return [_describe(connection, n, states.get(n), n in answered) for n in sorted(answered | set(states))]


def responding_nodes(connection: Bus) -> set[int]:
    """Return the node-ids that answer a request of 1000h within FIND_S, all of it: a second node needs its time too."""
    _request_device_types(connection, range(1, codes.NODE_ID_MASK + 1))
    time.sleep(FIND_S)
    frames = connection.buffer.take_all()
    frames = frames[(frames["data"][:, 1:4] == _DEVICE_TYPE).all(axis=1)]  # not those that another master requested
    node_ids = frames["can_id"].astype(np.int64) - codes.SDO_RESPONSE_BASE
    return set(node_ids[(node_ids > 0) & (node_ids <= codes.NODE_ID_MASK)].tolist())


def _request_device_types(connection: Bus, node_ids: Collection[int]) -> None:
    connection.buffer.clear()
    for count, node_id in enumerate(sorted(node_ids), start=1):
        connection.send(codes.SDO_REQUEST_BASE + node_id, _READ_DEVICE_TYPE)
        if not count % _IN_A_ROW:
            time.sleep(_GAP_S)


def _describe(connection: Bus, node_id: int, state: int | None, answers: bool) -> FoundNode:
    node = FoundNode(node_id, "no heartbeat" if state is None else state_text(state), "no SDO in this state")
    if not answers:
        return replace(node, duplicate=str(connection.duplicates.found.get(node_id, "")))
    try:
        identified = _identified(connection.finger(node_id), node)
        connection.sdo(node_id).check_duplicates(wait=True)
        return identified
    except DuplicateNodeError as error:
        return replace(node, device="two nodes", duplicate=str(error))
    except tuple(_FAILED) as error:
        return replace(node, device=next(text for kind, text in _FAILED.items() if isinstance(error, kind)))


def _identified(finger: Finger, node: FoundNode) -> FoundNode:
    identity = finger.identity()
    node = replace(node, serial=identity.serial, product=identity.product)
    if not identity.is_fingertip:
        device = f"product 0x{identity.product:08X}" if identity.product else f"of vendor 0x{identity.vendor:08X}"
        return replace(node, device=device, calibration="not a fingertip", eds="no: another device")
    crc = finger.sdo.read(od.CALIBRATION_ACTIVE_CRC)
    generation = finger.sdo.read(od.CALIBRATION_GENERATION)
    calibration = f"0x{crc:08X} generation {generation}" if crc else reasons.NOT_CALIBRATED
    faults = ", ".join(reasons.of_faults(finger.sdo.read(od.FAULTS)))
    eds = "match"
    if identity.revision >> 16 != REVISION >> 16:
        eds = f"no: revision 0x{identity.revision:08X}, expected 0x{REVISION:08X}"
    device = f"{'simulated ' if identity.simulated else ''}fingertip, {identity.gauges} gauges"
    return replace(node, device=device, calibration=calibration, eds=eds, faults=faults)


class NotReachedError(NoResponseError):
    """Some nodes did not report the state; ``reached`` has the states of the others, by node-id."""

    def __init__(self, message: str, reached: dict[int, str]) -> None:
        super().__init__(message)
        self.reached = reached


def command_and_wait(
    connection: Bus, command: str, node_ids: Collection[int], timeout_s: float = 2.0
) -> dict[int, str]:
    """Send an NMT command; return the state that each heartbeat reported. All but resets are repeated, because NMT is
    not confirmed. Raises NotReachedError naming nodes that are off, or whose heartbeat (1017h) is slower or 0."""
    since_s, reached = time.monotonic(), dict[int, str]()
    again_s = timeout_s if command.startswith("reset") else _AGAIN_S
    waiting = sorted(node_ids)
    while waiting and (now_s := time.monotonic()) < since_s + timeout_s:
        for node_id in waiting:
            wanted = connection.nmt(command, node_id)
        until_s = min(now_s + again_s, since_s + timeout_s)
        for node_id in waiting:
            if connection.heartbeats.wait(node_id, wanted, since_s, max(0.0, until_s - time.monotonic())):
                reached[node_id] = state_text(wanted)
        waiting = [node_id for node_id in waiting if node_id not in reached]
    if waiting:
        last = ((node_id, connection.heartbeats.state(node_id)) for node_id in waiting)
        shown = [f"{n} ({'silent' if s is None else f'last reported {state_text(s)}'})" for n, s in last]
        raise NotReachedError(
            f"nmt {command}: no heartbeat with the new state within {timeout_s:g} s from node {', '.join(shown)}; "
            "check that its heartbeat (1017h) is on and faster than this",
            reached,
        )
    return reached
