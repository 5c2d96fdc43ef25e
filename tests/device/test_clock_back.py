"""A clock that goes back: the device goes on from where it was, and asks to be stepped by the caller's clock."""

from device.conversation import Conversation
from device.tiny import booted
from tipforce.device.codes import NEVER_US


def beating() -> Conversation:
    """A booted node with a heartbeat of 100 ms, one second old."""
    talk = booted()
    talk.sleep(1_000_000)
    assert talk.put("H", 0x1017, 0, 100) == 0
    talk.take()
    return talk


def test_heartbeats_go_on_at_their_period() -> None:
    talk = beating()
    talk.now_us -= 900_000
    talk.step()
    assert talk.due_us == talk.now_us + 100_000
    talk.say("+ 99999\n+ 1\n< 705#7F\n+ 100000\n< 705#7F")


def test_many_small_steps_back_add_up() -> None:
    talk = beating()
    for _ in range(1000):
        talk.now_us -= 10
        talk.step()
    assert talk.due_us == talk.now_us + 100_000
    talk.say("+ 99999\n+ 1\n< 705#7F")


def test_own_time_never_falls() -> None:
    talk = beating()
    before = talk.device.now_us
    talk.now_us = 5
    talk.step()
    assert talk.device.now_us == before
    talk.now_us = 15
    talk.step()
    assert talk.device.now_us == before + 10


def test_nothing_due_stays_far_away() -> None:
    talk = beating()
    talk.put("H", 0x1017, 0, 0)
    talk.now_us = 0
    talk.step()
    assert talk.due_us > NEVER_US // 2
