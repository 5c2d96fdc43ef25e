"""The model of the page: fingers, history, events, counters. One thread writes, any number of browsers read."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tipforce_tools.view.blocks import Block
from tipforce_tools.view.fingers import Finger
from tipforce_tools.view.history import Charted, Envelope, History
from tipforce_tools.view.states import FingerState, finger_states, period_ns

MAX_EVENTS = 2000
_RATE_ROWS = 4096


@dataclass(frozen=True, slots=True)
class PageEvent:
    """An entry of the event list. ``node_id`` 0 is the bus; ``number`` counts from 1."""

    number: int
    t_ns: int
    node_id: int
    kind: str
    text: str


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
    """Rows, or batches of frames, dropped because the page read them too late."""
    load_low: float | None = None
    """Bus load as a fraction of the bit rate, without stuff bits."""
    load_high: float | None = None
    """The same with the most stuff bits."""
    jitter_p99_us: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """The state of the page at one moment."""

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
        """Number of changes of the fingers."""
        self.nmt: list[str] = []
        """Present NMT state of each finger, if the source knows it."""
        self.error = ""
        """Why the source has ended."""
        self._fingers = tuple(fingers)
        self._history = History(len(self._fingers), gauges, capacity)
        self._events: deque[PageEvent] = deque(maxlen=MAX_EVENTS)
        self._event_count = 0
        self._arrived_s = clock()
        self._clock = clock
        self._lock = threading.RLock()

    @property
    def fingers(self) -> tuple[Finger, ...]:
        """The fingers in the order of the columns."""
        return self._fingers

    def set_fingers(self, fingers: Sequence[Finger]) -> None:
        """Add fingers found on the bus; in existing rows they are missing."""
        with self._lock:
            place = {finger.node_id: k for k, finger in enumerate(fingers)}
            columns = np.array([place[finger.node_id] for finger in self._fingers], dtype=np.intp)
            self._history = self._history.widened(columns, len(fingers))
            self._fingers = tuple(fingers)
            self.generation += 1

    def add(self, block: Block, arrived_s: float | None = None) -> None:
        """Add rows, the last of which arrived at ``arrived_s`` of the clock (None: now)."""
        if len(block):
            with self._lock:
                self._history.append(block)
                self._arrived_s = self._clock() if arrived_s is None else arrived_s

    def add_event(self, t_ns: int, node_id: int, kind: str, text: str) -> None:
        """Add to the list; beyond MAX_EVENTS the oldest are dropped."""
        with self._lock:
            self._event_count += 1
            self._events.append(PageEvent(self._event_count, t_ns, node_id, kind, text))

    def events(self, after: int = 0, until_ns: int | None = None) -> list[PageEvent]:
        """Return events with a number above ``after``, up to a time."""
        with self._lock:
            return [e for e in self._events if e.number > after and (until_ns is None or e.t_ns <= until_ns)]

    def now_ns(self) -> int:
        """Return the present on the time scale of the rows: setting the clock does not make old rows look new.

        For a log: its end.
        """
        with self._lock:
            if not len(self._history):
                return time.time_ns()
            newest = int(self._history.t_ns[-1])
            return newest + (round((self._clock() - self._arrived_s) * 1e9) if self.live else 0)

    def span_ns(self) -> tuple[int, int]:
        """Return the times of the first and the last row in memory; (0, 0) without any."""
        with self._lock:
            t_ns = self._history.t_ns
            return (int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, 0)

    def picture(self, now_ns: int | None = None) -> Picture:
        """Return the state at ``now_ns`` (None: now)."""
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

    def envelope(self, first_bin: int, last_bin: int, width_ns: int, what: Charted = "contact") -> Envelope:
        """See History."""
        with self._lock:
            return self._history.envelope(first_bin, last_bin, width_ns, what)

    def largest(self) -> tuple[float, float]:
        """See History."""
        with self._lock:
            return self._history.largest()

    def rows_after(self, t_ns: int, count: int, until_ns: int) -> Block:
        """Return a copy of at most ``count`` rows with t_ns < time <= until_ns."""
        with self._lock:
            low, high = np.searchsorted(self._history.t_ns, (t_ns, until_ns), side="right")
            part = self._history.part(int(low), min(int(low) + count, int(high)))
            return Block(part.t_ns.copy(), part.contact.copy(), part.u.copy(), part.gauges.copy(), part.status.copy())
