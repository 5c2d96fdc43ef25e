"""The keeper: mends until it is done, once at a time for each finger, and again when asked meanwhile."""

from __future__ import annotations

import threading
import time

import pytest

from tipforce.host.hand import supervision as module
from tipforce.host.hand.supervision import Keeper


def wait_until_idle(keeper: Keeper) -> None:
    """Tick as the hand's thread does."""
    deadline_s = time.monotonic() + 10
    while keeper.waiting():
        assert time.monotonic() < deadline_s
        keeper.tick()
        time.sleep(0.001)


def test_it_tries_until_it_is_mended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 0.005)
    tries: list[int] = []

    def mend(node_id: int) -> bool:
        tries.append(node_id)
        return tries.count(node_id) == 3

    keeper = Keeper(mend)
    keeper.need([5, 6])
    wait_until_idle(keeper)
    keeper.close()
    assert sorted(tries) == [5, 5, 5, 6, 6, 6]


def test_a_need_while_mending_is_met_afterwards() -> None:
    begun, go_on = threading.Semaphore(0), threading.Event()
    running, most = [0], [0]

    def mend(_node_id: int) -> bool:
        running[0] += 1
        most[0] = max(most[0], running[0])
        begun.release()
        go_on.wait(10)
        running[0] -= 1
        return True

    keeper = Keeper(mend)
    keeper.need([5])
    assert begun.acquire(timeout=10)
    keeper.need([5])
    go_on.set()
    wait_until_idle(keeper)
    assert begun.acquire(timeout=10)
    assert most == [1]
    keeper.close()


def test_a_finger_that_is_gone_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 1000.0)
    keeper = Keeper(lambda _node_id: False)
    keeper.need([5])
    while keeper._busy:
        time.sleep(0.001)
    assert keeper.waiting()
    keeper.drop(5)
    assert not keeper.waiting()
    keeper.close()
