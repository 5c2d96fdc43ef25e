"""EMCY producer (CiA 301, 7.2.7): messages, error register 1001h, history 1003h, inhibit time 1015h, COB-ID 1014h."""

import pytest

from device.conversation import Conversation
from device.services import serving
from tipforce.device import codes, emcy
from tipforce.device.emcy import COMMUNICATION, MAX_WAITING, PROFILE

VALUE = 0x06090030


def raised(talk: Conversation, code: int, detail: int = 0, bits: int = PROFILE) -> None:
    """The application reports an error."""
    talk.device.emcy.raise_error(code, bits, detail)
    talk.step()


def test_an_error_is_said_once_and_cured_once() -> None:
    talk = serving()
    raised(talk, 0x5030, 9)
    talk.say("< 085#3050210900000000")
    raised(talk, 0x5030, 9)
    talk.say("+ 1000")
    assert talk.get("B", 0x1001) == 0x21
    talk.device.emcy.cure(0x5030, 9)
    talk.device.emcy.cure(0x5030, 9)
    talk.step()
    talk.say("< 085#0000003050090000\n+ 1000")
    assert talk.get("B", 0x1001) == 0


def test_the_register_joins_the_bits_of_all_active_errors() -> None:
    talk = serving()
    raised(talk, 0x5030)
    raised(talk, 0x8130, 7, COMMUNICATION)
    talk.say("< 085#3050210000000000\n< 085#3081310700000000")
    talk.device.emcy.cure(0x5030)
    talk.step()
    talk.say("< 085#0000113050000000")


def test_the_history_keeps_eight_newest_first() -> None:
    talk = serving()
    for k in range(10):
        raised(talk, 0x5000 + k, k)
    talk.advance(1000)
    assert len(talk.take()) == 10
    assert talk.get("B", 0x1003) == 8
    assert talk.get("I", 0x1003, 1) == 0x00095009
    assert talk.get("I", 0x1003, 8) == 0x00025002
    assert talk.put("B", 0x1003, 0, 1) == VALUE
    assert talk.put("B", 0x1003, 0, 0) == 0
    assert talk.get("B", 0x1003) == 0
    assert talk.upload(0x1003, 1) == codes.NO_DATA


def test_the_inhibit_time_separates_messages_and_loses_none() -> None:
    talk = serving()
    assert talk.put("H", 0x1015, 0, 100) == 0
    for detail in range(3):
        raised(talk, 0x5030, detail)
    talk.say("""
        < 085#3050210000000000
        + 9999
        + 1
        < 085#3050210100000000
        + 10000
        < 085#3050210200000000
        + 100000
    """)


def test_nothing_is_said_in_stopped_and_all_of_it_after() -> None:
    talk = serving()
    talk.say("> 000#0205")
    raised(talk, 0x5030)
    talk.say("+ 100000\n> 000#8005\n< 085#3050210000000000")


def test_what_waits_is_bounded() -> None:
    talk = serving()
    talk.say("> 000#0205")
    for detail in range(3 * MAX_WAITING):
        raised(talk, 0x5030, detail)
    talk.say("> 000#8005\n< 085#3050210000000000")
    talk.advance(1)
    assert len(talk.take()) == MAX_WAITING - 1


def test_an_invalid_cob_id_holds_messages_back() -> None:
    talk = serving()
    assert talk.put("I", 0x1014, 0, 0x80000085) == 0
    raised(talk, 0x5030)
    talk.say("+ 1000")
    assert talk.put("I", 0x1014, 0, 0x90) == 0
    assert talk.take() == [(0x090, bytes.fromhex("3050210000000000"))]


@pytest.mark.parametrize("cob_id", [0x86, 0x601, 0x20000085, 0x40000085, 0x80000885])
def test_a_cob_id_that_is_refused(cob_id: int) -> None:
    talk = serving()
    assert talk.put("I", 0x1014, 0, cob_id) == VALUE
    assert talk.put("I", 0x1014, 0, 0x85) == 0  # the same once more is no change


def test_a_restricted_identifier_is_refused_from_invalid_as_well() -> None:
    talk = serving()
    assert talk.put("I", 0x1014, 0, 0x80000085) == 0
    assert talk.put("I", 0x1014, 0, 0x601) == VALUE


def test_a_reset_of_communication_keeps_what_the_application_reported() -> None:
    talk = serving()
    raised(talk, 0x5030)
    raised(talk, emcy.ERROR_PASSIVE, 0, COMMUNICATION)
    raised(talk, emcy.HEARTBEAT_LOST, 7, COMMUNICATION)
    talk.advance(10)
    talk.take()
    talk.say("> 000#8205\n< 705#00")
    assert talk.get("B", 0x1001) == 0x31
    assert talk.get("B", 0x1003) == 3
    talk.say("> 000#8105\n< 705#00")
    assert talk.get("B", 0x1001) == 0x11  # the controller is no part of the node's reset
    assert talk.get("B", 0x1003) == 3


def test_nothing_is_lost_while_the_bus_is_off() -> None:
    talk = serving()
    talk.step([(codes.ERROR_FLAG | 0x40, bytes(8))])
    raised(talk, 0x5030)
    talk.say("+ 50000")
    talk.step([(codes.ERROR_FLAG | 0x100, bytes(8))])
    talk.say("< 085#3050210000000000\n+ 1\n< 085#4081210000000000")


@pytest.mark.parametrize(("data", "event"), [("11", "1082"), ("", "1082")])
def test_the_length_error_of_an_rpdo_ends_with_the_next_good_one(data: str, event: str) -> None:
    talk = serving()
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    talk.say(f"""
        > 000#0105
        > 205#{data}
        < 085#{event}110502000000
        > 205#{data}
        > 205#110000
        < 085#0000001082050200
    """)


def test_an_error_of_an_rpdo_ends_when_the_rpdo_does() -> None:
    talk = serving()
    assert talk.put("I", 0x1400, 1, 0x205) == talk.put("H", 0x1400, 5, 10) == 0
    talk.say("> 000#0105\n> 205#110000\n+ 10000\n< 085#5082110502000000\n> 205#11\n< 085#1082110502000000")
    assert talk.put("I", 0x1400, 1, 0x80000205) == 0
    talk.advance(1)
    assert {data[:5].hex() for _, data in talk.take()} == {"0000111082", "0000005082"}
    assert talk.get("B", 0x1001) == 0


def test_a_sync_of_the_wrong_length() -> None:
    talk = serving()
    talk.say("> 080#01\n< 085#4082110000000000\n> 080#02\n> 080#\n< 085#0000004082000000")
