"""One page on its WebSocket: its JSON requests and their responses, and its stream of pictures and events."""

import asyncio
import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from canopen_device.visible_text import visible
from tipforce.errors import InputError, RefusedError, TipforceError
from tipforce.samples.reasons import NO_ANSWER
from tipforce.sensor.structure.layouts import GAUGE_LENGTH_M
from tipforce.sensor.structure.strain import Gauge, GaugePosition, Geometry, gauge_name, place, strain_row
from tipforce.watching.feeds import Finger
from tipforce_tools.page.model import Charted, Model, Picture
from tipforce_tools.page.sources import Source

MAX_BINS = 1500
"""Limit per message: a browser that reconnects late gets the newest ones."""
MAX_EVENTS = 200
SPEEDS = 0.05, 50.0
_BIN_DIGITS = 4
_ROWS = 200
_PAUSE_S = 0.002


class Cursor:
    """Position of one browser in the stream: the present, or a moment that advances from ``start_ns`` at ``speed``. A
    late browser gets all missed rows as envelopes, in one message: there is no queue."""

    def __init__(
        self, model: Model, bin_ns: int, start_ns: int | None = None, speed: float = 1.0, after_event: int = 0,
        what: Charted = "contact", clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise InputError(f"speed {speed:g}: allowed are {SPEEDS[0]:g} to {SPEEDS[1]:g}")
        self._model, self._start_ns, self._speed, self._clock = model, start_ns, speed, clock
        self._begun_s = clock()
        self._bin_ns, self._what, self._event = bin_ns, what, after_event
        self._bin = self.now_ns()[0] // bin_ns

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

    def message(self) -> Picture:
        """Return the next message; the last one has ended."""
        model = self._model
        now_ns, ended = self.now_ns()
        last = now_ns // self._bin_ns
        first = max(self._bin, last - MAX_BINS + 1)
        # The last bin is not complete: it is sent again.
        self._bin = last
        bins = envelope_message(model, first, last, self._bin_ns, self._what)
        picture = model.picture(now_ns)  # after the bins: its generation is never older than their columns
        picture.bins = bins
        live = model.live and now_ns >= model.span_ns()[1]
        picture.events = model.events(self._event, None if live else now_ns)[-MAX_EVENTS:] or None
        if picture.events:
            self._event = picture.events[-1].number
        picture.ended = ended
        return picture


def envelope_message(model: Model, first: int, last: int, width_ns: int, what: Charted) -> dict[str, Any]:
    """Encode bins, each with k x (3 q + 1) numbers: low, high and u of q quantities, and the number of unknown rows."""
    index, values = model.envelope(first, last, width_ns, what)
    rows = np.round(values, _BIN_DIGITS).reshape(len(values), values.shape[1] * values.shape[2])
    return {"i": index.tolist(), "v": rows.tolist()}


def csv_chunks(model: Model) -> Iterator[bytes]:
    """Yield all rows of the buffer, oldest first. Empty cell: unknown value; status is 2120h, empty if missing. Raises
    InputError where the fingers change."""
    fingers, (start_ns, end_ns) = model.fingers, model.span_ns()
    strains = ",".join(f"SG{k + 1}_ue" for k in range(model.gauges))
    yield f"t_s,node_id,name,P_N,phi_deg,theta_deg,u_P_N,u_phi_deg,u_theta_deg,{strains},status\n".encode()
    heads = [f"{finger.node_id},{_quoted(finger.name)}," for finger in fingers]
    after_ns = start_ns - 1
    while True:
        block = model.rows_after(after_ns, _ROWS, end_ns)
        if not len(block):
            return
        if block.status.shape[1] != len(fingers):
            raise InputError("a finger was found meanwhile: request the rows again")
        after_ns = int(block.t_ns[-1])
        lines = []
        parts = zip(
            block.t_ns.tolist(), block.contact.tolist(), block.u.tolist(), block.gauges.tolist(),
            block.status.tolist(), strict=True,
        )  # fmt: skip
        for t_ns, contact, u, gauges, status in parts:
            t = f"{t_ns // 1_000_000_000}.{t_ns % 1_000_000_000:09d},"
            for k, head in enumerate(heads):
                values = (*contact[k], *u[k], *gauges[k])
                cells = ["" if math.isnan(value) else f"{value:.6g}" for value in values]
                flags = "" if status[k] & NO_ANSWER else f"{status[k] & 0xFF}"
                lines.append(f"{t}{head}{','.join(cells)},{flags}\n")
        yield "".join(lines).encode()
        time.sleep(_PAUSE_S)


def _quoted(text: str) -> str:
    """Return a name as a cell. A name that begins like a formula gets a quote, so that no spreadsheet evaluates it."""
    if text[:1] in ("=", "+", "-", "@"):
        text = "'" + text
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text


MM = 1e3


def drawing(finger: Finger, gauges: int) -> dict[str, Any]:
    """Return the drawing of a finger: lengths in mm, x to the right, y from the axis of the horizontal beam upwards.
    ``faces``: microstrain per newton of F1, F2, F3 at both ends of each face of each beam, linear between."""
    geometry = finger.geometry
    return {
        "node_id": finger.node_id, "label": visible(finger.label), "layout": finger.layout,
        "calibrated_here": finger.calibration is not None,
        "a": geometry.a_m * MM, "d": geometry.d_m * MM, "r": geometry.r_m * MM,
        "h1": geometry.h1_m * MM, "h2": geometry.h2_m * MM,
        "gauges": [_gauge(geometry, gauge) for gauge in finger.gauges[:gauges]],
        "faces": _faces(geometry),
    }  # fmt: skip


def _gauge(geometry: Geometry, gauge: Gauge) -> dict[str, Any]:
    """Return its name, both ends of its centre line on the beam's surface, and the outward direction."""
    spot = place(geometry, gauge)
    length_m = geometry.a_m if spot.beam == "H" else geometry.d_m
    begin = min(max(spot.position_m - 0.5 * GAUGE_LENGTH_M, 0.0), length_m - GAUGE_LENGTH_M)
    ends = begin * MM, (begin + GAUGE_LENGTH_M) * MM
    sign = -1.0 if spot.side == "left" else 1.0
    half_h1, half_h2 = 0.5 * geometry.h1_m * MM, 0.5 * geometry.h2_m * MM
    if spot.beam == "H":
        up = 1.0 if spot.face == "upper" else -1.0
        # Drawn beside the vertical beam; the beam model measures from its axis.
        shift = half_h2 if begin == 0.0 and up < 0 else 0.0
        (x0, x1), (y0, y1), out = [sign * (shift + s) for s in ends], (up * half_h1, up * half_h1), (0.0, up)
    else:
        (x0, x1), (y0, y1), out = (sign * half_h2, sign * half_h2), [-half_h1 - s for s in ends], (sign, 0.0)
    return {"name": gauge_name(gauge), "beam": spot.beam, "from": [x0, y0], "to": [x1, y1], "out": out}


def largest_strain_per_newton(geometry: Geometry) -> float:
    """Return the largest strain of a face, in microstrain, for 1 N of F1, F2 or F3."""
    return max(float(np.abs(face["microstrain_per_newton"]).max()) for face in _faces(geometry))


@lru_cache(maxsize=16)
def _faces(geometry: Geometry) -> list[dict[str, Any]]:
    faces = []
    for beam, side, face in _FACES:
        length_m = geometry.a_m if beam == "H" else geometry.d_m
        ends = [GaugePosition(beam, side, position, face) for position in (0.0, length_m)]
        rows = np.array([strain_row(geometry, *end) for end in ends]) * 1e6
        faces.append({"beam": beam, "side": side, "face": face, "microstrain_per_newton": rows.tolist()})
    return faces


_FACES: Sequence[tuple[Literal["H", "V"], Literal["left", "right"], Literal["lower", "upper"]]] = (
    ("H", "left", "lower"), ("H", "right", "lower"), ("H", "left", "upper"), ("H", "right", "upper"),
    ("V", "left", "lower"), ("V", "right", "lower"),
)  # fmt: skip


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
            bins = envelope_message(model, first, last, width_ns, request.what)
            return bins | {"generation": model.generation}
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
    next message holds everything that it missed (Cursor). ``read_only``: why it must not write."""

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
                except (TipforceError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
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
