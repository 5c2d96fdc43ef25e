"""The model of the page: fingers, history, events, counters. One thread adds, any number of browsers look."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tipforce_tools.view.blocks import Block
from tipforce_tools.view.fingers import Finger
from tipforce_tools.view.history import Envelope, History
from tipforce_tools.view.states import FingerState, finger_states, period_ns

MAX_EVENTS = 2000
_RATE_ROWS = 4096


@dataclass(frozen=True, slots=True)
class PageEvent:
    """What happened, for the list. ``node_id`` 0 is the bus; ``number`` counts from 1."""

    number: int
    t_ns: int
    node_id: int
    kind: str
    text: str


@dataclass(slots=True)
class Counters:
    """Sums since the beginning; by finger where it says so. None: this source can't tell."""

    rows: int = 0
    missing: list[int] = field(default_factory=list)
    late: list[int] = field(default_factory=list)
    mixed: list[int] = field(default_factory=list)
    doubtful: list[int] = field(default_factory=list)
    dropped: int = 0
    """Frames that the kernel or a buffer dropped."""
    overrun: int = 0
    """Rows that the page took too late."""
    load_low: float | None = None
    """Bus load, fraction of the bit rate: without one stuff bit."""
    load_high: float | None = None
    """The same with as many as there can be."""
    jitter_p99_us: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """All that is shown at one moment."""

    now_ns: int
    start_ns: int
    end_ns: int
    rate_hz: float
    period_ns: int
    states: list[FingerState]
    generation: int


class Model:
    """Thread-safe. ``live`` is False for a log, which has a beginning and an end."""

    def __init__(
        self, fingers: Sequence[Finger], gauges: int = 3, *, live: bool = True, capacity: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self.gauges, self.live = gauges, live
        self.counters = Counters()
        self.generation = 0
        """Counts how often the fingers changed."""
        self.nmt: list[str] = []
        """NMT state of each finger now, where the source knows it."""
        self.error = ""
        """Why nothing comes any more."""
        self._fingers = tuple(fingers)
        self._history = History(len(self._fingers), gauges, capacity)
        self._events: deque[PageEvent] = deque(maxlen=MAX_EVENTS)
        self._event_count = 0
        self._arrived_s = clock()
        self._clock = clock
        self._lock = threading.RLock()

    @property
    def fingers(self) -> tuple[Finger, ...]:
        """In the order of the columns."""
        return self._fingers

    def set_fingers(self, fingers: Sequence[Finger]) -> None:
        """More fingers were heard: what there is stays, the new ones were missing so far."""
        with self._lock:
            place = {finger.node_id: k for k, finger in enumerate(fingers)}
            columns = np.array([place[finger.node_id] for finger in self._fingers], dtype=np.intp)
            self._history = self._history.widened(columns, len(fingers))
            self._fingers = tuple(fingers)
            self.generation += 1

    def add(self, block: Block, arrived_s: float | None = None) -> None:
        """Add rows, the last of which came at ``arrived_s`` of the clock (None: now)."""
        if len(block):
            with self._lock:
                self._history.append(block)
                self._arrived_s = self._clock() if arrived_s is None else arrived_s

    def add_event(self, t_ns: int, node_id: int, kind: str, text: str) -> None:
        """Add to the list; beyond MAX_EVENTS the oldest go."""
        with self._lock:
            self._event_count += 1
            self._events.append(PageEvent(self._event_count, t_ns, node_id, kind, text))

    def events(self, after: int = 0, until_ns: int | None = None) -> list[PageEvent]:
        """Those with a number over ``after``, up to a time."""
        with self._lock:
            return [e for e in self._events if e.number > after and (until_ns is None or e.t_ns <= until_ns)]

    def now_ns(self) -> int:
        """The present in the time of the rows: a clock that is set does not make old rows young.

        For a log: its end.
        """
        with self._lock:
            if not len(self._history):
                return time.time_ns()
            newest = int(self._history.t_ns[-1])
            return newest + (round((self._clock() - self._arrived_s) * 1e9) if self.live else 0)

    def span_ns(self) -> tuple[int, int]:
        """Times of the first and the last row that are kept; (0, 0) without any."""
        with self._lock:
            t_ns = self._history.t_ns
            return (int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, 0)

    def picture(self, now_ns: int | None = None) -> Picture:
        """What is shown at ``now_ns`` (None: now)."""
        with self._lock:
            moment = self.now_ns() if now_ns is None else now_ns
            start, end = self.span_ns()
            t_ns = self._history.t_ns
            last = int(np.searchsorted(t_ns, moment, side="right"))
            recent = t_ns[max(0, last - _RATE_ROWS) : last]
            recent = recent[recent > moment - 1_000_000_000]
            rate_hz = (len(recent) - 1) / max((moment - int(recent[0])) * 1e-9, 1e-9) if len(recent) > 1 else 0.0
            states = finger_states(self._history, moment, len(self._fingers))
            return Picture(moment, start, end, rate_hz, period_ns(t_ns[:last]), states, self.generation)

    def envelope(self, first_bin: int, last_bin: int, width_ns: int) -> Envelope:
        """See History."""
        with self._lock:
            return self._history.envelope(first_bin, last_bin, width_ns)

    def rows_after(self, t_ns: int, count: int, until_ns: int) -> Block:
        """A copy of at most ``count`` rows with t_ns < time <= until_ns."""
        with self._lock:
            low, high = np.searchsorted(self._history.t_ns, (t_ns, until_ns), side="right")
            part = self._history.part(int(low), min(int(low) + count, int(high)))
            return Block(part.t_ns.copy(), part.contact.copy(), part.u.copy(), part.gauges.copy(), part.status.copy())
