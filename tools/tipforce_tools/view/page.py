"""One page on its WebSocket: requests and responses, and its stream of pictures."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from tipforce.errors import TipforceError
from tipforce_tools.view import requests
from tipforce_tools.view.messages import csv_chunks

if TYPE_CHECKING:
    from tipforce_tools.view.messages import Cursor
    from tipforce_tools.view.sources import Source

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
    """Serve the requests of one page. A page that reads slowly has one message in transit and delays only itself.

    Its next message holds everything that it missed (messages.Cursor). ``read_only``: why it must not write.
    """

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
                    request = requests.decoded(text)
                    request_id = request.id
                    await self._answer(request)
                except TipforceError as error:
                    await self._send(requests.refusal(request_id, str(error)))
        self._end_stream()

    async def _answer(self, request: requests.Request) -> None:
        match request:
            case requests.Stream():
                cursor = request.cursor(self._source.model)
                self._end_stream()
                self._streaming = asyncio.create_task(self._pictures(cursor, request.id))
                return
            case requests.Csv():
                answer: Any = await self._csv()
            case requests.Pause():
                self._end_stream()
                answer = {}
            case _:
                answer = await asyncio.to_thread(request.answer, self._source, self._read_only)
        await self._send(requests.reply(request.id, answer))

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
                    message, ended = cursor.message()
                    newest, sent_s = now_ns, time.monotonic()
                    await self._send(requests.reply(request_id, message))

    async def _csv(self) -> dict[str, int]:
        chunks, count = csv_chunks(self._source.model), 0
        while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
            await self._send(chunk, text=False)
            count += len(chunk)
        return {"bytes": count}

    async def _send(self, message: bytes, text: bool = True) -> None:
        """Send, and wait until the socket accepts the message. Drops a page that does not read."""
        try:
            async with asyncio.timeout(SEND_TIMEOUT_S):
                await self.socket.send(message, text=text)
        except TimeoutError:
            self.socket.transport.abort()
        self.taken_s = time.monotonic()
