"""The CANopen services besides PDOs as text, for ``tipforce dump``; EMCYs and changes of NMT states as events, for
``tipforce decode``. Identifiers are those of the predefined connection set (CiA 301, 7.3.5)."""

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from canopen_device.core import codes
from tipforce.dictionary import indices
from tipforce.dictionary.service_texts import LSS_PARTS, LSS_SERVICES, NMT_COMMANDS, emcy_text, state_text
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.sdo_conversation import Describe, SdoConversation, fingertip_names
from tipforce.host.decoding.service_frames import raw_frames, services
from tipforce.host.frames.frame_array import FrameArray

_DAY_MS, _EPOCH_DAYS = 86_400_000, 5113  # TIME counts from 1984-01-01
_CRC_READ = struct.pack("<BHB", 0x43, indices.CALIBRATION_CHECK, 3)
"""Start of a response to the read of the active calibration's CRC-32: expedited, 4 bytes (CiA 301, 7.2.4.3.6)."""
_LSS_ERRORS = {0: "accepted", 1: "refused", 2: "failed"}


class Service(NamedTuple):
    """One frame of a service. ``row``: its place in the input; ``node_id`` 0: all nodes, or none."""

    row: int
    name: str
    node_id: int
    text: str


NO_TIME = -1


class BusEvent(NamedTuple):
    """An EMCY, a change of an NMT state or of the calibration, or two nodes with one node-id. ``kind``: "emcy",
    "emcy_reset", "boot_up", "state", "calibration" or "duplicate"."""

    t_ns: int
    """NO_TIME of a log without timestamps."""
    channel: str
    node_id: int
    kind: str
    code: int
    """EMCY error code, NMT state, or CRC-32 of the active record (2103h:3), 0 of a node without one."""
    text: str


class Services:
    """Describe the frames of services. It follows SDO transfers from block to block."""

    def __init__(self, describe: Describe | None = None) -> None:
        self._describe = describe or fingertip_names()
        self._conversations: dict[tuple[int, int], SdoConversation] = {}

    def describe(self, frames: FrameArray, channel: npt.NDArray[np.integer[Any]] | None = None) -> Iterator[Service]:
        """Yield the services among FRAME (n,), in order. PDOs, error frames and 29-bit frames are left out. ``channel``
        (n,): numbers of the buses, if they are not those in ``frames``."""
        ids = frames["can_id"]
        rows = np.flatnonzero(
            (ids < codes.TPDO_BASES[0])
            | ((ids >= codes.SDO_RESPONSE_BASE) & (ids <= codes.STANDARD_MASK))
            | (ids & ~np.uint32(codes.NODE_ID_MASK) == codes.HEARTBEAT_BASE | codes.REMOTE_FLAG)
        )
        buses = (frames["channel"] if channel is None else channel)[rows].tolist()
        for row, bus, (_, can_id, data) in zip(rows.tolist(), buses, raw_frames(frames.take(rows)), strict=True):
            if (service := self._service(can_id, data, bus)) is not None:
                yield Service(row, *service)

    def _service(self, can_id: int, data: bytes, channel: int) -> tuple[str, int, str] | None:
        node_id, function = can_id & codes.NODE_ID_MASK, can_id & codes.FUNCTION_MASK
        if can_id & codes.REMOTE_FLAG:
            return "heartbeat", node_id, "node guarding request"
        if can_id == codes.NMT_COB_ID:
            return _nmt(data)
        if can_id == codes.SYNC_COB_ID:
            return "SYNC", 0, f"SYNC {data[0]}" if data else "SYNC"
        if can_id == codes.TIME_COB_ID:
            return _time(data)
        if can_id in (codes.LSS_REQUEST_COB_ID, codes.LSS_RESPONSE_COB_ID):
            return _lss(can_id, data)
        if not node_id:
            return None
        if function == codes.EMCY_BASE and len(data) == 8:
            return "EMCY", node_id, f"EMCY {_emcy(data)}"
        if function == codes.HEARTBEAT_BASE and len(data) == 1:
            return "heartbeat", node_id, f"heartbeat {state_text(data[0] & codes.NODE_ID_MASK)}"
        if function in (codes.SDO_REQUEST_BASE, codes.SDO_RESPONSE_BASE) and len(data) == 8:
            sdo = self._conversations.setdefault((channel, node_id), SdoConversation(node_id, self._describe))
            is_request = function == codes.SDO_REQUEST_BASE
            return "SDO", node_id, sdo.request(data) if is_request else sdo.response(data)
        return None


