"""Pass rows and events from the receiving thread to consumers without waiting for them."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import TypeVar

from tipforce.host.hand.events import Event
from tipforce.host.hand.rows import Rows

T = TypeVar("T")

MAX_ROWS, MAX_EVENTS = 100_000, 10_000
_STEP_S = 0.2  # interval at which a waiting consumer checks whether the hand has stopped


class Subscription:
    """Rows for one consumer; the oldest are dropped beyond MAX_ROWS."""

    def __init__(self) -> None:
        self.blocks: deque[Rows] = deque()
        self.waiting = 0
        self.overrun = 0

    def put(self, rows: Rows) -> None:
        """Add a block."""
        self.blocks.append(rows)
        self.waiting += len(rows)
        while self.waiting > MAX_ROWS:
            lost = len(self.blocks.popleft())
            self.waiting -= lost
            self.overrun += lost

    def take(self) -> Rows | None:
        """Return the oldest block."""
        if not self.blocks:
            return None
        rows = self.blocks.popleft()
        self.waiting -= len(rows)
        return rows


class Delivery:
    """One producer, any number of consumers. A consumer gets all rows from its request on."""

    def __init__(self) -> None:
        self.row_callbacks: list[Callable[[Rows], None]] = []
        self.event_callbacks: list[Callable[[Event], None]] = []
        self._changed = threading.Condition()
        self._subscriptions: list[Subscription] = []
        self._wakers: list[Callable[[], None]] = []
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._past_overrun = 0
        self._closed = False
        self._failed: list[Callable[..., None]] = []
        self._error: BaseException | None = None

    @property
    def error(self) -> BaseException | None:
        """The error that ended the delivery."""
        return self._error

    @property
    def overrun(self) -> int:
        """Rows dropped because consumers were too slow."""
        with self._changed:
            return self._past_overrun + sum(one.overrun for one in self._subscriptions)

    def put(self, rows: Rows) -> None:
        """Deliver a block of rows."""
        for callback in self.row_callbacks:
            self._call(callback, rows)
        with self._changed:
            for one in self._subscriptions:
                one.put(rows)
            self._changed.notify_all()
            wakers = list(self._wakers)
        for wake in wakers:
            wake()

    def event(self, event: Event) -> None:
        """Deliver an event."""
        with self._changed:
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
        with self._changed:
            events = list(self._events)
            self._events.clear()
        return events

    def fail(self, error: BaseException) -> None:
        """End with an error, which every consumer raises."""
        self._error = error
        self.close()

    def close(self) -> None:
        """End the delivery."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            wakers = list(self._wakers)
        for wake in wakers:
            wake()

    def rows(self, timeout_s: float | None = None) -> Iterator[Rows]:
        """Return blocks of rows from now on."""
        one = self._subscribe()  # now, not at the request for the first row
        return self._iterate(one, timeout_s)

    def _iterate(self, one: Subscription, timeout_s: float | None) -> Iterator[Rows]:
        try:
            deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
            while True:
                with self._changed:
                    rows = one.take()
                    if rows is None:
                        if self._closed or (deadline_s is not None and time.monotonic() >= deadline_s):
                            break
                        self._changed.wait(_STEP_S if timeout_s is None else min(_STEP_S, timeout_s))
                        continue
                yield rows
                deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        finally:
            self._unsubscribe(one)
        self._raise()

    async def rows_async(self) -> AsyncIterator[Rows]:
        """Yield blocks of rows from the first step on, for asyncio."""
        loop, ready = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(ready.set)

        one = self._subscribe()
        self._wakers.append(wake)
        try:
            while True:
                ready.clear()
                with self._changed:
                    rows, closed = one.take(), self._closed
                if rows is not None:
                    yield rows
                elif closed:
                    break
                else:
                    await ready.wait()
        finally:
            self._wakers.remove(wake)
            self._unsubscribe(one)
        self._raise()

    def _subscribe(self) -> Subscription:
        one = Subscription()
        with self._changed:
            self._subscriptions.append(one)
        return one

    def _unsubscribe(self, one: Subscription) -> None:
        with self._changed:
            self._past_overrun += one.overrun
            self._subscriptions.remove(one)

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error
