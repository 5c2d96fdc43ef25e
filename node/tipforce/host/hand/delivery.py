"""Pass rows and events from the receiving thread to consumers without waiting for them."""

from __future__ import annotations

import asyncio
import threading
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import TypeVar

from tipforce.host.hand.events import Event
from tipforce.host.hand.rows import Rows

T = TypeVar("T")

MAX_ROWS, MAX_EVENTS = 100_000, 10_000
_STEP_S = 0.2  # a wait without end could not be interrupted on Windows


class RowStream(Iterator[Rows], AsyncIterator[Rows]):
    """Blocks of rows for one consumer, from its creation on; the oldest are dropped beyond MAX_ROWS.

    It ends with the delivery, or after ``timeout_s`` without rows (None: never; not with ``async for``).
    """

    def __init__(self, delivery: Delivery, timeout_s: float | None) -> None:
        self._delivery, self._timeout_s = delivery, timeout_s
        self._blocks: deque[Rows] = deque()
        self._waiting = 0
        self.wake: Callable[[], object] = lambda: None
        """Called after each change, with the lock of the delivery."""

    def put(self, rows: Rows) -> int:
        """Add a block; return how many rows were dropped."""
        dropped = 0
        self._blocks.append(rows)
        self._waiting += len(rows)
        while self._waiting > MAX_ROWS:
            dropped += len(self._take())
        return dropped

    def _take(self) -> Rows:
        rows = self._blocks.popleft()
        self._waiting -= len(rows)
        return rows

    def __next__(self) -> Rows:
        """Return the next block. Raises StopIteration, or the error that ended the delivery."""
        end_s = None if self._timeout_s is None else time.monotonic() + self._timeout_s
        with self._delivery.changed:
            while not self._blocks and not self._delivery.closed:
                left_s = _STEP_S if end_s is None else end_s - time.monotonic()
                if left_s <= 0:
                    break
                self._delivery.changed.wait(min(left_s, _STEP_S))
            if self._blocks:
                return self._take()
        raise self._delivery.end(self) or StopIteration

    async def __anext__(self) -> Rows:
        """Return the next block; the event loop runs meanwhile."""
        loop, ready = asyncio.get_running_loop(), asyncio.Event()
        self.wake = lambda: loop.is_closed() or loop.call_soon_threadsafe(ready.set)
        while True:
            ready.clear()
            with self._delivery.changed:
                if self._blocks:
                    return self._take()
                if self._delivery.closed:
                    raise self._delivery.end(self) or StopAsyncIteration
            await ready.wait()


class Delivery:
    """One producer, any number of consumers. A consumer gets all rows from its request on."""

    def __init__(self) -> None:
        self.row_callbacks: list[Callable[[Rows], None]] = []
        self.event_callbacks: list[Callable[[Event], None]] = []
        self.changed = threading.Condition()
        self.closed = False
        self.error: BaseException | None = None
        """The error that ended the delivery."""
        self.overrun = 0
        """Rows dropped because consumers were too slow."""
        self._streams: weakref.WeakSet[RowStream] = weakref.WeakSet()
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._failed: list[Callable[..., None]] = []

    def rows(self, timeout_s: float | None = None) -> RowStream:
        """Return blocks of rows from now on."""
        stream = RowStream(self, timeout_s)
        with self.changed:
            self._streams.add(stream)
        return stream

    def end(self, stream: RowStream) -> BaseException | None:
        """Deliver no more to a stream; return the error that ended the delivery."""
        with self.changed:
            self._streams.discard(stream)
        return self.error

    def put(self, rows: Rows) -> None:
        """Deliver a block of rows."""
        for callback in self.row_callbacks:
            self._call(callback, rows)
        with self.changed:
            self.overrun += sum(one.put(rows) for one in self._streams)
            self._wake()

    def close(self, error: BaseException | None = None) -> None:
        """End the delivery; an error is raised by every consumer."""
        with self.changed:
            self.closed, self.error = True, self.error or error
            self._wake()

    def _wake(self) -> None:
        self.changed.notify_all()
        for one in self._streams:
            one.wake()

    def event(self, event: Event) -> None:
        """Deliver an event."""
        with self.changed:
            self._events.append(event)
        for callback in self.event_callbacks:
            self._call(callback, event)

    def _call(self, callback: Callable[[T], None], argument: T) -> None:
        """Call a callback; one that raises is reported once, and called again: reception goes on."""
        try:
            callback(argument)
        except Exception as error:
            if callback in self._failed:
                return
            self._failed.append(callback)
            name = getattr(callback, "__qualname__", repr(callback))
            text = f"{name} raised {type(error).__name__}: {error}; further errors of it are not reported"
            self.event(Event(time.monotonic(), 0, "callback_failed", text))

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        with self.changed:
            events = list(self._events)
            self._events.clear()
        return events
