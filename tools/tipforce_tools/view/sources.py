"""Sources of a page: a listener on a bus, a running hand. log_source.py has logs."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from tipforce.errors import EnvironmentLackError, RefusedError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.events import Event
from tipforce.host.hand.hand import Hand
from tipforce.host.hand.rows import Rows, joined
from tipforce.host.live.receiver import InterfaceDownError, Receiver
from tipforce.host.network.bus_load import LoadMeter
from tipforce_tools.view.blocks import block_of_rows
from tipforce_tools.view.fingers import Finger
from tipforce_tools.view.model import Model
from tipforce_tools.view.watcher import Watcher

MAX_WAITING_ROWS = 20_000
MAX_WAITING_BATCHES = 5_000
"""Limit of received frames, some seconds; beyond it the oldest are dropped, which the page reports."""
_RECEIVE_S = 0.02
_LOAD_WINDOW_S = 1.0


class Source(Protocol):
    """Fills a model. One thread calls ``pump`` about 30 times a second."""

    model: Model
    title: str
    no_tare: str
    """Why tare is not available; empty if it is."""

    def pump(self) -> None:
        """Move received data into the model."""

    def tare(self, node_id: int) -> str:
        """Set the present force of a finger as zero; return the message to show. Raises TipforceError."""

    def close(self) -> None:
        """Release the source."""


class HandSource:
    """A commissioned hand. Its receiving thread only queues rows; ``pump`` does the rest."""

    def __init__(self, hand: Hand, fingers: Sequence[Finger], title: str) -> None:
        self.title, self.no_tare = title, ""
        self._hand = hand
        self._messages = hand.file.messages
        self.model = Model(fingers, hand.file.finger[0].gauges)
        self._waiting: deque[Rows] = deque()
        self._waiting_rows = self._overrun = 0
        self._arrived_s = 0.0
        self._lock = threading.Lock()
        hand.on_rows(self._put)
        hand.on_event(self._event)

    def _put(self, rows: Rows) -> None:
        with self._lock:
            self._waiting.append(rows)
            self._arrived_s = time.monotonic()
            self._waiting_rows += len(rows)
            while self._waiting_rows > MAX_WAITING_ROWS:
                lost = len(self._waiting.popleft())
                self._waiting_rows -= lost
                self._overrun += lost

    def _event(self, event: Event) -> None:
        self.model.add_event(time.time_ns(), event.node_id, event.kind, event.text)

    def pump(self) -> None:
        """See Source."""
        with self._lock:
            waiting, self._waiting, self._waiting_rows = list(self._waiting), deque(), 0
            arrived_s = self._arrived_s
        if waiting:
            rows = joined(waiting)
            self.model.add(block_of_rows(rows, self.model.fingers, self.model.gauges), arrived_s)
        if self._hand.error is not None:
            self.model.error = f"reception has ended: {self._hand.error}"
        found, counters = self._hand.statistics(), self.model.counters
        tally = found.tally
        counters.rows = tally.rows
        for name in ("missing", "late", "mixed", "doubtful"):
            setattr(counters, name, getattr(tally, name).tolist())
        counters.dropped, counters.overrun = found.dropped, self._overrun
        counters.jitter_p99_us = found.sync.p99_us if found.sync.periods else None
        self.model.nmt = [self._hand.state(finger.node_id) for finger in self.model.fingers]
        counters.load_low, counters.load_high = found.load

    def tare(self, node_id: int) -> str:
        """See Source."""
        return self._hand.tare(node_id)

    def close(self) -> None:
        """See Source."""
        self._hand.close()


class ListenSource:
    """A listener on a bus, in its own thread."""

    def __init__(
        self, receiver: Receiver, title: str, make_finger: Callable[[int], Finger | None], gauges: int = 3,
        fingers: Sequence[Finger] = (), bit_rate: int = 1_000_000,
    ) -> None:  # fmt: skip
        self.title, self.no_tare = title, "this page only listens to the bus"
        self._receiver, self._load = receiver, LoadMeter(bit_rate)
        self.model = Model(fingers, gauges)
        self._watcher = Watcher(make_finger, gauges, fingers, self.model.set_fingers)
        self._waiting: deque[tuple[FrameArray, float]] = deque(maxlen=MAX_WAITING_BATCHES)
        self._down = False
        self._looked_s = time.monotonic()
        self._stopped = threading.Event()
        self.received = 0
        """Number of frames received."""
        self._thread = threading.Thread(target=self._receive, name="view receiver", daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        while not self._stopped.is_set():
            try:
                frames = self._receiver.receive(_RECEIVE_S)
            except InterfaceDownError as error:
                self._say_down(str(error))
                self._stopped.wait(0.2)
                continue
            except EnvironmentLackError as error:
                self.model.error = str(error)
                self._say_down(str(error))
                return
            if len(frames):
                self.received += len(frames)
                self._load.add(frames, time.monotonic())
                if self._down:
                    self._down = False
                    self.model.add_event(time.time_ns(), 0, "bus_up", "frames are received again")
                if len(self._waiting) == MAX_WAITING_BATCHES:
                    self.model.counters.overrun += 1
                self._waiting.append((frames, time.monotonic()))
            self._looked_s = time.monotonic()

    def _say_down(self, text: str) -> None:
        if not self._down:
            self._down = True
            self.model.add_event(time.time_ns(), 0, "bus_down", text)

    def pump(self) -> None:
        """See Source."""
        # A row times out by the time of the last read: frames still in the socket are not missing.
        looked_s = self._looked_s
        waiting = [self._waiting.popleft() for _ in range(len(self._waiting))]
        now_s = time.monotonic()
        arrived_s = waiting[-1][1] if waiting else now_s
        frames = np.concatenate([frames for frames, _ in waiting]) if waiting else None
        blocks, events = self._watcher.add(_NO_FRAMES if frames is None else frames, looked_s)
        for block in blocks:
            self.model.add(block, arrived_s)
            self.model.counters.rows += len(block)
        for event in events:
            self.model.add_event(time.time_ns(), event.node_id, event.kind, event.text)
        counters = self.model.counters
        for name, values in self._watcher.tally().items():
            setattr(counters, name, values)
        counters.dropped = self._receiver.dropped
        self.model.nmt = self._watcher.nmt()
        self.model.counters.load_low, self.model.counters.load_high = self._load.load(now_s)

    def tare(self, node_id: int) -> str:
        """See Source."""
        raise RefusedError(f"node {node_id}: {self.no_tare}")

    def close(self) -> None:
        """See Source."""
        self._stopped.set()
        self._thread.join()
        self._receiver.close()


_NO_FRAMES: FrameArray = np.zeros(0, dtype=FRAME)
