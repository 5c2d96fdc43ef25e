"""What `tipforce ros2` publishes from: a commissioned hand, or frames of a bus or a log that it only listens to."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

import numpy as np

from tipforce.errors import RefusedError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.events import Event
from tipforce.host.hand.hand import Hand
from tipforce.host.hand.rows import Rows, joined
from tipforce.host.live.receiver import InterfaceDownError
from tipforce_tools.monitor.sources import Source
from tipforce_tools.view.blocks import Block, block_of_rows
from tipforce_tools.view.fingers import Finger
from tipforce_tools.view.watcher import Watcher

_WAITING = 10_000  # batches of rows and events
_GATHER_S = 0.001  # one row at a time would cost several times as much
_NO_FRAMES: FrameArray = np.zeros(0, dtype=FRAME)


class Feed(Protocol):
    """Rows of all fingers, and events."""

    overrun: int
    """Batches lost because they were not taken in time."""

    @property
    def ended(self) -> bool:
        """No more will come."""

    @property
    def fingers(self) -> Sequence[Finger]:
        """In the order of the columns; more may be found."""

    def take(self, timeout_s: float) -> tuple[list[Block], list[Event]]:
        """Return what has arrived, after waiting for it up to a timeout."""

    def now_ns(self) -> int:
        """Return the present on the clock of the rows, nanoseconds of the epoch."""

    def state(self, node_id: int) -> str:
        """Return the NMT state; empty if it is not known."""

    def tare(self, node_id: int) -> str:
        """Take the present force as zero; return the tare as text. Raises TipforceError."""


class HandFeed:
    """A hand that this command commissions."""

    def __init__(self, hand: Hand, fingers: Sequence[Finger]) -> None:
        self.ended, self.overrun, self.fingers = False, 0, tuple(fingers)
        self._hand, self._gauges = hand, hand.file.finger[0].gauges
        self._arrived: queue.Queue[Rows | Event] = queue.Queue(_WAITING)
        hand.on_rows(self._put)
        hand.on_event(self._put)

    def _put(self, item: Rows | Event) -> None:
        try:
            self._arrived.put_nowait(item)
        except queue.Full:
            self.overrun += 1

    def take(self, timeout_s: float) -> tuple[list[Block], list[Event]]:
        """See Feed. Raises the error that ended the reception."""
        if self._hand.error is not None:
            raise self._hand.error
        items: list[Rows | Event] = []
        with suppress(queue.Empty):
            items.append(self._arrived.get(timeout=timeout_s))
            time.sleep(_GATHER_S)
            while True:
                items.append(self._arrived.get_nowait())
        rows = [item for item in items if isinstance(item, Rows)]
        blocks = [block_of_rows(joined(rows), self.fingers, self._gauges)] if rows else []
        return blocks, [item for item in items if isinstance(item, Event)]

    def now_ns(self) -> int:
        """See Feed."""
        return time.time_ns()

    def state(self, node_id: int) -> str:
        """See Feed."""
        return self._hand.state(node_id)

    def tare(self, node_id: int) -> str:
        """See Feed."""
        return self._hand.tare(node_id)


class ListenFeed:
    """Frames of a bus or a log; sends nothing to the bus."""

    def __init__(
        self, source: Source, make_finger: Callable[[int], Finger | None], gauges: int, fingers: Sequence[Finger] = ()
    ) -> None:
        self.overrun = 0
        self._source, self._down = source, False
        self._watcher = Watcher(make_finger, gauges, fingers)

    @property
    def ended(self) -> bool:
        """See Feed."""
        return self._source.ended

    @property
    def fingers(self) -> Sequence[Finger]:
        """See Feed."""
        return self._watcher.fingers

    def take(self, timeout_s: float) -> tuple[list[Block], list[Event]]:
        """See Feed."""
        try:
            frames, _ = self._source.take(timeout_s)
        except InterfaceDownError as error:
            down, self._down = self._down, True
            return [], [] if down else [Event(time.monotonic(), 0, "bus_down", str(error))]
        events = []
        if self._down and len(frames):
            self._down = False
            events.append(Event(time.monotonic(), 0, "bus_up", "frames are received again"))
        blocks, found = self._watcher.add(frames, self.now_ns() * 1e-9)
        if self.ended:
            blocks += self._watcher.add(_NO_FRAMES, self.now_ns() * 1e-9 + 1.0)[0]
        return blocks, [*events, *found]

    def now_ns(self) -> int:
        """See Feed."""
        return self._source.now_ns() or time.time_ns()

    def state(self, node_id: int) -> str:
        """See Feed."""
        states = dict(zip((finger.node_id for finger in self.fingers), self._watcher.nmt(), strict=True))
        return states.get(node_id, "")

    def tare(self, node_id: int) -> str:
        """See Feed."""
        raise RefusedError(f"node {node_id}: this command only listens to the bus")
