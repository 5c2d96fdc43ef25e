"""PDOs of a device (CiA 301, 7.2.2): RPDOs, and TPDOs by SYNC, by event, by timer."""

import pytest

from canopen_device.testing import Conversation
from device.tiny import Recorder, booted, serving

NO_RTR = 0x40000000
TPDO2 = "< 285#11FEFF"


@pytest.mark.parametrize("can_id", [0x80, 0x100, 0x181, 0x57F, 0x580, 0x600, 0x680, 0x6DF, 0x700])
def test_can_ids_at_the_edge_of_restricted_ranges_are_allowed(can_id: int) -> None:
    assert booted().put("I", 0x1801, 1, NO_RTR | can_id) == 0


def receiving(mapping: list[int] | None = None) -> Conversation:
    """A node in OPERATIONAL whose RPDO1 is valid: 2000h and 2001h unless mapped otherwise."""
    talk = booted()
    if mapping is not None:
        assert talk.put("B", 0x1600, 0, 0) == 0
        for sub, word in enumerate(mapping, 1):
            assert talk.put("I", 0x1600, sub, word) == 0
        assert talk.put("B", 0x1600, 0, len(mapping)) == 0
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    talk.say("> 000#0105")
    return talk


def test_value_that_is_refused_leaves_the_others() -> None:
    talk = receiving(mapping=[0x20030020, 0x20000008])
    talk.say("> 205#0000C07F.22")  # NaN for a REAL32 that must be finite
    assert talk.get("f", 0x2003) == 1.5
    assert talk.get("B", 0x2000) == 0x22


def test_two_rpdos_with_one_identifier_both_act() -> None:
    talk = receiving()
    assert talk.put("B", 0x1601, 0, 0) == talk.put("I", 0x1601, 1, 0x20020020) == talk.put("B", 0x1601, 0, 1) == 0
    assert talk.put("I", 0x1401, 1, 0x205) == 0
    talk.say("> 205#22FBFF01")
    assert (talk.get("B", 0x2000), talk.get("h", 0x2001)) == (0x22, -5)
    assert talk.upload(0x2002) == bytes.fromhex("22FBFF01")


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
    booted(application=recorder).say("+ 7\n> 080#\n> 000#0205\n+ 1\n> 080#")
    assert [call for call in recorder.calls if call.startswith("sync")] == ["sync 7"]


def event_driven(event_ms: int = 0, inhibit_100us: int = 0, transmission: int = 255) -> Conversation:
    """A node in PRE-OPERATIONAL whose TPDO2 is event-driven and valid."""
    talk = booted()
    for kind, sub, value in (
        ("B", 2, transmission), ("H", 3, inhibit_100us), ("H", 5, event_ms), ("I", 1, 0x40000285),
    ):  # fmt: skip
        assert talk.put(kind, 0x1801, sub, value) == 0
    return talk


STARTED = f"> 000#0105\n{TPDO2}"
PERIODS = f"+ 100000\n{STARTED}\n+ 19999\n+ 1\n{TPDO2}\n+ 20000\n{TPDO2}\n> 080#\n> 000#8005\n+ 100000"


@pytest.mark.parametrize(
    ("event_ms", "inhibit_100us", "transmission", "script"),
    [
        (20, 0, 254, PERIODS),
        (20, 0, 255, PERIODS),
        # A request is sent at once and restarts the event timer; before the start it sends nothing.
        (20, 0, 255, f"{STARTED}\n+ 5000 request {TPDO2}\n+ 19999\n+ 1\n{TPDO2}"),
        (0, 0, 255, "request + 100000"),
        # Three events within the inhibit time of 5 ms: one frame at its end, which a stop and a start do not shorten.
        (0, 50, 255, f"{STARTED}\n+ 1000 request request request + 3999\n+ 1\n{TPDO2}\n+ 100000"),
        (0, 50, 255, f"{STARTED}\n> 000#0205\n+ 1000\n> 000#0105\n+ 3999\n+ 1\n{TPDO2}"),
        # A process that slept sends one, and no burst.
        (20, 0, 255, f"{STARTED}\n~ 1000000\n{TPDO2}\n+ 19999\n+ 1\n{TPDO2}"),
    ],
)
def test_event_timer_inhibit_time_and_requests(
    event_ms: int, inhibit_100us: int, transmission: int, script: str
) -> None:
    talk = event_driven(event_ms, inhibit_100us, transmission)
    for number, part in enumerate(script.split("request")):
        if number:
            talk.device.tpdos.request(2)
            talk.step()
        talk.say(part)


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
