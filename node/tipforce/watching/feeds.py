"""Rows of all fingers and events, live: of a commissioned hand, or of frames of a bus or a log that are listened to."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tipforce.errors import RefusedError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.events import Event
from tipforce.host.hand.hand import Hand
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, LoadMeter
from tipforce.samples.columns import Block
from tipforce.samples.record import Rows, joined
from tipforce.watching.frame_sources import FrameSource
from tipforce.watching.watcher import Finger, FingerMaker, Watcher

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
        if self._hand.error is not None:
            raise self._hand.error
        with self._changed:
            if not self._waiting and timeout_s:
                self._changed.wait(timeout_s)
        if timeout_s:
            time.sleep(_GATHER_S)
        with self._changed:
            items, self._waiting = self._waiting, deque()
        rows = [item for item in items if isinstance(item, Rows)]
        blocks = [joined(rows).block([finger.calibration for finger in self.fingers], self.gauges)] if rows else []
        return blocks, [item for item in items if isinstance(item, Event)]

    def tare(self, node_id: int) -> str:
        """See Feed."""
        return self._hand.tare(node_id)

    def counters(self) -> Counters:
        """See Feed."""
        statistics = self._hand.statistics()
        jitter_us = statistics.sync.p99_us if statistics.sync.periods else None
        tally = statistics.tally
        return Counters(
            tally.rows, tally.missing.tolist(), tally.late.tolist(), tally.mixed.tolist(), tally.doubtful.tolist(),
            statistics.dropped, self.overrun, statistics.load, jitter_us,
        )  # fmt: skip


class FrameFeed(Feed):
    """Frames of a bus or a log; sends nothing to the bus."""

    def __init__(
        self, source: FrameSource, make_finger: FingerMaker, gauges: int = 3, fingers: Sequence[Finger] = (),
        bit_rate: int = DEFAULT_BIT_RATE,
    ) -> None:  # fmt: skip
        self._watcher, self._load = Watcher(make_finger, gauges, fingers), LoadMeter(bit_rate)
        super().__init__(source.close, self._watcher.state, fingers, gauges)
        self.rows = self.frames = 0
        self._source, self._down = source, False

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
        self.rows += sum(map(len, blocks))
        return blocks, [*events, *watched]

    def _read(self, timeout_s: float) -> FrameArray:
        frames, _ = self._source.take(timeout_s)
        if timeout_s or not len(frames):
            return frames
        parts = [frames]
        while len(parts) < _MOST_READS and len(more := self._source.take(0.0)[0]):
            parts.append(more)
        return np.concatenate(parts)

    def now_ns(self) -> int:
        """See Feed."""
        return self._source.now_ns() or time.time_ns()

    def counters(self) -> Counters:
        """See Feed."""
        load = self._load.load(time.monotonic())
        return Counters(self.rows, *self._watcher.tally(), dropped=self._source.dropped, load=load)
