"""Frames of a bus, a log or a commissioned hand as blocks of contacts and events of the fingers in them."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from canopen_device.core.codes import EMCY_BASE, HEARTBEAT_BASE, NMT_COB_ID, NODE_ID_MASK, SYNC_COB_ID, TPDO_BASES
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import RefusedError, TipforceError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.health import Health
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.events import Event, Supervisor
from tipforce.host.hand.file import HandFile
from tipforce.host.hand.rows import Collector
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, LoadMeter
from tipforce.samples.columns import Block
from tipforce.samples.record import Rows, joined
from tipforce.samples.rows import RowTally
from tipforce.sensor.structure.layouts import CASE_OF_CODE, LAYOUTS
from tipforce.sensor.structure.strain import FABRICATED, Gauge, Geometry

if TYPE_CHECKING:
    from tipforce.host.hand.hand import Hand
    from tipforce.watching.frame_sources import FrameSource

Fallback = tuple[str, Geometry, tuple[Gauge, ...]]
"""Name, geometry and gauges of a layout."""
FingerMaker = Callable[[int], "Finger | None"]
"""The finger of a node-id found on a bus; None hides it."""


@dataclass(frozen=True, slots=True)
class Finger:
    """One fingertip. ``gauges`` is empty if their positions are unknown."""

    node_id: int
    name: str = ""
    calibration: Calibration | None = None
    geometry: Geometry = FABRICATED
    gauges: tuple[Gauge, ...] = ()
    layout: str = ""

    @property
    def label(self) -> str:
        """Display name: ``thumb`` or ``finger 5``."""
        return self.name or f"finger {self.node_id}"


def with_layout(finger: Finger, layout: str, fallback: Fallback | None) -> Finger:
    """Return the finger with its gauges: from ``layout``, else from its calibration, else from ``fallback``."""
    if not layout and finger.calibration is not None:
        layout = CASE_OF_CODE.get(finger.calibration.layout_code, "")
    if layout:
        return replace(finger, layout=layout, gauges=LAYOUTS[layout])
    if fallback is not None:
        return replace(finger, layout=fallback[0], geometry=fallback[1], gauges=fallback[2])
    return finger


def hand_fingers(hand: HandFile | Hand, fallback: Fallback | None = None) -> tuple[Finger, ...]:
    """Return the fingers of a hand, with calibrations and gauge positions. Raises InputError. A commissioned hand has
    also the nodes' own calibrations, where its file has none."""
    plans = hand.finger if isinstance(hand, HandFile) else hand.file.finger
    return tuple(
        with_layout(Finger(plan.node_id, plan.name, hand.calibration(plan)), plan.layout, fallback) for plan in plans
    )


def finger_maker(node_ids: Collection[int] | None = None, fallback: Fallback | None = None) -> FingerMaker:
    """Return what makes the fingers; those that are not in ``node_ids`` are hidden."""

    return lambda node: with_layout(Finger(node), "", fallback) if node_ids is None or node in node_ids else None


HEARTBEAT_TIMEOUT_S = 2.5
ROW_TIMEOUT_S = 0.05
HEALTH_YOUNG_NS = 3_000_000_000
_SERVICE = ~np.uint32(NODE_ID_MASK)
_SERVICES = (NMT_COB_ID, EMCY_BASE, HEARTBEAT_BASE)
COUNTED = ("missing", "late", "mixed", "doubtful")
"""The counts of a RowTally by finger that are shown, as ``Counters`` has them."""
_UNPACED_FRAMES = 50  # PDOs without a SYNC, or without the PDO that began the rows, after which another begins them


