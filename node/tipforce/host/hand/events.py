"""Events of a hand in order: heartbeats, boot-ups, EMCY, bus faults, babbling; frames and time in, no clock or bus."""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from canopen_device.core import codes
from tipforce.dictionary.service_texts import emcy_text, state_text
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.service_frames import find_duplicates
from tipforce.host.frames.frame_array import FrameArray, heartbeats_and_emcys

Kind = Literal[
    "found", "assigned", "configured", "calibrated", "verified", "started", "failed",
    "boot_up", "heartbeat_lost", "heartbeat_back", "state", "emcy", "emcy_reset", "bus_down", "bus_up",
    "babbling", "babbling_end", "duplicate", "changed", "accepted", "restored", "refused", "callback_failed",
]  # fmt: skip

UNSET_TIMEOUT_S = 2.5
"""For a node that is not operational: the default of its heartbeat (1017h) is once a second."""

MOST_WAITED_S = 5.0
_UNKNOWN_STATE = -1


@dataclass(frozen=True, slots=True)
class Event:
    """``t_s`` is monotonic; ``node_id`` 0 is the bus or the whole hand. ``text`` is for display."""

    t_s: float
    node_id: int
    kind: Kind
    text: str
    code: int = 0
    """EMCY error code, NMT state, or the babbling identifier."""


class Supervisor:
    """Monitor heartbeats and EMCY of ``node_ids``, each from its first heartbeat; ``timeout_s``: when operational."""

    def __init__(self, node_ids: Sequence[int], timeout_s: float = 0.5) -> None:
        self.timeout_s = timeout_s
        self.states: dict[int, int] = dict.fromkeys(node_ids, _UNKNOWN_STATE)
        """Last reported NMT state by node-id; -1 for a silent node."""
        self._heard_s: dict[int, float] = {}
        self.duplicates = DuplicateNodes()

    def state_name(self, node_id: int) -> str:
        """Return the NMT state as text."""
        state = self.states[node_id]
        return "silent" if state == _UNKNOWN_STATE else state_text(state)

    def add(self, frames: FrameArray, now_s: float) -> list[Event]:
        """Process received frames, FRAME (n,), and the time; return the events. Call it without frames too."""
        events: list[Event] = []
        if len(frames):
            # Not SDO: requests of the host itself are not among the frames of every link; its channels watch them.
            sdo = (frames["can_id"] >= codes.SDO_RESPONSE_BASE) & (frames["can_id"] < codes.HEARTBEAT_BASE)
            for duplicate in find_duplicates(self.duplicates, frames[~sdo]):
                if duplicate.node_id in self.states:
                    events.append(Event(now_s, duplicate.node_id, "duplicate", str(duplicate)))
            for _, function, node_id, data in heartbeats_and_emcys(frames):
                if node_id not in self.states:
                    continue
                if function == codes.HEARTBEAT_BASE and len(data) == 1:
                    events += self._heartbeat(node_id, data[0] & codes.NODE_ID_MASK, now_s)
                elif function == codes.EMCY_BASE and len(data) == 8:
                    code, register = struct.unpack_from("<HB", data)
                    kind: Kind = "emcy" if code else "emcy_reset"
                    events.append(Event(now_s, node_id, kind, emcy_text(code, register), code))
        for node_id, heard_s in list(self._heard_s.items()):
            # A node that has just booted sends heartbeats at its default rate until it is configured and started.
            unset = self.states[node_id] != codes.OPERATIONAL
            timeout_s = max(self.timeout_s, UNSET_TIMEOUT_S) if unset else self.timeout_s
            if now_s - heard_s > timeout_s:
                del self._heard_s[node_id]
                self.states[node_id] = _UNKNOWN_STATE
                events.append(Event(now_s, node_id, "heartbeat_lost", f"no heartbeat for {timeout_s:g} s"))
        return events

    def know(self, node_id: int, state: int, now_s: float) -> None:
        """Record a heartbeat that was received elsewhere, without an event."""
        self.states[node_id], self._heard_s[node_id] = state, now_s

    def forget(self) -> None:
        """Mark all nodes as unknown after the loss of the bus, until their next heartbeat."""
        self._heard_s.clear()
        self.states = dict.fromkeys(self.states, _UNKNOWN_STATE)

    def _heartbeat(self, node_id: int, state: int, now_s: float) -> Iterator[Event]:
        before, self.states[node_id], self._heard_s[node_id] = self.states[node_id], state, now_s
        if state == codes.INITIALISING:
            yield Event(now_s, node_id, "boot_up", "booted", state)
        elif before == _UNKNOWN_STATE:
            yield Event(now_s, node_id, "heartbeat_back", f"heartbeat received, {self.state_name(node_id)}", state)
        elif state != before:
            yield Event(now_s, node_id, "state", self.state_name(node_id), state)


