"""The page's server: static files and a WebSocket for each page, in one thread of an asyncio loop. Beyond the limit of
connections, the one that has waited or read nothing for the longest is dropped; beyond a page's budget, its own."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import socket
import sys
import threading
import time
from functools import partial
from http import HTTPStatus
from importlib import resources
from typing import Any
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers, MultipleValuesError
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.protocol import Event

from tipforce.errors import EnvironmentLackError
from tipforce_tools.cli import common
from tipforce_tools.page.connection import Page, Pulse
from tipforce_tools.page.guard import COOKIE, SECURITY_HEADERS, Guard
from tipforce_tools.page.sources import Source

_LOG = logging.getLogger(__name__)

FRAMES_A_SECOND = 33.0  # a browser sometimes gets two messages between two pictures: at least 30 remain
MAX_PAGES = 64
MAX_OTHERS = 64
"""Connections that fetch a file, or have not sent a request."""
HANDSHAKE_S = 5.0
MAX_REQUEST = 4096  # bytes
MESSAGES_A_SECOND, MESSAGES_AT_ONCE = 100.0, 300.0
"""Budget of one page: frames of its requests, pings and pongs. Zooming with a wheel sends about 100 a second."""
SOCKET_PATH = "/live"
_PUMP_S = 1.0 / FRAMES_A_SECOND
_CLOSE_S = 2.0
_SLOW_S = 1.0
_SEND_BUFFER = 64 << 10  # bytes in the kernel for one page: its maximum backlog
_RECEIVE_BUFFER = 4 << 10  # bytes in the kernel for one connection: what it can make the server parse at once
_TYPES = {
    "html": "text/html; charset=utf-8", "js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
}  # fmt: skip


def static_files() -> dict[str, tuple[str, bytes]]:
    """Return the files that may be fetched, by path: no other file is reachable."""
    files = {}
    for file in resources.files("tipforce_tools.page").joinpath("static").iterdir():
        kind = _TYPES.get(file.name.rpartition(".")[2])
        if kind is not None:
            files["/" if file.name == "index.html" else f"/{file.name}"] = kind, file.read_bytes()
    return files


class Connection(ServerConnection):
    """A connection that ViewServer counts from its start, and that ends when it exceeds its budget of messages."""

    def __init__(self, view: ViewServer, *parts: Any, **options: Any) -> None:
        super().__init__(*parts, **options)
        self.view = view
        self._left, self._counted_s = MESSAGES_AT_ONCE, time.monotonic()
        self._ending: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See asyncio.Protocol."""
        super().connection_made(transport)
        self.view.count(self)

    def process_event(self, event: Event) -> None:
        """See websockets: the request of the handshake, then each frame, also those that it answers itself."""
        if self._ending is not None:
            return
        self.view.messages += 1
        now_s = time.monotonic()
        self._left = min(self._left + (now_s - self._counted_s) * MESSAGES_A_SECOND, MESSAGES_AT_ONCE) - 1.0
        self._counted_s = now_s
        if self._left >= 0.0:
            super().process_event(event)
            return
        self.view.refused += 1
        self.transport.pause_reading()
        allowed = f"allowed are {MESSAGES_A_SECOND:g} messages a second"
        self._ending = self.loop.create_task(self.close(CloseCode.POLICY_VIOLATION, allowed))


