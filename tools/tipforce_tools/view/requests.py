"""JSON requests that a page sends over its WebSocket, and their responses. Independent of sockets."""

from __future__ import annotations

import math
import threading
from typing import Annotated, Any

import msgspec

from tipforce.errors import InputError, RefusedError
from tipforce_tools.view.history import Charted
from tipforce_tools.view.messages import (
    MAX_BINS,
    MAX_EVENTS,
    Cursor,
    Playhead,
    drawing,
    encode,
    envelope_message,
    largest_strain_per_newton,
)
from tipforce_tools.view.model import Model
from tipforce_tools.view.sources import Source

Milliseconds = Annotated[float, msgspec.Meta(ge=0.0, le=9e12)]
"""Since 1970."""
BinWidth = Annotated[float, msgspec.Meta(ge=0.5, le=3.6e6)]
"""Milliseconds."""
_taring = threading.Lock()


class Request(msgspec.Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower, kw_only=True):
    """Every response carries the ``id`` of its request."""

    id: int = 0

    def answer(self, source: Source, read_only: str) -> Any:
        """Return the response. ``read_only``: why this page must not write; empty if it may. Raises TipforceError."""
        raise NotImplementedError


class Setup(Request):
    """Get the fingers, the permissions, and the present picture."""

    def answer(self, source: Source, read_only: str) -> Any:
        """See Request."""
        model = source.model
        return {
            "title": source.title, "live": model.live, "generation": model.generation,
            "fingers": [drawing(finger, model.gauges) for finger in model.fingers],
            "gauges": model.gauges, "no_tare": source.no_tare or read_only, "events": model.events()[-MAX_EVENTS:],
            "picture": model.picture(), "scale": _scale(model),
        }  # fmt: skip


class At(Request):
    """Get the picture of a moment, and the events of a log up to then."""

    t: Milliseconds

    def answer(self, source: Source, read_only: str) -> Any:  # noqa: ARG002
        """See Request."""
        picture = source.model.picture(_ns(self.t))
        if not source.model.live:
            picture.events = source.model.events(0, _ns(self.t))[-MAX_EVENTS:]
        return picture


class History(Request):
    """Get bins of the past."""

    start: Milliseconds
    end: Milliseconds
    bin: BinWidth
    what: Charted = "contact"

    def answer(self, source: Source, read_only: str) -> Any:  # noqa: ARG002
        """See Request. Raises InputError for too many bins."""
        width_ns = _ns(self.bin)
        first, last = _ns(self.start) // width_ns, _ns(self.end) // width_ns
        if not 0 <= last - first <= MAX_BINS:
            raise InputError(f"start, end, bin: {last - first} bins, allowed are 0 to {MAX_BINS}")
        return envelope_message(source.model.envelope(first, last, width_ns, self.what))


class Stream(Request):
    """Stream pictures from now, or from ``start`` at ``speed``, each as a response. Ends the previous stream."""

    bin: BinWidth = 20.0
    start: Milliseconds | None = None
    speed: float = 1.0
    after: int = 0
    """Number of the last event known to the page."""
    what: Charted = "contact"
    """Quantities of the bins."""

    def cursor(self, model: Model) -> Cursor:
        """Return the position of a page in the stream. Raises InputError for a speed that is not allowed."""
        playhead = Playhead(model, None if self.start is None else _ns(self.start), self.speed)
        return Cursor(model, playhead, _ns(self.bin), self.after, self.what)


class Pause(Request):
    """End the stream."""


class Csv(Request):
    """Get all rows of the buffer, in binary messages before the response."""


class Tare(Request):
    """Tare a finger."""

    node_id: int

    def answer(self, source: Source, read_only: str) -> Any:
        """See Request. Raises also the errors of the source."""
        if source.no_tare or read_only:
            raise RefusedError(source.no_tare or read_only)
        if self.node_id not in {finger.node_id for finger in source.model.fingers}:
            raise InputError(f"node-id {self.node_id}: no finger of this page")
        with _taring:  # one at a time
            return {"text": source.tare(self.node_id)}


def decoded(text: str | bytes) -> Setup | At | History | Stream | Pause | Csv | Tare:
    """Decode the request in a message. Raises InputError."""
    try:
        return msgspec.json.decode(text, type=Setup | At | History | Stream | Pause | Csv | Tare)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(str(error)) from None


def reply(request_id: int, answer: Any) -> bytes:
    """Encode a response."""
    return encode({"id": request_id, "answer": answer})


def refusal(request_id: int, text: str) -> bytes:
    """Encode an error."""
    return encode({"id": request_id, "error": text})


def _scale(model: Model) -> dict[str, float]:
    """Return the full scales of force and strain: those of a log's rows; of a live page at least the usual ones."""
    least = (5.0, 500.0) if model.live else (0.5, 50.0)
    P, strain = model.largest()
    expected = P * max((largest_strain_per_newton(finger.geometry) for finger in model.fingers), default=0.0)
    return {"newtons": _nice(max(P, least[0])), "microstrain": _nice(max(strain, expected, least[1]))}


def _nice(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at least ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(float(k * power) for k in (1, 2, 5, 10) if k * power >= value * (1 - 1e-6))


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)
