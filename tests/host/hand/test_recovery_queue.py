"""The recovery queue: it repeats until it is done, once at a time for each finger, and again when asked meanwhile."""

from __future__ import annotations

import threading
import time

import pytest

from tipforce.host.hand import recovery as module
from tipforce.host.hand.recovery import RecoveryQueue

WAIT_S = 60.0


def wait_until_idle(queue: RecoveryQueue) -> None:
    """Tick as the hand's thread does."""
    deadline_s = time.monotonic() + WAIT_S
    while queue.waiting():
        assert time.monotonic() < deadline_s
        queue.tick()
        time.sleep(0.001)


def test_it_tries_until_it_is_mended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 0.005)
    tries: list[int] = []

    def recover(node_id: int) -> bool:
        tries.append(node_id)
        return tries.count(node_id) == 3

    queue = RecoveryQueue(recover)
    queue.need([5, 6])
    wait_until_idle(queue)
    queue.close()
    assert sorted(tries) == [5, 5, 5, 6, 6, 6]


def test_a_need_while_mending_is_met_afterwards() -> None:
    begun, go_on = threading.Semaphore(0), threading.Event()
    running, most = [0], [0]

    def recover(_node_id: int) -> bool:
        running[0] += 1
        most[0] = max(most[0], running[0])
        begun.release()
        go_on.wait(WAIT_S)
        running[0] -= 1
        return True

    queue = RecoveryQueue(recover)
    queue.need([5])
    assert begun.acquire(timeout=WAIT_S)
    queue.need([5])
    go_on.set()
    wait_until_idle(queue)
    assert begun.acquire(timeout=WAIT_S)
    assert most == [1]
    queue.close()


def test_a_finger_that_is_gone_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 1000.0)
    queue = RecoveryQueue(lambda _node_id: False)
    queue.need([5])
    while queue._busy:
        time.sleep(0.001)
    assert queue.waiting()
    queue.drop(5)
    assert not queue.waiting()
    queue.close()
