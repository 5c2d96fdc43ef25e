"""One page on its WebSocket: its JSON requests and their responses, and its stream of pictures."""

import asyncio
import contextlib
import math
import threading
import time
from typing import Annotated, Any

import msgspec
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from tipforce.errors import InputError, RefusedError, TipforceError
from tipforce_tools.page.messages import (
    MAX_BINS,
    MAX_EVENTS,
    Cursor,
    csv_chunks,
    drawing,
    envelope_message,
    largest_strain_per_newton,
)
from tipforce_tools.page.model import Charted, Model
from tipforce_tools.page.sources import Source

Milliseconds = Annotated[float, msgspec.Meta(ge=0.0, le=9e12)]
"""Since 1970."""
BinWidth = Annotated[float, msgspec.Meta(ge=0.5, le=3.6e6)]
"""Milliseconds."""
_taring = threading.Lock()


class Request(msgspec.Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower, kw_only=True):
    """Every response carries the ``id`` of its request."""

    id: int = 0


class Setup(Request):
    """Get the fingers, the permissions, and the present picture."""


class At(Request):
    """Get the picture of a moment, and the events of a log up to then."""

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


AnyRequest = Setup | At | History | Stream | Pause | Csv | Tare


def answer(request: AnyRequest, source: Source, read_only: str) -> Any:
    """Return the response. ``read_only``: why this page must not write; empty if it may. Raises TipforceError."""
    model = source.model
    match request:
        case Setup():
            return {
                "title": source.title, "live": model.live, "generation": model.generation,
                "fingers": [drawing(finger, model.gauges) for finger in model.fingers],
                "gauges": model.gauges, "no_tare": source.no_tare or read_only, "events": model.events()[-MAX_EVENTS:],
                "picture": model.picture(), "scale": _scale(model), "loops": source.loops,
                "rest": None if source.rest_ns is None else source.rest_ns / 1e6, "python": source.python,
            }  # fmt: skip
        case At():
            picture = model.picture(_ns(request.t))
            if not model.live:
                picture.events = model.events(0, _ns(request.t))[-MAX_EVENTS:]
            return picture
        case History():
            width_ns = _ns(request.bin)
            first, last = _ns(request.start) // width_ns, _ns(request.end) // width_ns
            if not 0 <= last - first <= MAX_BINS:
                raise InputError(f"start, end, bin: {last - first} bins, allowed are 0 to {MAX_BINS}")
            return envelope_message(model, first, last, width_ns, request.what)
        case Tare():
            if source.no_tare or read_only:
                raise RefusedError(source.no_tare or read_only)
            if request.node_id not in {finger.node_id for finger in model.fingers}:
                raise InputError(f"node-id {request.node_id}: no finger of this page")
            with _taring:  # one at a time
                return {"text": source.tare(request.node_id)}
    return {}


def _scale(model: Model) -> dict[str, float]:
    """Return the full scales of force and strain: those of a log's rows; of a live page at least the usual ones."""
    least = (5.0, 500.0) if model.live else (0.5, 50.0)
    P, strain = model.largest()
    expected = 0.5 * P * max((largest_strain_per_newton(finger.geometry) for finger in model.fingers), default=0.0)
    return {"newtons": _nice(max(P, least[0])), "microstrain": _nice(max(strain, expected, least[1]))}


def _nice(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return next(float(k * power) for k in (1, 2, 5, 10) if k * power >= value * (1 - 1e-6))


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)


IDLE_S = 0.1
"""Period of time messages to a page when no row arrives."""
SEND_TIMEOUT_S = 20.0
"""A page that has read nothing for this time is dropped."""


class Pulse:
    """Wake every task that waits for the next rows."""

    def __init__(self) -> None:
        self._next = asyncio.Event()

    def beat(self) -> None:
        """Wake them."""
        self._next.set()
        self._next = asyncio.Event()

    async def wait(self, timeout_s: float) -> None:
        """Wait until the next beat, at most ``timeout_s``."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._next.wait()


class Page:
    """Serve the requests of one page. A page that reads slowly has one message in transit and delays only itself. Its
    next message holds everything that it missed (messages.Cursor). ``read_only``: why it must not write."""

    def __init__(self, socket: ServerConnection, source: Source, pulse: Pulse, read_only: str) -> None:
        self.socket, self._source, self._pulse, self._read_only = socket, source, pulse, read_only
        self.taken_s = time.monotonic()
        """Time of the last message that it read."""
        self._streaming: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """Serve until the page disconnects."""
        with contextlib.suppress(ConnectionClosed):
            async for text in self.socket:
                request_id = 0
                try:
                    request = msgspec.json.decode(text, type=AnyRequest)
                    request_id = request.id
                    await self._serve(request)
                except (TipforceError, msgspec.DecodeError, UnicodeDecodeError) as error:
                    await self._send({"id": request_id, "error": str(error)})
        self._end_stream()

    async def _serve(self, request: AnyRequest) -> None:
        if isinstance(request, Stream):
            start_ns = None if request.start is None else _ns(request.start)
            bin_ns, model = _ns(request.bin), self._source.model
            cursor = Cursor(model, bin_ns, start_ns, request.speed, request.after, request.what)
            self._end_stream()
            self._streaming = asyncio.create_task(self._pictures(cursor, request.id))
            return
        if isinstance(request, Pause):
            self._end_stream()
        if isinstance(request, Csv):
            content: Any = await self._csv()
        else:
            content = await asyncio.to_thread(answer, request, self._source, self._read_only)
        await self._send({"id": request.id, "answer": content})

    def _end_stream(self) -> None:
        if self._streaming is not None:
            self._streaming.cancel()
            self._streaming = None

    async def _pictures(self, cursor: Cursor, request_id: int) -> None:
        model, ended = self._source.model, False
        newest, sent_s = -1, 0.0
        with contextlib.suppress(ConnectionClosed):
            while not ended:
                await self._pulse.wait(IDLE_S)
                now_ns = model.span_ns()[1]
                if now_ns != newest or not model.live or time.monotonic() - sent_s >= IDLE_S:
                    picture = cursor.message()
                    ended, newest, sent_s = picture.ended, now_ns, time.monotonic()
                    await self._send({"id": request_id, "answer": picture})

    async def _csv(self) -> dict[str, int]:
        chunks, count = csv_chunks(self._source.model), 0
        while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
            await self._send(chunk)
            count += len(chunk)
        return {"bytes": count}

    async def _send(self, message: dict[str, Any] | bytes) -> None:
        """Send JSON or bytes, and wait until the socket accepts them. Drops a page that does not read."""
        is_json = isinstance(message, dict)
        try:
            async with asyncio.timeout(SEND_TIMEOUT_S):
                await self.socket.send(msgspec.json.encode(message) if is_json else message, text=is_json)
        except TimeoutError:
            self.socket.transport.abort()
        self.taken_s = time.monotonic()