class Watcher:
    """Find fingers by their PDOs, collect rows, monitor heartbeats and EMCY. ``fingers`` are shown from the start."""

    def __init__(self, make_finger: FingerMaker, gauges: int = 3, fingers: Sequence[Finger] = ()) -> None:
        self._make_finger, self._gauges = make_finger, gauges
        self.fingers: tuple[Finger, ...] = tuple(fingers)
        self._bases = {
            m.cob_id_base: (m.name, m.length_bytes)
            for m in tpdo_messages(gauges)
            if m.cob_id_base and m.name != "Health"
        }
        self._heard: dict[int, set[str]] = {finger.node_id: set() for finger in fingers}
        self._collector: Collector | None = None
        self._supervisor = Supervisor([f.node_id for f in fingers], HEARTBEAT_TIMEOUT_S)
        self._health = Decoder(gauges)
        self._health_u: dict[int, tuple[int, float]] = {}
        self._faults = Health()
        self._synced = False
        self._unpaced = 0
        self._pacer = 0

    def add(self, frames: FrameArray, now_s: float) -> tuple[list[Block], list[Event]]:
        """Process frames, FRAME (n,), at the monotonic time ``now_s``; call it also without frames."""
        self.discover(frames)
        events = self._watch(frames, now_s)
        if self._collector is None:
            return [], events
        rows = self._collector.add(self._paced(frames), now_s)
        service = frames["can_id"] & _SERVICE
        chosen = frames.compress((service == TPDO_BASES[3]) | (service == HEARTBEAT_BASE) | (service == EMCY_BASE))
        if len(chosen):
            decoded = self._health.decode(chosen)
            self._faults.take(chosen, decoded.values())
            for (node_id, _), samples in decoded.items():
                self._health_u[node_id] = int(samples.t_ns[-1]), float(samples.columns["u_P"][-1])
        if not len(rows):
            return [], events
        faults = np.stack([self._faults.at(finger.node_id, rows.sync_ns)[0] for finger in self.fingers], axis=-1)
        calibrations = [finger.calibration for finger in self.fingers]
        u_of_rows = None
        if self._health_u:
            sent = [self._health_u.get(finger.node_id, (0, np.nan)) for finger in self.fingers]
            young = [np.where(np.abs(rows.sync_ns - t_ns) < HEALTH_YOUNG_NS, u_P, np.nan) for t_ns, u_P in sent]
            u_of_rows = np.stack(young, axis=-1)
        return [rows.block(calibrations, self._gauges, u_of_rows, faults)], events

    def pace_by_pdo(self) -> None:
        """Let a PDO begin the rows from the first on, as where there is no SYNC."""
        self._unpaced = max(_UNPACED_FRAMES, 4 * len(self.fingers))

    def state(self, node_id: int) -> str:
        """Return the NMT state of a finger by its heartbeat; empty without one; or that its node-id is that of two."""
        if node_id in self._supervisor.duplicates.found:
            return "id is that of two nodes"
        return self._supervisor.state_name(node_id) if self._supervisor.states.get(node_id, -1) >= 0 else ""

    @property
    def tally(self) -> RowTally:
        """Counts so far."""
        return RowTally(tuple(f.node_id for f in self.fingers)) if self._collector is None else self._collector.tally

    def discover(self, frames: FrameArray) -> None:
        """Only find the fingers: the first pass over a log."""
        ids = frames["can_id"]
        if not self._synced:
            self._find_pace(frames)
        changed = False
        for can_id in np.unique(ids).tolist():
            base, node_id = can_id & ~NODE_ID_MASK, can_id & NODE_ID_MASK
            name, length = self._bases.get(base, ("", 0))
            if not name or not node_id or name in self._heard.get(node_id, ()):
                continue
            if int(frames["length"][ids == can_id].max()) < length:
                continue
            if node_id not in self._heard:
                finger = self._make_finger(node_id)
                if finger is None:
                    continue
                self.fingers = tuple(sorted((*self.fingers, finger), key=lambda known: known.node_id))
                self._heard[node_id] = set()
                self._supervisor.states.setdefault(node_id, -1)
            self._heard[node_id].add(name)
            changed = True
        if changed:
            self._new_collector()

    def _new_collector(self) -> None:
        """Collect the PDOs that all fingers send; if there are none, the one that most fingers send."""
        sets = [names for names in self._heard.values() if names]
        count = Counter(name for names in sets for name in names)
        messages = [name for name, number in count.items() if number == len(sets)] or [count.most_common(1)[0][0]]
        # TPDO2 first: it names the columns of the contact.
        messages.sort(key=("Contact", "Force", "Gauges").index)
        node_ids = [finger.node_id for finger in self.fingers]
        before, self._collector = self._collector, Collector(node_ids, messages, self._gauges, ROW_TIMEOUT_S)
        if before is not None:
            columns = [node_ids.index(node_id) for node_id in before.node_ids]
            self._collector.tally.rows = before.tally.rows
            for what in COUNTED:
                getattr(self._collector.tally, what)[columns] = getattr(before.tally, what)

    def _watch(self, frames: FrameArray, now_s: float) -> list[Event]:
        """Process services one by one: they are few, and in a log each has its own time."""
        if not len(frames):
            return self._supervisor.add(frames, now_s)
        service = frames["can_id"] & _SERVICE
        few = frames[np.isin(service, _SERVICES) & (frames["can_id"] != SYNC_COB_ID)]
        events: list[Event] = []
        for k in range(len(few)):
            events += self._supervisor.add(few[k : k + 1], float(few["t_ns"][k]) * 1e-9)
        return events

    def _find_pace(self, frames: FrameArray) -> None:
        ids = frames["can_id"]
        self._synced = bool((ids == SYNC_COB_ID).any())
        pdos = ids[np.isin(ids & _SERVICE, list(self._bases))]
        self._unpaced = 0 if (pdos == self._pacer).any() else self._unpaced + len(pdos)
        if not self._synced and len(pdos) and self._unpaced >= max(_UNPACED_FRAMES, 4 * len(self.fingers)):
            values, counts = np.unique(pdos, return_counts=True)
            self._pacer = int(values[counts.argmax()])
        if self._synced:
            self._pacer = 0

    def _paced(self, frames: FrameArray) -> FrameArray:
        if not self._pacer or not len(frames):
            return frames
        places = np.flatnonzero(frames["can_id"] == self._pacer)
        syncs = np.zeros(len(places), dtype=FRAME)
        syncs["t_ns"], syncs["can_id"] = frames["t_ns"][places], SYNC_COB_ID
        return np.insert(frames, places, syncs)


