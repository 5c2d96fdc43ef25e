"""One request to the page's server: what is asked for, who may ask (guard.py), the answer."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import parse_qs, urlsplit

import msgspec

from tipforce.errors import InputError, TipforceError
from tipforce.toml_table import convert
from tipforce_tools.view.csv import csv_chunks
from tipforce_tools.view.fingers import drawing
from tipforce_tools.view.guard import COOKIE, SECURITY_HEADERS
from tipforce_tools.view.messages import (
    MAX_BINS,
    Cursor,
    Playhead,
    encode,
    envelope_message,
    events_message,
    picture_message,
)

if TYPE_CHECKING:
    from tipforce_tools.view.server import PageServer, ViewServer

IDLE_S = 0.1
"""How often a page is told the time when no row comes."""
MAX_BODY = 4096
CLIENT_TIMEOUT_S = 20.0
_SEND_BUFFER = 64 << 10  # bytes in the kernel for one browser: what it is behind at most


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "tipforce", ""
    timeout = CLIENT_TIMEOUT_S
    server: PageServer

    GETS: ClassVar[dict[str, str]] = {
        "/api/setup": "_setup", "/api/at": "_at", "/api/history": "_history", "/api/buffer.csv": "_csv",
        "/events": "_events",
    }  # fmt: skip

    @property
    def view(self) -> ViewServer:
        return self.server.view

    def log_message(self, format: str, *args: Any) -> None:
        """Quiet: the token may be in the first line."""

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        query = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        if self._refused("GET", query.get("token", "")):
            return
        try:
            if parts.path == "/" and "token" in query:
                self._enter()
            elif parts.path in self.GETS:
                getattr(self, self.GETS[parts.path])(query)
            elif parts.path in self.view.files:
                kind, content = self.view.files[parts.path]
                self._answer(HTTPStatus.OK, content, kind)
            else:
                self._say(HTTPStatus.NOT_FOUND, "there is no such thing here")
        except InputError as error:
            self._say(HTTPStatus.BAD_REQUEST, str(error))

    do_HEAD = do_GET

    def do_POST(self) -> None:
        if self._refused("POST", ""):
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MAX_BODY:
            self._say(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"allowed are {MAX_BODY} bytes")
        elif urlsplit(self.path).path != "/api/tare":
            self._say(HTTPStatus.NOT_FOUND, "there is no such thing here")
        else:
            self._tare(self.rfile.read(int(length)))

    # --- answers ----------------------------------------------------------------------------------------------

    def _refused(self, method: str, token: str) -> bool:
        once = all(len(self.headers.get_all(name, [])) <= 1 for name in ("Host", "Origin"))
        refusal = self.view.guard.check(method, dict(self.headers.items()), token)
        if refusal is None and once:
            return False
        self.close_connection = True
        self._say(
            refusal.status if refusal else HTTPStatus.BAD_REQUEST, refusal.text if refusal else "twice the same header"
        )
        return True

    def _enter(self) -> None:
        """The token goes from the address into a cookie, out of history and sight."""
        self.send_response(HTTPStatus.SEE_OTHER)
        if self.view.guard.access_token:
            value = f"{COOKIE}={self.view.guard.access_token}; HttpOnly; SameSite=Strict; Path=/"
            self.send_header("Set-Cookie", value)
        self.send_header("Location", "/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _setup(self, _query: dict[str, str]) -> None:
        source, guard = self.view.source, self.view.guard
        model = source.model
        no_tare = source.no_tare or ("" if guard.allow_writes else "read-only: start it with --allow-writes")
        self._json({
            "title": source.title, "live": model.live, "generation": model.generation, "gauges": model.gauges,
            "fingers": [drawing(finger, model.gauges) for finger in model.fingers],
            "no_tare": no_tare, "token": guard.write_token if not no_tare else "", "events": events_message(model),
            "picture": picture_message(model, model.picture()),
        })  # fmt: skip

    def _at(self, query: dict[str, str]) -> None:
        model, t_ns = self.view.source.model, _time_ns(query, "t")
        found = picture_message(model, model.picture(t_ns))
        if not model.live:
            found["events"] = events_message(model, t_ns)
        self._json(found)

    def _history(self, query: dict[str, str]) -> None:
        first_ns, last_ns, bin_ns = _time_ns(query, "from"), _time_ns(query, "to"), _bin_ns(query)
        first, last = first_ns // bin_ns, last_ns // bin_ns
        if not 0 <= last - first <= MAX_BINS:
            raise InputError(f"from, to, bin: {last - first} bins, allowed are 0 to {MAX_BINS}")
        self._json(envelope_message(self.view.source.model.envelope(first, last, bin_ns)))

    def _csv(self, _query: dict[str, str]) -> None:
        self._begin("text/csv; charset=utf-8", {"Content-Disposition": 'attachment; filename="tipforce.csv"'})
        if self.command != "HEAD":
            self._write_all(csv_chunks(self.view.source.model))

    def _events(self, query: dict[str, str]) -> None:
        model = self.view.source.model
        start_ns = _time_ns(query, "from") if "from" in query else None
        playhead = Playhead(model, start_ns, _number(query, "speed", 1.0))
        cursor = Cursor(model, playhead, _bin_ns(query), int(_number(query, "after", 0)))
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._begin("text/event-stream; charset=utf-8", {})
        if self.command != "HEAD":
            self._write_all(self._messages(cursor))

    def _messages(self, cursor: Cursor) -> Iterator[bytes]:
        model, ended = self.view.source.model, False
        newest, sent_s = -1, 0.0
        yield b"retry: 1000\n\n"
        while not ended and not self.view.stopped.is_set():
            with self.view.pumped:
                self.view.pumped.wait(IDLE_S)
            now = model.span_ns()[1]
            if now != newest or not model.live or time.monotonic() - sent_s >= IDLE_S:
                message, ended = cursor.message()
                newest, sent_s = now, time.monotonic()
                yield b"data: " + encode(message) + b"\n\n"

    def _tare(self, body: bytes) -> None:
        try:
            wanted = convert(_TareRequest, msgspec.json.decode(body), "tare")
            if wanted.node_id not in {finger.node_id for finger in self.view.source.model.fingers}:
                raise InputError(f"node-id {wanted.node_id}: no finger of this page")
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            self._say(HTTPStatus.BAD_REQUEST, f"tare: {error}")
            return
        except InputError as error:
            self._say(HTTPStatus.BAD_REQUEST, str(error))
            return
        if self.view.source.no_tare:
            self._say(HTTPStatus.FORBIDDEN, self.view.source.no_tare)
            return
        try:
            with self.view.writing:
                text = self.view.source.tare(wanted.node_id)
        except TipforceError as error:
            self._say(HTTPStatus.CONFLICT, str(error))
            return
        self._json({"text": text})

    # --- bytes ------------------------------------------------------------------------------------------------

    def _json(self, message: Any) -> None:
        self._answer(HTTPStatus.OK, encode(message), "application/json")

    def _say(self, status: HTTPStatus, text: str) -> None:
        self._answer(status, encode({"error": text}), "application/json")

    def _answer(self, status: HTTPStatus, content: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _begin(self, kind: str, headers: dict[str, str]) -> None:
        """An answer whose length nobody knows: it ends with the connection."""
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        for name, value in ({"Content-Type": kind, "Connection": "close"} | headers).items():
            self.send_header(name, value)
        self.end_headers()

    def _write_all(self, chunks: Iterator[bytes]) -> None:
        with suppress(OSError):  # the browser left, or has read nothing for CLIENT_TIMEOUT_S
            for chunk in chunks:
                self.wfile.write(chunk)

    def end_headers(self) -> None:
        for name, value in SECURITY_HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def send_error(self, code: int, message: str | None = None, _explain: str | None = None) -> None:
        """What http.server refuses itself (a bad request line, another method) looks as ours."""
        self.close_connection = True
        self.command = getattr(self, "command", None) or "GET"
        self._say(HTTPStatus(code), message or HTTPStatus(code).phrase)


class _TareRequest(msgspec.Struct, forbid_unknown_fields=True):
    node_id: int


def _number(query: dict[str, str], name: str, default: float | None = None) -> float:
    text = query.get(name, "")
    try:
        value = float(text) if text or default is None else default
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e15:
        raise InputError(f"{name} = {text!r}: allowed is a number")
    return value


def _time_ns(query: dict[str, str], name: str) -> int:
    """A time in milliseconds since 1970 (nine digits before the point suffice a float for microseconds)."""
    return round(min(max(_number(query, name), 0.0), 9e12) * 1e6)


def _bin_ns(query: dict[str, str]) -> int:
    width_ms = _number(query, "bin", 20.0)
    if not 0.5 <= width_ms <= 3.6e6:
        raise InputError(f"bin = {width_ms:g} ms: allowed are 0.5 to 3600000")
    return round(width_ms * 1e6)
