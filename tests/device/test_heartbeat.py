"""Heartbeat producer (CiA 301, 7.2.8.3.2.2), object 1017h."""

from device.conversation import Conversation
from device.tiny import Memory, booted


def beating(period_ms: int) -> Conversation:
    """A booted node with this producer heartbeat time."""
    talk = booted()
    assert talk.put("H", 0x1017, 0, period_ms) == 0
    return talk


def test_heartbeat_carries_the_state_every_period() -> None:
    beating(100).say("""
        + 99999
        + 1
        < 705#7F
        + 100000
        < 705#7F
        > 000#0105
        + 100000
        < 705#05
        > 000#0205
        + 100000
        < 705#04
    """)


def test_boot_up_starts_the_period() -> None:
    # The stored time holds from the boot-up message on, which counts as the first heartbeat.
    store = Memory()
    talk = booted(store)
    talk.put("H", 0x1017, 0, 100)
    talk.say("> 605#2310100273617665\n< 585#6010100200000000\n> 000#8105\n< 705#00\n+ 99999\n+ 1\n< 705#7F")


def test_period_changes_from_the_write_on() -> None:
    talk = beating(100)
    talk.say("+ 60000")
    talk.put("H", 0x1017, 0, 50)
    talk.say("+ 49999\n+ 1\n< 705#7F\n+ 50000\n< 705#7F")


def test_zero_stops_the_heartbeat() -> None:
    talk = beating(100)
    talk.put("H", 0x1017, 0, 0)
    talk.say("+ 10000000")


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


def test_reset_communication_restores_the_default_time() -> None:
    beating(10).say("> 000#8205\n< 705#00\n+ 1000000")