MOST_WAITING = 10_000
"""Batches of rows and events; beyond it the oldest are dropped."""
_GATHER_S = 0.001  # one row at a time would cost several times as much
_MOST_READS = 64  # of a bus that does not fall silent
_NO_FRAMES: FrameArray = np.zeros(0, dtype=FRAME)


@dataclass(slots=True)
class Counters:
    """Sums since the start; per finger where stated. None: unknown to this source."""

    rows: int = 0
    missing: list[int] = field(default_factory=list)
    late: list[int] = field(default_factory=list)
    mixed: list[int] = field(default_factory=list)
    doubtful: list[int] = field(default_factory=list)
    dropped: int = 0
    """Frames that the kernel or a buffer dropped."""
    overrun: int = 0
    """Batches lost because they were not taken in time."""
    load: tuple[float | None, float | None] = (None, None)
    """Bus load as a fraction of the bit rate, without stuff bits and with the most."""
    jitter_p99_us: float | None = None

    @classmethod
    def of(cls, tally: RowTally, dropped: int = 0, overrun: int = 0, **more: Any) -> Counters:
        """Return these counts of rows, and more."""
        of_fingers = {what: getattr(tally, what).tolist() for what in COUNTED}
        return cls(tally.rows, **of_fingers, dropped=dropped, overrun=overrun, **more)


class Feed:
    """Rows of all fingers, and events. ``close`` releases the source; ``state``: the NMT state of a node-id, or ""."""

    def __init__(
        self, close: Callable[[], object], state: Callable[[int], str], fingers: Sequence[Finger], gauges: int
    ) -> None:
        self.close, self.state, self.gauges = close, state, gauges
        self.fingers = tuple(fingers)
        """In the order of the columns; more may be found."""
        self.ended = False
        """No more will come."""
        self.overrun = 0
        """Batches lost because they were not taken in time."""
        self.arrived_s = 0.0
        """Monotonic time at which the newest rows arrived."""
        self.hints: list[str] = []
        """What the bus lacks, to be shown and removed."""

    def take(self, timeout_s: float) -> tuple[list[Block], list[Event]]:
        """Return what has arrived, after waiting for it up to a timeout. Raises the error that ended the reception."""
        raise NotImplementedError

    def now_ns(self) -> int:
        """Return the present on the clock of the rows, nanoseconds of the epoch."""
        return time.time_ns()

    def counters(self) -> Counters:
        """Return the sums so far."""
        raise NotImplementedError

    def tare(self, node_id: int) -> str:
        """Take the present force as zero; return the tare as text. Raises TipforceError."""
        raise RefusedError(f"node {node_id}: this command only listens to the bus")


