"""Messages to the page: pictures, envelopes and events as JSON, and the playhead that selects the moment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from tipforce.errors import InputError
from tipforce_tools.view.history import Charted, Envelope
from tipforce_tools.view.model import Model, PageEvent, Picture
from tipforce_tools.view.states import FingerState

MAX_BINS = 1500
"""Limit per message: a browser that reconnects late gets the newest ones."""
MAX_EVENTS = 200
SPEEDS = 0.05, 50.0
_BIN_DIGITS = 4
_DIGITS = (4, 3, 3)  # P in N, phi and theta in degrees: one more than the node's resolution


class Playhead:
    """The moment that a browser shows: the present, or one that advances from ``start_ns`` at ``speed``."""

    def __init__(
        self, model: Model, start_ns: int | None = None, speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise InputError(f"speed {speed:g}: allowed are {SPEEDS[0]:g} to {SPEEDS[1]:g}")
        self._model, self._start_ns, self._speed, self._clock = model, start_ns, speed, clock
        self._begun_s = clock()

    def now_ns(self) -> tuple[int, bool]:
        """Return (time, ended): it stops at the end of a log; at the end of a live recording it follows the present."""
        present = self._model.now_ns()
        if self._start_ns is None:
            return present, not self._model.live
        moment = self._start_ns + round((self._clock() - self._begun_s) * self._speed * 1e9)
        moment = max(moment, self._model.span_ns()[0])
        if moment >= present:
            self._start_ns = None if self._model.live else self._start_ns
            return present, not self._model.live
        return moment, False


class Cursor:
    """Position of one browser in the stream. There is no queue: a late browser gets one message with all missed rows.

    They are envelopes that keep the extremes, so at most one message is in transit.
    """

    def __init__(
        self, model: Model, playhead: Playhead, bin_ns: int, after_event: int = 0, what: Charted = "contact"
    ) -> None:
        self._model, self._playhead, self._bin_ns, self._what = model, playhead, bin_ns, what
        self._bin = playhead.now_ns()[0] // bin_ns
        self._event = after_event

    def message(self) -> tuple[dict[str, Any], bool]:
        """Return the next message, and whether it is the last one."""
        now_ns, ended = self._playhead.now_ns()
        picture = self._model.picture(now_ns)
        last = now_ns // self._bin_ns
        first = max(self._bin, last - MAX_BINS + 1)
        # The last bin is not complete: it is sent again.
        self._bin = last
        found = picture_message(self._model, picture)
        found["bins"] = envelope_message(self._model.envelope(first, last, self._bin_ns, self._what))
        events = self._model.events(self._event, now_ns if not self._is_live(now_ns) else None)[-MAX_EVENTS:]
        if events:
            self._event = events[-1].number
            found["events"] = [_event(event) for event in events]
        if ended:
            found["ended"] = True
        return found, ended

    def _is_live(self, now_ns: int) -> bool:
        return self._model.live and now_ns >= self._model.span_ns()[1]


def encode(message: Any) -> bytes:
    """Encode as JSON; NaN becomes null."""
    return msgspec.json.encode(message)


def picture_message(model: Model, picture: Picture) -> dict[str, Any]:
    """Encode a moment; times in milliseconds since 1970."""
    counters = model.counters
    return {
        "t": picture.now_ns / 1e6, "start": picture.start_ns / 1e6, "end": picture.end_ns / 1e6,
        "rate": round(picture.rate_hz, 2), "period": picture.period_ns / 1e6, "generation": picture.generation,
        "error": model.error, "nmt": model.nmt,
        "fingers": [_state(state) for state in picture.states],
        "counters": {
            "rows": counters.rows, "missing": counters.missing, "late": counters.late, "mixed": counters.mixed,
            "doubtful": counters.doubtful,
            "dropped": counters.dropped, "overrun": counters.overrun,
            "load": [counters.load_low, counters.load_high], "jitter_p99_us": counters.jitter_p99_us,
        },
    }  # fmt: skip


def envelope_message(envelope: Envelope) -> dict[str, Any]:
    """Encode bins, each with k x (3 q + 1) numbers: low, high and u of q quantities, and the number of unknown rows."""
    parts = [np.round(array.astype(np.float64), _BIN_DIGITS) for array in (envelope.low, envelope.high, envelope.u)]
    unknown = envelope.unknown[..., np.newaxis].astype(np.float64)
    table = np.concatenate([*parts, unknown], axis=-1)
    return {"i": envelope.index.tolist(), "v": table.reshape(len(table), table.shape[1] * table.shape[2]).tolist()}


def events_message(model: Model, until_ns: int | None = None) -> list[dict[str, Any]]:
    """Encode the last events up to a time."""
    return [_event(event) for event in model.events(0, until_ns)[-MAX_EVENTS:]]


def _state(state: FingerState) -> dict[str, Any]:
    found: dict[str, Any] = {"w": state.word, "since": state.since_ns / 1e6, "s": state.status}
    if state.reason:
        found["why"] = state.reason
    if state.angle_reason:
        found["angle"] = state.angle_reason
    if state.flags:
        found["f"] = state.flags
    if state.word != "silent":
        found["c"] = [round(value, digits) for value, digits in zip(state.contact, _DIGITS, strict=True)]
        found["u"] = [round(value, digits) for value, digits in zip(state.u, _DIGITS, strict=True)]
        found["g"] = [round(value, 1) for value in state.gauges]
    return found


def _event(event: PageEvent) -> dict[str, Any]:
    return {
        "n": event.number, "t": event.t_ns / 1e6, "node": event.node_id, "kind": event.kind, "text": event.text
    }  # fmt: skip
