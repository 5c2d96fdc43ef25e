"""Heartbeat consumer (CiA 301, 7.2.8.3.2.2 and 7.5.2.20): object 1016h, EMCY 8130h, error behaviour 1029h."""

import pytest

from device.conversation import Conversation
from device.services import serving

VALUE, INCOMPATIBLE = 0x06090030, 0x06040043


def watching(node_id: int = 7, period_ms: int = 100) -> Conversation:
    """A node that watches another."""
    talk = serving()
    assert talk.put("I", 0x1016, 1, node_id << 16 | period_ms) == 0
    return talk


def test_nobody_is_missed_before_the_first_heartbeat() -> None:
    watching().say("+ 10000000")


def test_a_lost_heartbeat_is_said_once_and_its_return_too() -> None:
    watching().say("""
        > 707#05
        + 99999
        > 707#05
        + 99999
        + 1
        < 085#3081110700000000
        + 1000000
        > 707#05
        < 085#0000003081070000
        + 50000
    """)


def test_a_heartbeat_of_another_length_is_none() -> None:
    watching().say("> 707#0505\n+ 1000000")


@pytest.mark.parametrize(("behaviour", "state"), [(0, "7F"), (1, "05"), (2, "04")])
def test_error_behaviour(behaviour: int, state: str) -> None:
    talk = watching()
    assert talk.put("B", 0x1029, 1, behaviour) == talk.put("H", 0x1017, 0, 150) == 0
    talk.say("> 000#0105\n> 707#05\n+ 100000" + ("\n< 085#3081110700000000" if behaviour < 2 else ""))
    talk.say(f"+ 50000\n< 705#{state}")


def test_four_nodes_each_with_its_own_time() -> None:
    talk = serving()
    for sub in (1, 2, 3, 4):
        assert talk.put("I", 0x1016, sub, 0x10 + sub << 16 | 100 * sub) == 0
    for sub in (1, 2, 3, 4):
        talk.say(f"> 71{sub}#05")
    for sub in (1, 2, 3, 4):
        talk.say(f"+ 99999\n+ 1\n< 085#3081111{sub}00000000")


def test_entries_that_are_refused() -> None:
    talk = watching()
    assert talk.put("I", 0x1016, 2, 7 << 16 | 200) == INCOMPATIBLE
    assert talk.put("I", 0x1016, 2, 7 << 16) == 0  # a time of 0 watches nobody
    assert talk.put("I", 0x1016, 2, 128 << 16 | 200) == VALUE
    assert talk.put("I", 0x1016, 2, 1 << 24 | 7 << 16 | 200) == VALUE
    assert talk.put("I", 0x1016, 1, 7 << 16 | 300) == 0


def test_a_watch_that_ends_takes_its_error_with_it() -> None:
    talk = watching()
    talk.say("> 707#05\n+ 100000\n< 085#3081110700000000")
    assert talk.put("I", 0x1016, 1, 0) == 0
    talk.say("< 085#0000003081070000\n> 707#05\n+ 1000000")
    assert talk.get("B", 0x1001) == 0


def test_a_new_time_starts_the_watch_anew() -> None:
    talk = watching()
    talk.say("> 707#05\n+ 50000")
    assert talk.put("I", 0x1016, 1, 7 << 16 | 200) == 0
    talk.say("+ 10000000\n> 707#05\n+ 199999\n+ 1\n< 085#3081110700000000")


def test_a_reset_forgets_who_was_there() -> None:
    talk = watching()
    talk.say("> 707#05\n> 000#8205\n< 705#00\n+ 1000000")