def waited_s(frames: FrameArray, now_ns: int) -> float:
    """Return how long the last of these frames waited to be read, by its time stamp and the clock (ns since 1970):
    unread frames must not count as silence after a suspend. 0 without frames, and for time stamps of another clock."""
    late_s = (now_ns - int(frames["t_ns"][-1])) * 1e-9 if len(frames) else 0.0
    return late_s if 0.0 < late_s < MOST_WAITED_S else 0.0


WINDOW_S = 0.2
TIMES_SYNC = 4.0
_LEAST_HZ = 10.0
_BEYOND = codes.STANDARD_MASK + 1
_SDO_LAST = codes.SDO_REQUEST_BASE | codes.NODE_ID_MASK
_BEYOND_HEARTBEATS = codes.HEARTBEAT_BASE + codes.NODE_ID_MASK + 1  # LSS


class BabbleWatch:
    """Count every 11-bit identifier over WINDOW_S, to be below TIMES_SYNC SYNCs (``sync_hz``, 0: those received), or
    heartbeats if these are more frequent; a few frames are no rate."""

    def __init__(self, sync_hz: float, heartbeat_hz: float = 0.0) -> None:
        self._sync_hz, self._least_hz = sync_hz, max(heartbeat_hz, _LEAST_HZ)
        self._batches: list[FrameArray] = []
        self._since_s: float | None = None
        self._babbling: set[int] = set()

    def add(self, frames: FrameArray, now_s: float) -> list[Event]:
        """Process received frames, FRAME (n,), and the time; yield the starts and ends of babbling."""
        if self._since_s is None:
            self._since_s = now_s
        if len(frames):
            self._batches.append(frames)
        if now_s - self._since_s < WINDOW_S:
            return []
        # Frames that waited in the buffer are read together, but their time stamps differ.
        seconds = now_s - self._since_s
        if self._batches:
            seconds = max(seconds, int(self._batches[-1]["t_ns"][-1] - self._batches[0]["t_ns"][0]) * 1e-9)
        events = list(self._judge(seconds, now_s))
        self._batches, self._since_s = [], now_s
        return events

    def _judge(self, seconds: float, now_s: float) -> Iterator[Event]:
        ids = [np.zeros(0, dtype=np.uint32), *(frames["can_id"] for frames in self._batches)]
        counts = np.bincount(np.minimum(np.concatenate(ids), _BEYOND), minlength=_BEYOND + 1)[:_BEYOND]
        sync_hz = self._sync_hz or counts[codes.SYNC_COB_ID] / seconds
        counts[codes.SDO_RESPONSE_BASE : _SDO_LAST + 1] = counts[_BEYOND_HEARTBEATS:] = 0
        limit = TIMES_SYNC * max(sync_hz, self._least_hz) * seconds
        over = {int(n) for n in np.flatnonzero(counts > limit)} if sync_hz else set()
        # An end requires half the limit: an identifier near the limit would otherwise be reported repeatedly.
        over |= {n for n in self._babbling if counts[n] > limit / 2}
        for can_id in sorted(over - self._babbling):
            rate_hz = counts[can_id] / seconds
            yield Event(now_s, _node(can_id), "babbling", f"0x{can_id:03X} received {rate_hz:.0f} times/s", can_id)
        for can_id in sorted(self._babbling - over):
            yield Event(now_s, _node(can_id), "babbling_end", f"0x{can_id:03X} is below the limit again", can_id)
        self._babbling = over


def _node(can_id: int) -> int:
    return can_id & codes.NODE_ID_MASK if can_id > codes.SYNC_COB_ID else 0
