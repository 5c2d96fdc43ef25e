"""The requests that a page sends over its WebSocket, as JSON, and their answers. No socket inside."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from tipforce.errors import InputError, RefusedError
from tipforce_tools.view.fingers import drawing
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
    """Every answer carries the ``id`` of its request."""

    id: int = 0


class Setup(Request):
    """The fingers, what is permitted, and the picture of now."""


class At(Request):
    """The picture of a moment."""

    t: Milliseconds


class History(Request):
    """Bins of the past."""

    start: Milliseconds
    end: Milliseconds
    bin: BinWidth


class Stream(Request):
    """Pictures from now on, or from ``start`` at ``speed``; each is an answer. It ends the stream before."""

    bin: BinWidth = 20.0
    start: Milliseconds | None = None
    speed: float = 1.0
    after: int = 0
    """Number of the last event that the page has."""


class Pause(Request):
    """End the stream."""


class Csv(Request):
    """All rows that are kept, in binary messages before the answer."""


class Tare(Request):
    """Tare a finger."""

    node_id: int


def decoded(text: str | bytes) -> Setup | At | History | Stream | Pause | Csv | Tare:
    """The request in a message. Raises InputError."""
    try:
        return msgspec.json.decode(text, type=Setup | At | History | Stream | Pause | Csv | Tare)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(str(error)) from None


def reply(request_id: int, answer: Any) -> bytes:
    """An answer as it is sent."""
    return encode({"id": request_id, "answer": answer})


def refusal(request_id: int, text: str) -> bytes:
    """An error as it is sent."""
    return encode({"id": request_id, "error": text})


def setup(source: Source, read_only: str) -> dict[str, Any]:
    """``read_only``: why this page must not write; empty where it may."""
    model = source.model
    return {
        "title": source.title, "live": model.live, "generation": model.generation,
        "fingers": [drawing(finger, model.gauges) for finger in model.fingers],
        "no_tare": source.no_tare or read_only, "events": events_message(model),
        "picture": picture_message(model, model.picture()),
    }  # fmt: skip


def moment(model: Model, request: At) -> dict[str, Any]:
    """The picture at a time, and the events of a log up to then."""
    found = picture_message(model, model.picture(_ns(request.t)))
    if not model.live:
        found["events"] = events_message(model, _ns(request.t))
    return found


def history(model: Model, request: History) -> dict[str, Any]:
    """The bins from ``start`` to ``end``. Raises InputError for too many."""
    width_ns = _ns(request.bin)
    first, last = _ns(request.start) // width_ns, _ns(request.end) // width_ns
    if not 0 <= last - first <= MAX_BINS:
        raise InputError(f"start, end, bin: {last - first} bins, allowed are 0 to {MAX_BINS}")
    return envelope_message(model.envelope(first, last, width_ns))


def cursor(model: Model, request: Stream) -> Cursor:
    """The place of a page in the stream. Raises InputError for a speed that is not allowed."""
    playhead = Playhead(model, None if request.start is None else _ns(request.start), request.speed)
    return Cursor(model, playhead, _ns(request.bin), request.after)


def tare(source: Source, read_only: str, request: Tare) -> dict[str, str]:
    """Tare. Raises InputError and RefusedError, and what the source raises."""
    if source.no_tare or read_only:
        raise RefusedError(source.no_tare or read_only)
    if request.node_id not in {finger.node_id for finger in source.model.fingers}:
        raise InputError(f"node-id {request.node_id}: no finger of this page")
    return {"text": source.tare(request.node_id)}


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)