class ViewServer:
    """Serve one source on one or more addresses until ``close``. Raises EnvironmentLackError for a port in use."""

    def __init__(self, source: Source, guard: Guard, addresses: tuple[str, ...], port: int = 0) -> None:
        self.source, self.guard = source, guard
        self.files = static_files()
        self._stopped = threading.Event()
        self._sockets: list[socket.socket] = []
        self.pages: set[Page] = set()
        self.messages = self.refused = 0
        """Requests and frames of all connections so far; connections that were closed for too many."""
        self._others: dict[ServerConnection, None] = {}
        self.loop, self._ending, self._pulse = asyncio.new_event_loop(), asyncio.Event(), Pulse()
        self._pumping = threading.Thread(target=self._pump, name="view pump", daemon=True)
        self._serving = threading.Thread(target=self._run, name="view server", daemon=True)
        for address in addresses:
            family = socket.AF_INET6 if ":" in address else socket.AF_INET
            try:
                one = socket.create_server((address, guard.port or port), family=family, backlog=MAX_OTHERS)
            except OSError as error:
                if self._sockets:  # no IPv6 here, or the port is taken there
                    continue
                raise EnvironmentLackError(
                    f"{address} port {port}: {error.strerror or error}; --port 0 selects a free port"
                ) from error
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            guard.port = one.getsockname()[1]
            self._sockets.append(one)

    @property
    def url(self) -> str:
        """URL to open."""
        token = f"?token={self.guard.access_token}" if self.guard.access_token else ""
        return f"http://{self.guard.hosts[0]}:{self.guard.port}/{token}"

    def start(self) -> None:
        """Start serving, in threads."""
        self._serving.start()
        self._pumping.start()

    def close(self) -> None:
        """Stop serving."""
        self._stopped.set()
        self._pumping.join(2.0)
        self.loop.call_soon_threadsafe(self._ending.set)
        self._serving.join(2.0 * _CLOSE_S)

    def _run(self) -> None:
        self.loop.run_until_complete(self._serve())
        self.loop.run_until_complete(self.loop.shutdown_default_executor())
        self.loop.close()

    async def _serve(self) -> None:
        async with contextlib.AsyncExitStack() as stack:
            for one in self._sockets:
                server = serve(
                    self._talk, sock=one, create_connection=partial(Connection, self),  # type: ignore[arg-type]
                    process_request=self._respond,
                    process_response=lambda _connection, _request, response: response.headers.update(SECURITY_HEADERS),
                    server_header=None, compression=None,
                    open_timeout=HANDSHAKE_S, close_timeout=_CLOSE_S, max_size=MAX_REQUEST,
                )  # fmt: skip
                await stack.enter_async_context(server)
            await self._ending.wait()

    def count(self, connection: ServerConnection) -> None:
        """Accept a connection; the oldest that is not a page is dropped if there are too many."""
        if len(self._others) >= MAX_OTHERS:
            oldest = next(iter(self._others))
            del self._others[oldest]
            oldest.transport.abort()
        self._others[connection] = None

    async def _talk(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        self._others.pop(connection, None)
        if len(self.pages) >= MAX_PAGES:
            slowest = min(self.pages, key=lambda page: page.taken_s)
            if time.monotonic() - slowest.taken_s < _SLOW_S:
                await connection.close(CloseCode.TRY_AGAIN_LATER, f"allowed are {MAX_PAGES} pages")
                return
            slowest.socket.transport.abort()
            self.pages.remove(slowest)
        connection.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        page = Page(connection, self.source, self._pulse, self.guard.read_only(connection.request.headers))
        self.pages.add(page)
        try:
            await page.run()
        finally:
            self.pages.discard(page)

    def _respond(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a file, or a refusal; None if the WebSocket handshake may continue."""
        path, _, query = request.path.partition("?")
        token = parse_qs(query).get("token", [""])[-1]
        try:
            refusal = self.guard.check(request.headers, token)
        except MultipleValuesError as error:
            refusal = HTTPStatus.BAD_REQUEST, f"duplicate header {error}"
        if refusal is not None:
            return connection.respond(*refusal)
        if request.method not in ("GET", "HEAD"):
            return connection.respond(HTTPStatus.METHOD_NOT_ALLOWED, "allowed are GET and HEAD")
        if path == SOCKET_PATH:
            return None
        if path == "/" and token:  # it moves from the address to a cookie, so that the browser history does not show it
            headers = Headers({"Location": "/", "Content-Length": "0", "Connection": "close"})
            if self.guard.access_token:
                headers["Set-Cookie"] = f"{COOKIE}={self.guard.access_token}; HttpOnly; SameSite=Strict; Path=/"
            return Response(303, "See Other", headers)
        if path not in self.files:
            return connection.respond(HTTPStatus.NOT_FOUND, "no such file")
        kind, content = self.files[path]
        headers = Headers({"Content-Type": kind, "Content-Length": str(len(content)), "Connection": "close"})
        return Response(200, "OK", headers, content if request.method == "GET" else b"")

    def _pump(self) -> None:
        due_s = time.monotonic()
        while not self._stopped.wait(max(due_s - time.monotonic(), 0.0)):
            due_s = max(due_s + _PUMP_S, time.monotonic() - _PUMP_S)  # a late cycle does not delay the next
            try:
                self.source.pump()
            except Exception as error:
                # The page must not show values as live after the source has stopped.
                self.source.model.error = f"{type(error).__name__}: {error}"
                _LOG.exception("the page's source failed")
                return
            self.loop.call_soon_threadsafe(self._pulse.beat)


def serve_page(args: argparse.Namespace, source: Source, guard: Guard) -> int:
    """Serve the page of a source until Ctrl-C or SIGTERM."""
    server = ViewServer(source, guard, (args.host,) if args.host else ("127.0.0.1", "::1"), args.port)
    server.start()
    try:
        common.print_record({"url": server.url}, server.url)
        sys.stdout.flush()
        access = "read and tare" if guard.allow_writes and not source.no_tare else "read-only"
        common.note(f"{source.title}: {access}; Ctrl-C ends it")
        if args.open:
            import webbrowser

            webbrowser.open(server.url)
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return 0
    finally:
        server.close()
