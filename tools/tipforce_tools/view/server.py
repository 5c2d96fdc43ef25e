"""The page's HTTP server: static files, a moment, a part of the past, CSV, tare, and server-sent events.

One thread per request, at most MAX_CONNECTIONS. A browser that reads slowly holds up its own thread only: it has one
message on its way, and the next one has all that it missed (see frames.Cursor).
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from http.server import ThreadingHTTPServer
from importlib import resources
from typing import Any

from tipforce.errors import EnvironmentLackError
from tipforce_tools.view.guard import Guard
from tipforce_tools.view.handler import Handler
from tipforce_tools.view.sources import Source

_LOG = logging.getLogger(__name__)

FRAMES_A_SECOND = 33.0  # a browser sometimes gets two messages between two pictures: 30 shall be left
MAX_CONNECTIONS = 64
_PUMP_S = 1.0 / FRAMES_A_SECOND
_TYPES = {
    "html": "text/html; charset=utf-8", "js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
}  # fmt: skip


def static_files() -> dict[str, tuple[str, bytes]]:
    """What may be fetched, by its path: nothing else of the disk can be named."""
    found = {}
    for file in resources.files("tipforce_tools.view").joinpath("static").iterdir():
        kind = _TYPES.get(file.name.rpartition(".")[2])
        if kind is not None:
            found["/" if file.name == "index.html" else f"/{file.name}"] = kind, file.read_bytes()
    return found


class ViewServer:
    """Serves one source on one or more addresses until ``close``. Raises EnvironmentLackError for a port in use."""

    def __init__(self, source: Source, guard: Guard, addresses: tuple[str, ...], port: int = 0) -> None:
        self.source, self.guard = source, guard
        self.files = static_files()
        self.stopped = threading.Event()
        self.pumped = threading.Condition()
        """Told when rows may have come: the streams send then, each with what it has missed."""
        self.writing = threading.Lock()
        """One tare at a time."""
        self._servers: list[PageServer] = []
        self._threads = [threading.Thread(target=self._pump, name="view pump", daemon=True)]
        for address in addresses:
            try:
                server = PageServer(self, address, guard.port or port)
            except OSError as error:
                if self._servers:  # no IPv6 here, or the port is taken there
                    continue
                raise EnvironmentLackError(
                    f"{address} port {port}: {error.strerror or error}; --port 0 takes a free one"
                ) from error
            guard.port = server.server_address[1]
            self._servers.append(server)
            self._threads.append(threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True))

    @property
    def url(self) -> str:
        """What to open."""
        token = f"?token={self.guard.access_token}" if self.guard.access_token else ""
        return f"http://{self.guard.hosts[0]}:{self.guard.port}/{token}"

    def start(self) -> None:
        """Serve, in threads."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Serve no more."""
        self.stopped.set()
        for server in self._servers:
            server.shutdown()
            server.server_close()
        for thread in self._threads:
            thread.join(2.0)

    def _pump(self) -> None:
        due_s = time.monotonic()
        while not self.stopped.wait(max(due_s - time.monotonic(), 0.0)):
            due_s = max(due_s + _PUMP_S, time.monotonic() - _PUMP_S)  # a late one does not delay those after it
            try:
                self.source.pump()
            except Exception as error:
                # Nothing that is shown may look alive when nothing moves any more.
                self.source.model.error = f"{type(error).__name__}: {error}"
                _LOG.exception("the page's source failed")
                return
            with self.pumped:
                self.pumped.notify_all()


class PageServer(ThreadingHTTPServer):
    """One address of a ViewServer."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 32

    def __init__(self, view: ViewServer, address: str, port: int) -> None:
        self.view = view
        self.address_family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._slots = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__((address, port), Handler)

    def server_bind(self) -> None:
        """Without the look-up of the host's name that http.server does."""
        if self.address_family == socket.AF_INET6:
            self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = "tipforce", self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._slots.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._slots.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""
