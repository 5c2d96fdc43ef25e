"""SYNC and TPDOs (CiA 301, 7.2.2, 7.2.5): the latch, requests, the window, event timer, inhibit time."""

import pytest

from canopen_device.testing import Conversation
from device.tiny import Recorder, booted, serving


def test_application_latches_before_the_tpdo_is_packed() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    assert talk.put("I", 0x1800, 1, 0x40000185) == 0
    talk.say("> 000#0105")
    recorder.on_sync = lambda now_us, _number: talk.device.od.values.update({0x200000: now_us})  # type: ignore[method-assign]
    talk.say("+ 66\n> 080#\n< 185#42FEFF\n+ 1\n> 080#\n< 185#43FEFF")


def test_syncs_count_anew_after_a_start_value_change() -> None:
    talk = booted()
    assert talk.put("B", 0x1800, 2, 3) == talk.put("I", 0x1800, 1, 0x40000185) == 0
    talk.say("> 000#0105\n> 080#\n> 080#")
    for value, sub, kind in ((0xC0000185, 1, "I"), (0, 6, "B"), (0x40000185, 1, "I")):
        assert talk.put(kind, 0x1800, sub, value) == 0
    talk.say("> 080#\n> 080#\n> 080#\n< 185#11FEFF")


def test_latch_in_pre_operational_none_in_stopped() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    talk.say("+ 7\n> 080#\n> 000#0205\n+ 1\n> 080#")
    assert [call for call in recorder.calls if call.startswith("sync")] == ["sync 7"]


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


def test_a_process_that_slept_sends_one_and_no_burst() -> None:
    event_driven(20).say(f"> 000#0105\n{TPDO2}\n~ 1000000\n{TPDO2}\n+ 19999\n+ 1\n{TPDO2}")


def test_event_timer_lets_the_application_refresh_first() -> None:
    talk = event_driven(20)
    recorder = Recorder()
    talk.device.application = recorder
    talk.say(f"> 000#0105\n{TPDO2}\n+ 20000\n{TPDO2}")
    assert recorder.calls == ["refresh 0", "refresh 20000"]


@pytest.mark.parametrize(("late_us", "taken"), [(1000, True), (1001, False)])
def test_a_synchronous_rpdo_counts_inside_the_window(late_us: int, taken: bool) -> None:
    talk = serving()
    for kind, index, sub, value in (("I", 0x1007, 0, 1000), ("B", 0x1400, 2, 1), ("I", 0x1400, 1, 0x205)):
        assert talk.put(kind, index, sub, value) == 0
    talk.say(f"> 000#0105\n> 080#\n+ {late_us}\n> 205#220000\n> 080#")
    assert talk.get("B", 0x2000) == (0x22 if taken else 0x11)