class BusEvents:
    """Collect the events of ``node_ids`` (None: all) in the order of a recording. By channel and node-id, ``states``:
    the last NMT state; ``calibrations``: the last CRC-32 read from 2103h:3."""

    def __init__(self, node_ids: Iterable[int] | None = None) -> None:
        self._node_ids = None if node_ids is None else frozenset(node_ids)
        self.states: dict[tuple[str, int], int] = {}
        self.calibrations: dict[tuple[str, int], int] = {}
        self.found: list[BusEvent] = []
        self._duplicates: dict[str, DuplicateNodes] = {}
        self._doubled: set[tuple[str, int]] = set()

    def add(self, frames: FrameArray, channels: Sequence[str], timed: bool = True) -> None:
        """Add the events among FRAME (n,), which may not be ``timed``; ``channels`` are the interfaces by number."""
        chosen = services(frames)
        for number, (t_ns, can_id, content) in zip(chosen["channel"].tolist(), raw_frames(chosen), strict=True):
            channel, node_id = channels[number], can_id & codes.NODE_ID_MASK
            duplicate = self._duplicates.setdefault(channel, DuplicateNodes()).frame(can_id, content, t_ns)
            if self._node_ids is None or node_id in self._node_ids:
                double = None if duplicate is None else ("duplicate", 0, str(duplicate))
                for event in (double, _event(can_id - node_id, content)):
                    if event is not None:
                        self._append(BusEvent(t_ns if timed else NO_TIME, channel, node_id, *event))

    def _append(self, event: BusEvent) -> None:
        """Add an event, unless it repeats the state or the calibration of its node, or that two nodes have its id."""
        place = event.channel, event.node_id
        if event.kind == "duplicate" and place in self._doubled:
            return
        if event.kind in ("duplicate", "boot_up"):
            (self._doubled.add if event.kind == "duplicate" else self._doubled.discard)(place)
        last = self.calibrations if event.kind == "calibration" else self.states
        if event.kind in ("state", "calibration") and last.get(place) == event.code:
            return
        if event.kind in ("state", "boot_up", "calibration"):
            last[place] = event.code
        self.found.append(event)


def _event(function: int, data: bytes) -> tuple[str, int, str] | None:
    if function == codes.HEARTBEAT_BASE and len(data) == 1:
        state = data[0] & codes.NODE_ID_MASK
        return "boot_up" if state == codes.INITIALISING else "state", state, state_text(state)
    if function == codes.EMCY_BASE and len(data) == 8:
        code = int.from_bytes(data[:2], "little")
        return "emcy" if code >> 8 else "emcy_reset", code, _emcy(data)
    if function == codes.SDO_RESPONSE_BASE and data.startswith(_CRC_READ):
        crc = int.from_bytes(data[4:], "little")
        return "calibration", crc, f"CRC-32 0x{crc:08X}" if crc else "not calibrated"
    return None


def _emcy(data: bytes) -> str:
    code, register = struct.unpack_from("<HB", data)
    more = f", data {data[3:].hex(' ').upper()}" if any(data[3:]) else ""
    return emcy_text(code, register) + more


def _nmt(data: bytes) -> tuple[str, int, str] | None:
    if len(data) != 2:
        return None
    command = NMT_COMMANDS.get(data[0], f"command 0x{data[0]:02X}")
    return "NMT", data[1], f"NMT {command}" if data[1] else f"NMT {command}, all nodes"


def _time(data: bytes) -> tuple[str, int, str] | None:
    if len(data) != 6:
        return None
    ms, days = struct.unpack("<IH", data)
    moment = np.datetime64((days + _EPOCH_DAYS) * _DAY_MS + (ms & 0x0FFFFFFF), "ms")
    return "TIME", 0, f"TIME {moment}"


def _lss(can_id: int, data: bytes) -> tuple[str, int, str] | None:
    if len(data) != 8:
        return None
    service, number = data[0], int.from_bytes(data[1:5], "little")
    if codes.LSS_SELECT_FIRST <= service <= codes.LSS_SELECT_LAST:
        text = f"select {LSS_PARTS[service - codes.LSS_SELECT_FIRST]} {number}"
    elif codes.LSS_IDENTIFY_FIRST <= service <= codes.LSS_IDENTIFY_LAST:
        k = service - codes.LSS_IDENTIFY_FIRST
        part = LSS_PARTS[k] if k < 2 else f"{LSS_PARTS[k // 2 + 1]} {'up to' if k % 2 else 'from'}"
        text = f"identify {part} {number}"
    elif codes.LSS_INQUIRE_FIRST <= service < codes.LSS_INQUIRE_NODE_ID:
        value = "" if can_id == codes.LSS_REQUEST_COB_ID else f" = {number}"
        text = f"inquire {LSS_PARTS[service - codes.LSS_INQUIRE_FIRST]}{value}"
    else:
        text = LSS_SERVICES.get(service, f"service 0x{service:02X}")
        text += _lss_request(data, number) if can_id == codes.LSS_REQUEST_COB_ID else _lss_response(data)
    return "LSS", 0, f"LSS {text}"


def _lss_request(data: bytes, number: int) -> str:
    match data[0]:
        case codes.LSS_SWITCH_GLOBAL:
            return " configuration" if data[1] else " waiting"
        case codes.LSS_FASTSCAN if data[5] == codes.LSS_START_FASTSCAN:
            return " start"
        case codes.LSS_FASTSCAN:
            return f" {LSS_PARTS[data[6] & 3]} 0x{number:08X}, bit {data[5]}"
        case codes.LSS_NODE_ID:
            return f" {data[1]}"
        case codes.LSS_BIT_TIMING:
            return f" number {data[2]}"
    return ""


def _lss_response(data: bytes) -> str:
    if data[0] == codes.LSS_INQUIRE_NODE_ID:
        return f" = {data[1]}"
    if data[0] in (codes.LSS_NODE_ID, codes.LSS_BIT_TIMING, codes.LSS_STORE):
        return f": {_LSS_ERRORS.get(data[1], f'error {data[1]}')}"
    return ""
