"""Rows to consumers: each gets all from the moment it asks, a slow one loses the oldest and is told."""

import asyncio
import pickle
import threading
from collections.abc import Sequence

import pytest

from tipforce.errors import InputError, TipforceError
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.host.hand import rows as module
from tipforce.host.hand.events import Event
from tipforce.host.hand.rows import Delivery, HandRow
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.samples.reasons import NO_RESPONSE
from tipforce.samples.record import Rows, missing_contact
from tipforce.watching.feeds import Finger, FrameFeed
from tipforce.watching.frame_sources import FrameSource


def block(first: int, count: int = 1) -> Rows:
    return Rows(first, [(first + k, 0, [0], [0], [1]) for k in range(count)], (1,), ())


def whole(rows: Rows) -> tuple[Rows]:
    return (rows,)


def test_two_consumers_get_all_from_when_they_asked() -> None:
    delivery = Delivery()
    delivery.put(block(0))
    first = delivery.rows(whole)
    delivery.put(block(1))
    second = delivery.rows(whole)
    delivery.put(block(2))
    delivery.close()
    assert [rows.first for rows in first] == [1, 2]
    assert [rows.first for rows in second] == [2]


def test_a_consumer_waits_and_gives_up_after_its_time() -> None:
    delivery = Delivery()
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.extend(rows.first for rows in delivery.rows(whole)))
    thread.start()
    while not delivery._streams:
        pass
    for k in range(50):
        delivery.put(block(k))
    delivery.close()
    thread.join(10)
    assert found == list(range(50))
    assert list(Delivery().rows(whole, 0.01)) == []


def test_a_slow_consumer_loses_the_oldest_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_ROWS", 10)
    delivery = Delivery()
    rows = delivery.rows(whole)
    for k in range(5):
        delivery.put(block(4 * k, 4))
    assert delivery.overrun == 12
    delivery.close()
    assert [one.first for one in rows] == [12, 16]
    assert delivery.overrun == 12


def test_asyncio() -> None:
    delivery = Delivery()

    async def consume() -> list[int]:
        found = []
        async for rows in delivery.rows(whole):
            found.append(rows.first)
            if len(found) == 20:
                delivery.close()
        return found

    async def main() -> list[int]:
        task = asyncio.create_task(consume())
        await asyncio.sleep(0)
        thread = threading.Thread(target=lambda: list(map(delivery.put, map(block, range(20)))))
        thread.start()
        return await asyncio.wait_for(task, 10)

    assert asyncio.run(main()) == list(range(20))


def test_a_failure_of_the_producer_reaches_everyone() -> None:
    delivery = Delivery()
    rows = delivery.rows(whole)
    delivery.put(block(0))
    delivery.close(RuntimeError("the thread has ended"))
    assert next(rows).first == 0
    with pytest.raises(RuntimeError, match="has ended"):
        next(rows)


def test_a_callback_that_raises_is_reported_once_and_the_others_are_called() -> None:
    delivery, seen = Delivery(), []

    def broken(rows: Rows) -> None:
        raise ValueError(f"row {rows.first}")

    def broken_too(event: Event) -> None:
        raise KeyError(event.kind)

    delivery.row_callbacks += [broken, lambda rows: seen.append(rows.first)]
    delivery.event_callbacks.append(broken_too)
    for k in range(3):
        delivery.put(block(k))
    assert seen == [0, 1, 2]
    events = delivery.take_events()
    assert delivery.take_events() == []
    assert [event.kind for event in events] == ["callback_failed"] * 2
    assert any("broken raised ValueError: row 0" in event.text for event in events)
    delivery.event(Event(0.0, 0, "bus_up", ""))
    assert [event.kind for event in delivery.take_events()] == ["bus_up"]


class _Source(FrameSource):
    """Gives these in turn: frames, or an error."""

    def __init__(self, *given: FrameArray | TipforceError) -> None:
        super().__init__(lambda: None)
        self._given = iter(given)

    def _take(self, _timeout_s: float) -> tuple[FrameArray, Sequence[str]]:
        item = next(self._given)
        if isinstance(item, TipforceError):
            raise item
        return item, ()


def test_an_error_of_a_bus_costs_no_frame_that_came_before_it() -> None:
    frames = frame_array([(1, 0x185, bytes(8))])
    feed = FrameFeed(_Source(frames, frames, InterfaceDownError("unplugged"), frames, InputError("a bad line")), Finger)
    assert feed.take(0.0) == ([], [])
    assert feed.frames == 2
    assert [event.kind for event in feed.take(0.0)[1]] == ["bus_down"]
    assert [event.kind for event in feed.take(0.0)[1]] == ["bus_up"]
    assert feed.frames == 3
    with pytest.raises(InputError, match="a bad line"):
        feed.take(0.0)


def test_a_row_in_another_process_has_the_same_contacts() -> None:
    contacts = [missing_contact(node_id, 5, NO_RESPONSE, name) for node_id, name in ((1, "thumb"), (2, "index"))]
    row = pickle.loads(pickle.dumps(HandRow(7, 5e-9, contacts)))
    assert (row.number, list(row), len(row), row["thumb"].node_id) == (7, ["thumb", "index"], 2, 1)
    assert row[2].name == "index"
    with pytest.raises(KeyError, match=r"'ring': the hand has thumb \(1\), index \(2\)"):
        row["ring"]
