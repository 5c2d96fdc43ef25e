"""Error control (CiA 301, 7.2.8.3.2): late steps, watches that change, and clocks that go back."""

from canopen_device.core.codes import NEVER_US, REMOTE_FLAG
from canopen_device.testing import Conversation
from device.tiny import booted, serving


def beating(period_ms: int) -> Conversation:
    """A booted node with this producer heartbeat time."""
    talk = booted()
    assert talk.put("H", 0x1017, 0, period_ms) == 0
    return talk


def test_late_steps_do_not_add_up() -> None:
    # Each step comes 3 ms late; the hundredth heartbeat is still due at 100 periods.
    talk = beating(10)
    for k in range(1, 101):
        assert talk.due_us == 10_000 * k
        talk.sleep(talk.due_us + 3000 - talk.now_us)
    assert talk.take() == [(0x705, b"\x7f")] * 100


def test_a_process_that_slept_sends_one_heartbeat_and_no_burst() -> None:
    talk = beating(10)
    talk.say("~ 1000000\n< 705#7F\n+ 9999\n+ 1\n< 705#7F")


def watching(node_id: int = 7, period_ms: int = 100) -> Conversation:
    """A node that watches another."""
    talk = serving()
    assert talk.put("I", 0x1016, 1, node_id << 16 | period_ms) == 0
    return talk


def test_a_new_time_starts_the_watch_anew() -> None:
    talk = watching()
    talk.say("> 707#05\n+ 50000")
    assert talk.put("I", 0x1016, 1, 7 << 16 | 200) == 0
    talk.say("+ 10000000\n> 707#05\n+ 199999\n+ 1\n< 085#3081110700000000")


GUARD = (0x705 | REMOTE_FLAG, b"")


def guarded(guard_ms: int = 100, factor: int = 3) -> Conversation:
    """A node with life guarding."""
    talk = serving()
    assert talk.put("H", 0x100C, 0, guard_ms) == talk.put("B", 0x100D, 0, factor) == 0
    return talk


def test_life_guarding_that_was_switched_off_misses_nobody() -> None:
    talk = guarded()
    talk.step([GUARD])
    talk.say("< 705#7F")
    assert talk.put("B", 0x100D, 0, 0) == 0
    talk.say("+ 10000000")


def beating_for_a_second() -> Conversation:
    """A booted node with a heartbeat of 100 ms, one second old."""
    talk = booted()
    talk.sleep(1_000_000)
    assert talk.put("H", 0x1017, 0, 100) == 0
    talk.take()
    return talk


def test_heartbeats_go_on_at_their_period() -> None:
    talk = beating_for_a_second()
    talk.now_us -= 900_000
    talk.step()
    assert talk.due_us == talk.now_us + 100_000
    talk.say("+ 99999\n+ 1\n< 705#7F\n+ 100000\n< 705#7F")


def test_many_small_steps_back_add_up() -> None:
    talk = beating_for_a_second()
    for _ in range(1000):
        talk.now_us -= 10
        talk.step()
    assert talk.due_us == talk.now_us + 100_000
    talk.say("+ 99999\n+ 1\n< 705#7F")


def test_own_time_never_falls() -> None:
    talk = beating_for_a_second()
    before = talk.device.now_us
    talk.now_us = 5
    talk.step()
    assert talk.device.now_us == before
    talk.now_us = 15
    talk.step()
    assert talk.device.now_us == before + 10


def test_nothing_due_stays_far_away() -> None:
    talk = beating_for_a_second()
    talk.put("H", 0x1017, 0, 0)
    talk.now_us = 0
    talk.step()
    assert talk.due_us > NEVER_US // 2
