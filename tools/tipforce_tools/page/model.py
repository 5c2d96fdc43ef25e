"""The model of a page: the last minutes, or a whole log, of all fingers, with events and counters, as one thread writes
and any number of browsers read them: pictures of a moment, envelopes of any part. No finger is live without a young
sample."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump_format import CandumpFormat
from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.samples.reasons import NO_ANSWER
from tipforce.sensor.contact.scalar import CALIBRATED, FRONT_END_FAULT, SATURATED, STALE
from tipforce.watching.feeds import Counters, Finger

MAX_BYTES = 96 << 20
MAX_ROWS = 600_000
MAX_EVENTS = 2000
SHOWN_FRAMES = 12
_RATE_ROWS = 4096
STALE_PERIODS = 2.5
STALE_S = 0.5
"""Used if no SYNC period is known."""
STREAM_STALE_S = 0.1
"""Minimum age of a stale stream: three pictures of the page."""
NO_ANSWER_S = 2.0
_PERIOD_ROWS = 33
_LOOK_BACK_ROWS = 4096
_DIGITS = (4, 3, 3)  # P in N, phi and theta in degrees: one more than the node's resolution

Charted = Literal["contact", "forces", "gauges"]
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
    """The rows of a recording or a bus, for any number of pages; thread-safe.

    ``live`` is False for a log. Rows are in the order of time: beyond ``capacity`` (0: what fits into MAX_BYTES) the
    oldest are dropped, and a time that steps backwards (a set clock) continues from the last."""

    def __init__(
        self, fingers: Sequence[Finger], gauges: int = 3, *, live: bool = True, capacity: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self.gauges, self.live = gauges, live
        self.fingers: tuple[Finger, ...] = ()
        """The fingers in the order of the columns."""
        self.counters = Counters()
        self.generation = time.time_ns() // 1_000_000
        """Grows by 1 with each change of the fingers; another server at the same address has another one."""
        self.frames: tuple[FrameArray, tuple[str, ...]] | None = None
        """Those of a log and its interfaces, to be shown as candump does; None: too many, or live."""
        self.nmt: list[str] = []
        """Present NMT state of each finger, if the source knows it."""
        self.error = ""
        """Why the source has ended."""
        self._make_room(fingers, capacity)
        self._events: deque[PageEvent] = deque(maxlen=MAX_EVENTS)
        self._event_count = 0
        self._arrived_s = clock()
        self._clock = clock
        self._lock = threading.RLock()

    def _make_room(self, fingers: Sequence[Finger], capacity: int = 0) -> None:
        self.fingers, count = tuple(fingers), len(fingers)
        fits = MAX_BYTES // (2 * row_bytes(count, self.gauges))
        self.capacity = capacity or max(min(MAX_ROWS, fits), 1000)
        self._shift_ns = self._start = self._end = 0
        # Twice the capacity, so that the rows kept are always one slice.
        self._kept = Block.zeros(2 * self.capacity, count, self.gauges)

    @property
    def rows(self) -> Block:
        """All rows as views: copy data that must outlive the next ``add``."""
        return self._kept.part(slice(self._start, self._end))

    def set_fingers(self, fingers: Sequence[Finger]) -> None:
        """Add fingers found on the bus; in existing rows they are missing."""
        with self._lock:
            place = {finger.node_id: k for k, finger in enumerate(fingers)}
            columns, before = [place[finger.node_id] for finger in self.fingers], self.rows
            self._make_room(fingers)
            wider = Block.zeros(len(before), len(fingers), self.gauges)
            wider.t_ns[:] = before.t_ns
            for ours, theirs in zip(wider.columns[1:], before.columns[1:], strict=True):
                ours[:] = NO_ANSWER if ours is wider.status else np.nan
                ours[:, columns] = theirs
            if len(wider):
                self._append(wider)
            self.generation += 1

    def add(self, block: Block, arrived_s: float | None = None) -> None:
        """Add rows, the last of which arrived at ``arrived_s`` of the clock (None: now)."""
        if len(block):
            with self._lock:
                self._append(block)
                self._arrived_s = self._clock() if arrived_s is None else arrived_s

    def _append(self, block: Block) -> None:
        block = block.part(slice(-self.capacity, None))
        if self._end + len(block) > len(self._kept):
            keep = min(self._end - self._start, self.capacity)
            for array in self._kept.columns:
                array[:keep] = array[self._end - keep : self._end].copy()
            self._start, self._end = 0, keep
        last_ns = self._kept.t_ns[self._end - 1] - self._shift_ns if self._end > self._start else block.t_ns[0]
        shift_ns = self._shift_ns + np.maximum(-np.diff(block.t_ns, prepend=last_ns), 0).cumsum()
        self._shift_ns, t_ns = int(shift_ns[-1]), block.t_ns + shift_ns
        place = slice(self._end, self._end + len(block))
        for ours, theirs in zip(self._kept.columns, (t_ns, *block.columns[1:]), strict=True):
            ours[place] = theirs
        # A number that its own status says to be unknown (2120h) is not shown.
        unknown = (block.status & (FRONT_END_FAULT | STALE) != 0) | (block.status & CALIBRATED == 0)
        self._kept.contact[place][unknown] = self._kept.u[place][unknown] = np.nan
        self._end += len(block)
        self._start = max(self._start, self._end - self.capacity)

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
            if self._end == self._start:
                return time.time_ns()
            waited_ns = round((self._clock() - self._arrived_s) * 1e9) if self.live else 0
            return int(self._kept.t_ns[self._end - 1]) + waited_ns

    def span_ns(self) -> tuple[int, int]:
        """Return the times of the first and the last row in memory; (0, 0) without any."""
        with self._lock:
            t_ns = self.rows.t_ns
            return (int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, 0)

    def picture(self, now_ns: int | None = None) -> Picture:
        """Return the state at ``now_ns`` (None: now)."""
        with self._lock:
            moment = self.now_ns() if now_ns is None else now_ns
            start, end = self.span_ns()
            past = self.rows.part(slice(int(np.searchsorted(self.rows.t_ns, moment, side="right"))))
            recent = past.t_ns[-_RATE_ROWS:]
            recent = recent[recent > moment - 1_000_000_000]
            rate_hz = (len(recent) - 1) / ((moment - int(recent[0])) * 1e-9) if (recent < moment).any() else 0.0
            lines = None
            if self.frames is not None:
                frames, names = self.frames
                last = int(np.searchsorted(frames["t_ns"], moment, side="right"))
                # -tz counts from the first frame
                shown = np.append(frames[:1], frames[max(0, last - SHOWN_FRAMES) : last])
                lines = CandumpFormat("z").lines(CandumpBlock(shown, names))[1:]
            times_ms = moment / 1e6, start / 1e6, end / 1e6
            return Picture(
                *times_ms, round(rate_hz, 2), period_ns(past.t_ns) / 1e6, self.generation, self.error, self.nmt,
                self.counters, finger_states(past, moment), frames=lines,
            )  # fmt: skip

    def envelope(
        self, first_bin: int, last_bin: int, width_ns: int, what: Charted = "contact"
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Return bins first to last (inclusive) of ``width_ns`` that are not empty: the number (b,) of each, whose time
        is number x width; and (b, k, 3 q + 1): minimum, maximum and largest standard uncertainty of q quantities, NaN
        where none was known, and the number of rows in which the first was unknown or the finger missing. Angles around
        180 degrees are within 0 to 360.

        The quantities are P, phi, theta; or without uncertainties F1, F2, F3, or the strain of each gauge."""
        with self._lock:
            span = np.searchsorted(self.rows.t_ns, (first_bin * width_ns, (last_bin + 1) * width_ns)).tolist()
            rows = self.rows.part(slice(*span))
            number = rows.t_ns // width_ns
            starts = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
            values = rows.gauges if what == "gauges" else forces(rows.contact) if what == "forces" else rows.contact
            if not len(starts):
                return number, np.zeros((0, values.shape[1], 3 * values.shape[2] + 1))
            u = rows.u if what == "contact" else np.full_like(values, np.nan)
            unknown = np.isnan(values[..., 0]) | (rows.status & NO_ANSWER != 0)
            ends = [extreme.reduceat(values, starts) for extreme in (np.fmin, np.fmax)]
            if what == "contact":  # angles the shorter way around: 179 and -179 degrees are 2 degrees apart
                turned = [extreme.reduceat(values[..., 1:] % 360.0, starts) for extreme in (np.fmin, np.fmax)]
                shorter = turned[1] - turned[0] < (ends[1] - ends[0])[..., 1:]
                for of_180, of_360 in zip(ends, turned, strict=True):
                    np.copyto(of_180[..., 1:], of_360, where=shorter)
            reduced = (
                *ends, np.fmax.reduceat(u, starts),
                np.add.reduceat(unknown.astype(np.int64), starts)[..., np.newaxis],
            )  # fmt: skip
            return number[starts], np.concatenate(reduced, axis=-1, dtype=np.float64)

    def largest(self) -> tuple[float, float]:
        """Return the largest P in newtons and the largest strain in microstrain, without sign; 0 if none is known. The
        strain of a finger with a saturated gauge or a fault is that of the converter's limit: it does not count."""
        with self._lock:
            rows = self.rows
            sound = (rows.status & (SATURATED | FRONT_END_FAULT) == 0)[..., np.newaxis]
            strain = np.fmax.reduce(np.abs(rows.gauges), axis=None, initial=0.0, where=sound)
            return float(np.fmax.reduce(rows.contact[..., 0], axis=None, initial=0.0)), float(strain)

    def best_ns(self) -> int:
        """Return the time of the row in which most fingers are in contact, of these the one with the largest forces."""
        with self._lock:
            contact = self.rows.contact
            score = 1e6 * np.isfinite(contact[..., 2]).sum(axis=1) + np.nansum(contact[..., 0], axis=1)
            return int(self.rows.t_ns[int(score.argmax())]) if len(score) else 0

    def rows_after(self, t_ns: int, count: int, until_ns: int) -> Block:
        """Return a copy of at most ``count`` rows with t_ns < time <= until_ns."""
        with self._lock:
            low, high = np.searchsorted(self.rows.t_ns, (t_ns, until_ns), side="right").tolist()
            part = self.rows.part(slice(low, min(low + count, high)))
            return Block(*(column.copy() for column in part.columns))