class HandFeed(Feed):
    """A hand that the program commissions."""

    def __init__(self, hand: Hand, fingers: Sequence[Finger]) -> None:
        super().__init__(hand.close, hand.state, fingers, hand.file.finger[0].gauges)
        self._hand = hand
        self._waiting: deque[Rows | Event] = deque()
        self._changed = threading.Condition()
        hand.on_rows(self._put)
        hand.on_event(self._put)

    def _put(self, item: Rows | Event) -> None:
        with self._changed:
            if len(self._waiting) == MOST_WAITING:
                self._waiting.popleft()
                self.overrun += 1
            self._waiting.append(item)
            self.arrived_s = time.monotonic()
            self._changed.notify()

    def take(self, timeout_s: float) -> tuple[list[Block], list[Event]]:
        """See Feed."""
        with self._changed:
            if not self._waiting and self._hand.error is not None:  # after all that came before it
                raise self._hand.error
            if not self._waiting and timeout_s:
                self._changed.wait(timeout_s)
        if timeout_s:
            time.sleep(_GATHER_S)
        with self._changed:
            items, self._waiting = self._waiting, deque()
        rows = [item for item in items if isinstance(item, Rows)]
        blocks = [joined(rows).block(self._hand.calibrations, self.gauges)] if rows else []
        return blocks, [item for item in items if isinstance(item, Event)]

    def tare(self, node_id: int) -> str:
        """See Feed."""
        return self._hand.tare(node_id)

    def counters(self) -> Counters:
        """See Feed."""
        statistics = self._hand.statistics()
        jitter_us = statistics.sync.p99_us if statistics.sync.periods else None
        more = {"load": statistics.load, "jitter_p99_us": jitter_us}
        return Counters.of(statistics.tally, statistics.dropped, self.overrun, **more)


class FrameFeed(Feed):
    """Frames of a bus or a log; sends nothing to the bus."""

    def __init__(
        self, source: FrameSource, make_finger: FingerMaker, gauges: int = 3, fingers: Sequence[Finger] = (),
        bit_rate: int = DEFAULT_BIT_RATE,
    ) -> None:  # fmt: skip
        self._watcher, self._load = Watcher(make_finger, gauges, fingers), LoadMeter(bit_rate)
        super().__init__(source.close, self._watcher.state, fingers, gauges)
        self.frames = 0
        self._source, self._down = source, False
        self._failure: TipforceError | None = None

    def take(self, timeout_s: float) -> tuple[list[Block], list[Event]]:
        """See Feed."""
        try:
            frames = self._read(timeout_s)
        except InterfaceDownError as error:
            down, self._down = self._down, True
            return [], [] if down else [Event(time.monotonic(), 0, "bus_down", str(error))]
        events = []
        if len(frames):
            self.arrived_s = time.monotonic()
            self.frames += len(frames)
            self._load.add(frames, self.arrived_s)
            if self._down:
                self._down = False
                events.append(Event(self.arrived_s, 0, "bus_up", "frames are received again"))
        blocks, watched = self._watcher.add(frames, self.now_ns() * 1e-9)
        self.fingers, self.ended = self._watcher.fingers, self._source.ended
        if self.ended:
            blocks += self._watcher.add(_NO_FRAMES, self.now_ns() * 1e-9 + 1.0)[0]
        return blocks, [*events, *watched]

    def _read(self, timeout_s: float) -> FrameArray:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        frames, _ = self._source.take(timeout_s)
        if timeout_s or not len(frames):
            return frames
        parts = [frames]
        try:
            while len(parts) < _MOST_READS and len(more := self._source.take(0.0)[0]):
                parts.append(more)
        except TipforceError as error:
            self._failure = error  # of the next call: it costs no frame that came before it
        return np.concatenate(parts)

    def now_ns(self) -> int:
        """See Feed."""
        return self._source.now_ns() or time.time_ns()

    def counters(self) -> Counters:
        """See Feed."""
        load = self._load.load(time.monotonic())
        return Counters.of(self._watcher.tally, self._source.dropped, load=load)
