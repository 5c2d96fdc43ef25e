"""JSON requests that a page sends over its WebSocket, and their responses. Independent of sockets."""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec

from tipforce.errors import InputError, RefusedError
from tipforce_tools.view.fingers import drawing, largest_strain_per_newton
from tipforce_tools.view.history import Charted
from tipforce_tools.view.messages import (
    MAX_BINS,
    Cursor,
    Playhead,
    encode,
    envelope_message,
    events_message,
    picture_message,
)
from tipforce_tools.view.model import Model
from tipforce_tools.view.sources import Source

Milliseconds = Annotated[float, msgspec.Meta(ge=0.0, le=9e12)]
"""Since 1970."""
BinWidth = Annotated[float, msgspec.Meta(ge=0.5, le=3.6e6)]
"""Milliseconds."""


class Request(msgspec.Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower, kw_only=True):
    """Every response carries the ``id`` of its request."""

    id: int = 0


class Setup(Request):
    """Get the fingers, the permissions, and the present picture."""


class At(Request):
    """Get the picture of a moment."""

    t: Milliseconds


class History(Request):
    """Get bins of the past."""

    start: Milliseconds
    end: Milliseconds
    bin: BinWidth
    what: Charted = "contact"


class Stream(Request):
    """Stream pictures from now, or from ``start`` at ``speed``, each as a response. Ends the previous stream."""

    bin: BinWidth = 20.0
    start: Milliseconds | None = None
    speed: float = 1.0
    after: int = 0
    """Number of the last event known to the page."""
    what: Charted = "contact"
    """Quantities of the bins."""


class Pause(Request):
    """End the stream."""


class Csv(Request):
    """Get all rows of the buffer, in binary messages before the response."""


class Tare(Request):
    """Tare a finger."""

    node_id: int


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


def setup(source: Source, read_only: str) -> dict[str, Any]:
    """``read_only``: why this page must not write; empty if it may."""
    model = source.model
    return {
        "title": source.title, "live": model.live, "generation": model.generation,
        "fingers": [drawing(finger, model.gauges) for finger in model.fingers],
        "gauges": model.gauges, "no_tare": source.no_tare or read_only, "events": events_message(model),
        "picture": picture_message(model, model.picture()), "scale": _scale(model),
    }  # fmt: skip


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


def moment(model: Model, request: At) -> dict[str, Any]:
    """Return the picture at a time, and the events of a log up to then."""
    found = picture_message(model, model.picture(_ns(request.t)))
    if not model.live:
        found["events"] = events_message(model, _ns(request.t))
    return found


def history(model: Model, request: History) -> dict[str, Any]:
    """Return the bins from ``start`` to ``end``. Raises InputError for too many."""
    width_ns = _ns(request.bin)
    first, last = _ns(request.start) // width_ns, _ns(request.end) // width_ns
    if not 0 <= last - first <= MAX_BINS:
        raise InputError(f"start, end, bin: {last - first} bins, allowed are 0 to {MAX_BINS}")
    return envelope_message(model.envelope(first, last, width_ns, request.what))


def cursor(model: Model, request: Stream) -> Cursor:
    """Return the position of a page in the stream. Raises InputError for a speed that is not allowed."""
    playhead = Playhead(model, None if request.start is None else _ns(request.start), request.speed)
    return Cursor(model, playhead, _ns(request.bin), request.after, request.what)


def tare(source: Source, read_only: str, request: Tare) -> dict[str, str]:
    """Tare. Raises InputError and RefusedError, and the errors of the source."""
    if source.no_tare or read_only:
        raise RefusedError(source.no_tare or read_only)
    if request.node_id not in {finger.node_id for finger in source.model.fingers}:
        raise InputError(f"node-id {request.node_id}: no finger of this page")
    return {"text": source.tare(request.node_id)}


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)