def row_bytes(fingers: int, gauges: int) -> int:
    """Bytes of one row."""
    return 8 + fingers * (4 * (6 + gauges) + 2)


def forces(contact: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return F1 = P sin(phi), F2 = P sin(phi - theta), F3 = P cos(phi) of (..., 3) P, phi, theta in degrees."""
    P, phi, theta = np.moveaxis(contact, -1, 0)
    return np.stack([P * np.sin(np.radians(phi)), P * np.sin(np.radians(phi - theta)), P * np.cos(np.radians(phi))], -1)


def period_ns(t_ns: npt.NDArray[np.int64]) -> int:
    """Return the SYNC period of the last rows (m,) in nanoseconds; 0 for too few rows."""
    times = t_ns[-_PERIOD_ROWS:]
    return int(np.median(np.diff(times))) if len(times) > 2 else 0


def finger_states(rows: Block, now_ns: int) -> list[FingerState]:
    """Return the state of each finger at ``now_ns``, from the rows up to then. A sample is live for 2.5 SYNC periods,
    counted in SYNCs while these arrive (0.5 s if the period is unknown; without SYNC at least 0.1 s)."""
    recent = rows.part(slice(-_PERIOD_ROWS, None))
    if not len(recent):
        return [_silent(0)] * rows.status.shape[1]
    period = period_ns(recent.t_ns)
    limit_ns = int(STALE_PERIODS * period) if period else int(STALE_S * 1e9)
    newest_ns = int(recent.t_ns[-1])
    stopped = now_ns - newest_ns > max(limit_ns, int(STREAM_STALE_S * 1e9))
    # The row to show of each finger: its last new and recent one, else any response, else -1. A SYNC without a new
    # sample (status bit 3) is ignored while the previous sample is not stale.
    young = (recent.t_ns >= newest_ns - limit_ns)[:, np.newaxis]
    answered = (recent.status & NO_ANSWER == 0) & young
    number = np.arange(len(recent))[:, np.newaxis]
    fresh_row = np.where(answered & (recent.status & STALE == 0), number, -1).max(axis=0)
    shown = np.where(fresh_row >= 0, fresh_row, np.where(answered, number, -1).max(axis=0)).tolist()
    return [
        _state(recent, row, k, "live") if row >= 0 and not stopped else _old(rows, k, now_ns)
        for k, row in enumerate(shown)
    ]


def _old(rows: Block, k: int, now_ns: int) -> FingerState:
    back = rows.part(slice(-_LOOK_BACK_ROWS, None))
    answered = np.flatnonzero(back.status[:, k] & NO_ANSWER == 0)
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
