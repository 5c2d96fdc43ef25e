"""The model of a page: fingers, history, events, counters, and the state of each finger at a moment. One thread writes,
any number of browsers read.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from tipforce.host.frames.frame_array import SENT, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump_format import CandumpFormat
from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.sensor.contact import scalar
from tipforce.watching.feeds import Counters
from tipforce.watching.watcher import Finger
from tipforce_tools.page.history import Charted, Envelope, History

STALE_PERIODS = 2.5
STALE_S = 0.5
"""Used if no SYNC period is known."""
STREAM_STALE_S = 0.1
"""Minimum age of a stale stream: three pictures of the page."""
NO_ANSWER_S = 2.0
_PERIOD_ROWS = 33
_LOOK_BACK_ROWS = 4096
_DIGITS = (4, 3, 3)  # P in N, phi and theta in degrees: one more than the node's resolution

Word = Literal["live", "stale", "unknown", "silent"]


class FingerState(
    msgspec.Struct,
    frozen=True,
    omit_defaults=True,
    rename={
        "word": "w", "since_ms": "since", "status": "s", "reason": "why", "angle_reason": "angle", "flags": "f",
        "contact": "c", "gauges": "g",
    },
):  # fmt: skip
    """State of one finger, as a page gets it. A "silent" one has no numbers; those of a "stale" one are old."""

    word: Word
    since_ms: float
    """Time of the sample; 0 for none."""
    status: int = 0
    reason: str = ""
    """Why P, phi and theta are unknown; empty otherwise."""
    angle_reason: str = ""
    """Why only phi or theta is unknown."""
    flags: tuple[str, ...] = ()
    """What the status says besides contact and calibration, in words."""
    contact: tuple[float, ...] = ()
    u: tuple[float, ...] = ()
    gauges: tuple[float, ...] = ()


def period_ns(t_ns: npt.NDArray[np.int64]) -> int:
    """Return the SYNC period of the last rows (m,) in nanoseconds; 0 for too few rows."""
    times = t_ns[-_PERIOD_ROWS:]
    return int(np.median(np.diff(times))) if len(times) > 2 else 0


def finger_states(history: History, now_ns: int, fingers: int) -> list[FingerState]:
    """Return the state of each finger at ``now_ns``, from the rows up to then.

    A sample is live for 2.5 SYNC periods (0.5 s if the period is unknown), counted in SYNCs while these arrive.
    Without SYNC the minimum is 0.1 s, the resolution of the page.
    """
    last = int(np.searchsorted(history.t_ns, now_ns, side="right"))
    recent = history.part(max(0, last - _PERIOD_ROWS), last)
    if not len(recent):
        return [_silent(0)] * fingers
    period = period_ns(recent.t_ns)
    limit_ns = int(STALE_PERIODS * period) if period else int(STALE_S * 1e9)
    newest_ns = int(recent.t_ns[-1])
    stopped = now_ns - newest_ns > max(limit_ns, int(STREAM_STALE_S * 1e9))
    # The row to show of each finger: its last new and recent one, else any response, else -1. A SYNC without a new
    # sample (status bit 3) is ignored while the previous sample is not stale.
    young = (recent.t_ns >= newest_ns - limit_ns)[:, np.newaxis]
    answered = (recent.status & reasons.NO_ANSWER == 0) & young
    number = np.arange(len(recent))[:, np.newaxis]
    fresh_row = np.where(answered & (recent.status & scalar.STALE == 0), number, -1).max(axis=0)
    rows = np.where(fresh_row >= 0, fresh_row, np.where(answered, number, -1).max(axis=0))
    states = []
    for k, row in enumerate(rows.tolist()):
        shown = row >= 0 and not stopped
        states.append(_state(recent, row, k, "live") if shown else _old(history, last, k, now_ns))
    return states


def _old(history: History, last: int, k: int, now_ns: int) -> FingerState:
    """Return the state of a finger without a recent response: its last one, unless that is too old."""
    back = history.part(max(0, last - _LOOK_BACK_ROWS), last)
    answered = np.flatnonzero(back.status[:, k] & reasons.NO_ANSWER == 0)
    if not len(answered):
        return _silent(0)
    row = int(answered[-1])
    if now_ns - back.t_ns[row] > NO_ANSWER_S * 1e9:
        return _silent(int(back.t_ns[row]))
    return _state(back, row, k, "stale")


def _state(block: Block, row: int, k: int, word: Word) -> FingerState:
    contact, status = block.contact[row, k], int(block.status[row, k])
    reason = angle_reason = ""
    if np.isnan(contact[0]):
        reason = next(iter(reasons.why_no_force(status)), "the node sends no force")
    elif np.isnan(contact[1:]).any():
        angle_reason = reasons.why_no_angle(status) or reasons.UNKNOWN_TO_THE_NODE
    if reason and word == "live":
        word = "unknown"
    flags = tuple(reasons.flags(status) if reason else reasons.doubts(status))
    values, u = (
        tuple(round(value, digits) for value, digits in zip(of[row, k].tolist(), _DIGITS, strict=True))
        for of in (block.contact, block.u)
    )
    strains = tuple(round(strain, 1) for strain in block.gauges[row, k].tolist())
    return FingerState(word, int(block.t_ns[row]) / 1e6, status, reason, angle_reason, flags, values, u, strains)


def _silent(since_ns: int) -> FingerState:
    return FingerState("silent", since_ns / 1e6, reason="no response")


MAX_EVENTS = 2000
SHOWN_FRAMES = 12
_RATE_ROWS = 4096


class PageEvent(msgspec.Struct, frozen=True, rename={"number": "n", "t_ms": "t", "node_id": "node"}):
    """An entry of the event list. ``node_id`` 0 is the bus; ``number`` counts from 1."""

    number: int
    t_ms: float
    node_id: int
    kind: str
    text: str


class Picture(msgspec.Struct, omit_defaults=True, rename={"states": "fingers"}):
    """The state of the page at one moment, as a page gets it; times in milliseconds since 1970."""

    t: float
    start: float
    end: float
    rate: float
    """Rows a second."""
    period: float
    generation: int
    error: str
    nmt: list[str]
    counters: Counters
    states: list[FingerState]
    bins: dict[str, Any] | None = None
    """Those since the last picture, of a stream."""
    events: list[PageEvent] | None = None
    """New ones, of a stream; all up to the moment, of a log."""
    ended: bool = False
    frames: list[str] | None = None
    """The last ones up to the moment, as `candump -tz` prints them."""


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
        self.frames: tuple[FrameArray, tuple[str, ...]] | None = None
        """Those of a log and its interfaces, to be shown as candump does; None: too many, or live."""
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
            self._events.append(PageEvent(self._event_count, t_ns / 1e6, node_id, kind, text))

    def events(self, after: int = 0, until_ns: int | None = None) -> list[PageEvent]:
        """Return events with a number above ``after``, up to a time."""
        with self._lock:
            return [e for e in self._events if e.number > after and (until_ns is None or e.t_ms <= until_ns / 1e6)]

    def now_ns(self) -> int:
        """Return the present on the time scale of the rows, of a log its end: a set clock makes no row new."""
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
            lines = None
            if self.frames is not None:
                frames, names = self.frames
                last = int(np.searchsorted(frames["t_ns"], moment, side="right"))
                # -tz counts from the first frame
                shown = np.append(frames[:1], frames[max(0, last - SHOWN_FRAMES) : last])
                block = CandumpBlock(shown, shown["channel"].astype(np.uint16), names, shown["flags"] & SENT != 0)
                lines = CandumpFormat("z").lines(block)[1:]
            times_ms = moment / 1e6, start / 1e6, end / 1e6
            return Picture(
                *times_ms, round(rate_hz, 2), period_ns(t_ns[:last]) / 1e6, self.generation, self.error, self.nmt,
                self.counters, states, frames=lines,
            )  # fmt: skip

    def envelope(self, first_bin: int, last_bin: int, width_ns: int, what: Charted = "contact") -> Envelope:
        """See History."""
        with self._lock:
            return self._history.envelope(first_bin, last_bin, width_ns, what)

    def largest(self) -> tuple[float, float]:
        """See History."""
        with self._lock:
            return self._history.largest()

    def best_ns(self) -> int:
        """Return the time of the row in which most fingers are in contact, of these the one with the largest forces."""
        with self._lock:
            P, theta = self._history.rows.contact[..., 0], self._history.rows.contact[..., 2]
            score = 1e6 * np.isfinite(theta).sum(axis=1) + np.nansum(P, axis=1)
            return int(self._history.t_ns[int(score.argmax())]) if len(score) else 0

    def rows_after(self, t_ns: int, count: int, until_ns: int) -> Block:
        """Return a copy of at most ``count`` rows with t_ns < time <= until_ns."""
        with self._lock:
            low, high = np.searchsorted(self._history.t_ns, (t_ns, until_ns), side="right")
            part = self._history.part(int(low), min(int(low) + count, int(high)))
            return Block(*(column.copy() for column in part.columns))
