"""Rows of a hand: made of its frames, delivered to consumers without waiting for them, and read one by one by name."""

from __future__ import annotations

import asyncio
import threading
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from tipforce.dictionary.signals import tpdo_messages
from tipforce.host.frames.frame_array import RawFrame
from tipforce.host.hand.events import Event
from tipforce.host.hand.trust import Trust
from tipforce.host.network.sdo import checked_time
from tipforce.samples.contact import Contact
from tipforce.samples.record import Row, RowContacts, Rows
from tipforce.samples.rows import RowAssembler

_MOST_OTHERS = 10_000
_new = object.__new__


class Collector(RowAssembler):
    """See RowAssembler; ``trust`` sees every frame that is neither an answer nor a SYNC, in the order of the bus.
    ``others``: the last of these frames, for the caller to take."""

    def __init__(
        self, node_ids: Sequence[int], messages: Sequence[str] = ("Contact",), gauges: int = 3,
        wait_s: float = 0.02, own_sync: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(node_ids, messages, gauges, wait_s, own_sync)
        health = next(message for message in tpdo_messages(gauges) if message.name == "Health")
        self.trust = Trust(self.node_ids, {can_id: k for can_id, (_, k, *_) in self._answers.items()}, health, gauges)
        self.lock, self.shown = self.trust.lock, self.trust.shown
        self.others: deque[RawFrame] = deque(maxlen=_MOST_OTHERS)

    def _other(self, t_ns: int, can_id: int, length: int, word: int, now_s: float) -> None:
        self.others.append((t_ns, can_id, word.to_bytes(8, "little")[: min(length, 8)]))
        if can_id in self.trust.ids:
            self.trust.note(can_id, length, word, now_s)


class HandRow(Mapping[str, Contact]):
    """The contacts of all fingers at one SYNC: ``row["thumb"]``, or by node-id ``row[1]``. A finger without an answer
    is included: its ``status`` is NO_ANSWER and its values are NaN."""

    __slots__ = ("_contacts", "_made", "_row", "number", "pairing", "t_s")
    number: int
    """Number of the row since the start of the hand."""
    t_s: float
    """Time of the SYNC, seconds of the epoch."""
    pairing: str
    """"numbered": each contact carries the number of this SYNC; "assumed": it came after this SYNC."""
    _contacts: Any
    _row: Row

    def __init__(self, number: int, t_s: float, contacts: Sequence[Contact], pairing: str = "numbered") -> None:
        self.number, self.t_s, self.pairing = number, t_s, pairing
        self._contacts = RowContacts([c.node_id for c in contacts], [c.name for c in contacts])
        self._made = dict(enumerate(contacts))

    def __getattr__(self, name: str) -> Any:
        """Make ``t_s`` and ``pairing`` of a row when they are first read."""
        if name == "t_s":
            self.t_s = self._row[0] * 1e-9
            return self.t_s
        if name == "pairing":
            self.pairing = "numbered" if self._row[1] else "assumed"
            return self.pairing
        raise AttributeError(f"HandRow has no {name!r}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and other processes get the values."""
        return HandRow, (self.number, self.t_s, self.contacts, self.pairing)

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """In the order of the hand file."""
        return tuple(self[finger] for finger in self._contacts.places if isinstance(finger, int))

    def __getitem__(self, finger: str | int) -> Contact:
        """Return the contact of a finger, by name or node-id. Raises KeyError, whose text names the fingers."""
        contacts, made = self._contacts, self._made
        place = contacts.places.get(finger)
        if place in made:
            return made[place]
        if place is None:
            known = ", ".join(f"{contact.name} ({contact.node_id})" for contact in self.contacts)
            raise KeyError(f"{finger!r}: the hand has {known}")
        contact: Contact = contacts.make(self._row, place)
        made[place] = contact
        return contact

    def __iter__(self) -> Iterator[str]:
        return (contact.name for contact in self.contacts)

    def __len__(self) -> int:
        return sum(isinstance(finger, int) for finger in self._contacts.places)

    def __str__(self) -> str:
        return " | ".join(f"{contact.name}: {contact}" for contact in self.contacts)


def rows_one_by_one(rows: Rows, contacts: RowContacts) -> list[HandRow]:
    """Return each row of a block; what is read of one is made when it is first read."""
    number, one_by_one = rows.first, []
    computed = [] if contacts.make and rows.pdos is contacts.pdos else contacts.computed(rows)
    for raw in rows.raw:
        row = _new(HandRow)
        row.number, row._row, row._contacts = number, raw, contacts
        row._made = computed[number - rows.first] if computed else {}
        one_by_one.append(row)
        number += 1
    return one_by_one


T = TypeVar("T")

MAX_ROWS, MAX_EVENTS = 100_000, 10_000
_STEP_S = 0.2  # a wait without end could not be interrupted on Windows


class HandRows(Iterator[T], AsyncIterator[T]):
    """Rows for one consumer, from its creation on, as ``convert`` makes them of each block; see ``Hand.rows``. The
    oldest are dropped beyond MAX_ROWS."""

    def __init__(self, delivery: Delivery, timeout_s: float | None, convert: Callable[[Rows], Iterable[T]]) -> None:
        self._timeout_s = None if timeout_s is None else checked_time("timeout_s", timeout_s)
        self._delivery, self._convert = delivery, convert
        self._blocks: deque[Rows] = deque()
        self._converted: deque[T] = deque()
        self._waiting = 0
        self.wake: Callable[[], object] = lambda: None
        """Called after each change, with the lock of the delivery."""

    def put(self, rows: Rows) -> int:
        """Add a block, with the lock of the delivery; return how many rows were dropped."""
        dropped = 0
        self._blocks.append(rows)
        self._waiting += len(rows)
        while self._waiting > MAX_ROWS:
            dropped += len(self._take())
        self.wake()
        return dropped

    def _take(self) -> Rows:
        rows = self._blocks.popleft()
        self._waiting -= len(rows)
        return rows

    def __next__(self) -> T:
        """Return the next of them. Raises StopIteration, or the error that ended the delivery."""
        if not self._converted:
            self._converted += self._convert(self._wait())
        return self._converted.popleft()

    def _wait(self) -> Rows:
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

    async def __anext__(self) -> T:
        """Return the next of them; the event loop runs meanwhile."""
        loop, ready = asyncio.get_running_loop(), asyncio.Event()
        self.wake = lambda: loop.is_closed() or loop.call_soon_threadsafe(ready.set)
        while not self._converted:
            ready.clear()
            with self._delivery.changed:
                rows = self._take() if self._blocks else None
                if rows is None and self._delivery.closed:
                    raise self._delivery.end(self) or StopAsyncIteration
            if rows is None:
                await ready.wait()
            else:
                self._converted += self._convert(rows)
        return self._converted.popleft()


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
        self._streams: weakref.WeakSet[HandRows[Any]] = weakref.WeakSet()
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._failed: list[Callable[..., None]] = []

    def rows(self, convert: Callable[[Rows], Iterable[T]], timeout_s: float | None = None) -> HandRows[T]:
        """Return what ``convert`` makes of each block from now on."""
        stream = HandRows(self, timeout_s, convert)
        with self.changed:
            self._streams.add(stream)
        return stream

    def end(self, stream: HandRows[Any]) -> BaseException | None:
        """Deliver no more to a stream; return the error that ended the delivery."""
        with self.changed:
            self._streams.discard(stream)
        return self.error

    def put(self, rows: Rows) -> None:
        """Deliver a block of rows."""
        for callback in self.row_callbacks:
            self._call(callback, rows)
        with self.changed:
            self.changed.notify_all()
            for stream in self._streams:
                self.overrun += stream.put(rows)

    def close(self, error: BaseException | None = None) -> None:
        """End the delivery; an error is raised by every consumer."""
        with self.changed:
            self.closed, self.error = True, self.error or error
            self.changed.notify_all()
            for stream in self._streams:
                stream.wake()

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
