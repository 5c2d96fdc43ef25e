"""A whole hand that runs in its own threads on python-can's in-process bus; in simulated time: test_changes.py."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from host.bus_with_nodes import apply_load, beam_calibration, finger, new_channel, running
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand import recovery as module
from tipforce.host.hand.events import Event
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.host.hand.recovery import RecoveryQueue

WAIT_S = 60.0


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[Hand]:
    """Fingers 1 and 2, which a hand brought up and reads."""
    channel = new_channel()
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    file = HandFile(
        finger=tuple(FingerPlan(node_id=n, serial=n, calibration="cal.toml") for n in (1, 2)),
        hand=HandPlan(sync_hz=100.0, heartbeat_ms=50),
        bus={"interface": "virtual", "channel": channel},
        folder=str(tmp_path),
    )
    with running([finger(n, serial=n) for n in (1, 2)], channel), Hand(file) as hand:
        for n in (1, 2):
            apply_load(hand.connection, n, 1.0 + n, 0.0, 0.0)
        assert [str(report) for report in hand.bring_up()] == ["finger 1: up", "finger 2: up"]
        hand.start()
        yield hand


def until(condition: Callable[[], object]) -> None:
    """Wait for it."""
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.001)


def test_every_sync_gives_a_row_with_every_finger(hand: Hand) -> None:
    whole, number = 0, None
    for rows in hand.blocks(WAIT_S):
        assert number in (None, rows.first)
        number = rows.first + len(rows)
        known = rows.columns["P"][~rows.missing.any(axis=1) & ~rows.columns["stale"].any(axis=1)]
        assert known == pytest.approx(np.tile([2.0, 3.0], (len(known), 1)), abs=5e-3)
        whole = 0 if rows.missing.any() else whole + len(rows)
        if whole >= 30:  # a busy machine may lose some at the start
            break
    statistics = hand.statistics()
    assert statistics.tally.rows >= whole
    assert statistics.tally.mixed.tolist() == [0, 0]
    assert (statistics.dropped, statistics.overrun) == (0, 0)
    assert statistics.sync.periods >= whole - 1
    assert hand.settled()
    with pytest.raises(InputError, match="already started"):
        hand.start()
    iterator = hand.blocks()
    hand.stop()
    assert sum(1 for _ in iterator) < 1000


def test_a_dead_receiver_is_an_event(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[Event] = []
    hand.on_event(events.append)
    monkeypatch.setattr("threading.excepthook", lambda _args: None)

    def broken(_timeout_s: float) -> None:
        raise ZeroDivisionError("receiver")

    monkeypatch.setattr(hand._link, "receive", broken)
    until(lambda: any(event.kind == "failed" for event in events))
    assert not hand.settled()
    assert hand.state(1) == "unknown: reception has ended"
    assert "ended: ZeroDivisionError" in next(event.text for event in events if event.kind == "failed")


# --- the recovery queue ---------------------------------------------------------------------------------------------


def wait_until_idle(queue: RecoveryQueue) -> None:
    """Tick as the hand's thread does."""
    deadline_s = time.monotonic() + WAIT_S
    while queue.waiting():
        assert time.monotonic() < deadline_s
        queue.tick()
        time.sleep(0.001)
    queue.close()


def test_it_tries_until_it_succeeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 0.005)
    tries: list[int] = []

    def recover(node_id: int) -> bool:
        tries.append(node_id)
        return tries.count(node_id) == 3

    queue = RecoveryQueue(recover)
    queue.need([5, 6])
    wait_until_idle(queue)
    assert sorted(tries) == [5, 5, 5, 6, 6, 6]


def test_a_need_during_a_recovery_is_met_afterwards() -> None:
    begun, go_on, running = threading.Semaphore(0), threading.Event(), threading.Lock()

    def recover(_node_id: int) -> bool:
        assert running.acquire(blocking=False)
        begun.release()
        go_on.wait(WAIT_S)
        running.release()
        return True

    queue = RecoveryQueue(recover)
    queue.need([5])
    assert begun.acquire(timeout=WAIT_S)
    queue.need([5])
    go_on.set()
    wait_until_idle(queue)
    assert begun.acquire(timeout=WAIT_S)


def test_a_finger_that_is_lost_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 1000.0)
    queue = RecoveryQueue(lambda _node_id: False)
    queue.need([5])
    until(lambda: not queue._busy)
    assert queue.waiting()
    queue.drop(5)
    assert not queue.waiting()
    queue.close()
