"""RPDOs (CiA 301, 7.2.2): event-driven and synchronous, short and long frames, dummy entries."""

import pytest

from device.conversation import Conversation
from device.tiny import booted


def receiving(transmission: int = 255, mapping: list[int] | None = None) -> Conversation:
    """A node in OPERATIONAL whose RPDO1 is valid: 2000h and 2001h unless mapped otherwise."""
    talk = booted()
    if mapping is not None:
        assert talk.put("B", 0x1600, 0, 0) == 0
        for sub, word in enumerate(mapping, 1):
            assert talk.put("I", 0x1600, sub, word) == 0
        assert talk.put("B", 0x1600, 0, len(mapping)) == 0
    assert talk.put("B", 0x1400, 2, transmission) == 0
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    talk.say("> 000#0105")
    return talk


def received(talk: Conversation) -> tuple[float, float]:
    """2000h and 2001h."""
    return talk.get("B", 0x2000), talk.get("h", 0x2001)


@pytest.mark.parametrize("transmission", [254, 255])
def test_event_driven_rpdo_acts_at_once(transmission: int) -> None:
    talk = receiving(transmission)
    talk.say("> 205#22FBFF")
    assert received(talk) == (0x22, -5)


@pytest.mark.parametrize("transmission", [0, 1, 240])
def test_synchronous_rpdo_acts_with_the_next_sync(transmission: int) -> None:
    talk = receiving(transmission)
    talk.say("> 205#22FBFF\n> 205#33FAFF")
    assert received(talk) == (0x11, -2)
    talk.say("> 080#")
    assert received(talk) == (0x33, -6)  # the last one before the SYNC
    assert talk.put("B", 0x2000, 0, 1) == 0
    talk.say("> 080#")
    assert received(talk) == (1, -6)  # and once only


def test_synchronous_rpdo_is_forgotten_when_operational_is_left() -> None:
    talk = receiving(1)
    talk.say("> 205#22FBFF\n> 000#8005\n> 000#0105\n> 080#")
    assert received(talk) == (0x11, -2)


@pytest.mark.parametrize("data", ["", "22", "22FB"])
def test_too_short_rpdo_changes_nothing(data: str) -> None:
    talk = receiving()
    talk.say(f"> 205#{data}")
    assert received(talk) == (0x11, -2)


def test_longer_rpdo_is_taken_as_far_as_it_is_mapped() -> None:
    talk = receiving()
    talk.say("> 205#22FBFF0102030405")
    assert received(talk) == (0x22, -5)


def test_dummy_entries_leave_gaps() -> None:
    talk = receiving(mapping=[0x00050008, 0x20000008, 0x00060010, 0x20010010])
    talk.say("> 205#FF44FFFFFCFF")
    assert received(talk) == (0x44, -4)


@pytest.mark.parametrize("state", ["80", "02"])
def test_no_rpdo_outside_operational(state: str) -> None:
    talk = receiving()
    talk.say(f"> 000#{state}05\n> 205#22FBFF\n> 000#0105")
    assert received(talk) == (0x11, -2)


def test_value_that_is_refused_leaves_the_others() -> None:
    talk = receiving(mapping=[0x20030020, 0x20000008])
    talk.say("> 205#0000C07F.22")  # NaN for a REAL32 that must be finite
    assert talk.get("f", 0x2003) == 1.5
    assert talk.get("B", 0x2000) == 0x22


def test_invalid_rpdo_is_not_listened_to() -> None:
    talk = receiving()
    assert talk.put("I", 0x1400, 1, 0x80000205) == 0
    talk.say("> 205#22FBFF")
    assert received(talk) == (0x11, -2)


def test_cob_id_change_takes_effect() -> None:
    talk = receiving()
    assert talk.put("I", 0x1400, 1, 0x80000205) == talk.put("I", 0x1400, 1, 0x3AB) == 0
    talk.say("> 205#22FBFF\n> 3AB#33FBFF")
    assert received(talk) == (0x33, -5)


def test_two_rpdos_with_one_identifier_both_act() -> None:
    talk = receiving()
    assert talk.put("B", 0x1601, 0, 0) == talk.put("I", 0x1601, 1, 0x20020020) == talk.put("B", 0x1601, 0, 1) == 0
    assert talk.put("I", 0x1401, 1, 0x205) == 0
    talk.say("> 205#22FBFF01")
    assert received(talk) == (0x22, -5)
    assert talk.upload(0x2002) == bytes.fromhex("22FBFF01")
