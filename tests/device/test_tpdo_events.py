"""Event-driven TPDOs (CiA 301, 7.5.2.35, types 254 and 255): event timer, inhibit time, requests of the application."""

import pytest

from device.conversation import Conversation
from device.tiny import Recorder, booted

TPDO2 = "< 285#11FEFF"


def event_driven(event_ms: int = 0, inhibit_100us: int = 0, transmission: int = 255) -> Conversation:
    """A node in PRE-OPERATIONAL whose TPDO2 is event-driven and valid."""
    talk = booted()
    for kind, sub, value in (
        ("B", 2, transmission), ("H", 3, inhibit_100us), ("H", 5, event_ms), ("I", 1, 0x40000285),
    ):  # fmt: skip
        assert talk.put(kind, 0x1801, sub, value) == 0
    return talk


@pytest.mark.parametrize("transmission", [254, 255])
def test_event_timer_sends_at_the_start_and_each_period(transmission: int) -> None:
    event_driven(20, transmission=transmission).say(f"""
        + 100000
        > 000#0105
        {TPDO2}
        + 19999
        + 1
        {TPDO2}
        + 20000
        {TPDO2}
        > 080#
        > 000#8005
        + 100000
    """)


def test_without_event_timer_only_the_start_is_an_event() -> None:
    event_driven().say(f"> 000#0105\n{TPDO2}\n+ 9000000\n> 080#")


def test_request_is_sent_at_once_and_restarts_the_event_timer() -> None:
    talk = event_driven(20)
    talk.say(f"> 000#0105\n{TPDO2}\n+ 5000")
    talk.device.tpdos.request(2)
    talk.step()
    talk.say(f"{TPDO2}\n+ 19999\n+ 1\n{TPDO2}")


def test_inhibit_time_separates_requests() -> None:
    talk = event_driven(0, 50)
    talk.say(f"> 000#0105\n{TPDO2}\n+ 1000")
    for _ in range(3):
        talk.device.tpdos.request(2)
    # Three events within the inhibit time of 5 ms: one frame at its end.
    talk.step()
    talk.say(f"+ 3999\n+ 1\n{TPDO2}\n+ 100000")


def test_inhibit_time_longer_than_the_event_timer_wins() -> None:
    event_driven(1, 50).say(f"> 000#0105\n{TPDO2}\n+ 4999\n+ 1\n{TPDO2}")


def test_inhibit_time_outlasts_a_stop_and_a_start() -> None:
    event_driven(0, 50).say(f"> 000#0105\n{TPDO2}\n> 000#0205\n+ 1000\n> 000#0105\n+ 3999\n+ 1\n{TPDO2}")


def test_request_outside_operational_sends_nothing() -> None:
    talk = event_driven()
    talk.device.tpdos.request(2)
    talk.say("+ 100000")


def test_request_of_an_invalid_tpdo_sends_nothing() -> None:
    talk = booted()
    talk.say("> 000#0105")
    talk.device.tpdos.request(2)
    talk.say("+ 100000")


def test_event_timer_written_while_operational_acts() -> None:
    talk = event_driven()
    talk.say(f"> 000#0105\n{TPDO2}")
    assert talk.put("H", 0x1801, 5, 30) == 0
    talk.say(f"+ 29999\n+ 1\n{TPDO2}")
    assert talk.put("H", 0x1801, 5, 0) == 0
    talk.say("+ 1000000")


def test_event_timer_does_not_drive_a_synchronous_tpdo() -> None:
    event_driven(20, transmission=1).say(f"> 000#0105\n+ 100000\n> 080#\n{TPDO2}")


def test_a_process_that_slept_sends_one_and_no_burst() -> None:
    event_driven(20).say(f"> 000#0105\n{TPDO2}\n~ 1000000\n{TPDO2}\n+ 19999\n+ 1\n{TPDO2}")


def test_event_timer_lets_the_application_refresh_first() -> None:
    talk = event_driven(20)
    recorder = Recorder()
    talk.device.application = recorder
    talk.say(f"> 000#0105\n{TPDO2}\n+ 20000\n{TPDO2}")
    assert recorder.calls == ["refresh 0", "refresh 20000"]


def test_reset_communication_stops_it() -> None:
    event_driven(20).say(f"> 000#0105\n{TPDO2}\n> 000#8205\n< 705#00\n> 000#0105\n+ 1000000")
