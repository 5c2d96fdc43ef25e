"""RPDOs (CiA 301, 7.2.2): refused values, shared identifiers, and the identifiers that a PDO may have."""

import pytest

from canopen_device.testing import Conversation
from device.tiny import booted

NO_RTR = 0x40000000


@pytest.fixture
def talk() -> Conversation:
    """A node whose TPDO1 and RPDO1 are valid, and TPDO2 and RPDO2 not."""
    talk = booted()
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x185) == 0
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    return talk


@pytest.mark.parametrize("can_id", [0x80, 0x100, 0x181, 0x57F, 0x580, 0x600, 0x680, 0x6DF, 0x700])
def test_can_ids_at_the_edge_of_restricted_ranges_are_allowed(talk: Conversation, can_id: int) -> None:
    assert talk.put("I", 0x1801, 1, NO_RTR | can_id) == 0


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
    assert received(talk) == (0x22, -5)
    assert talk.upload(0x2002) == bytes.fromhex("22FBFF01")
