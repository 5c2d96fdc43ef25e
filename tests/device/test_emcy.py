"""EMCY (CiA 301, 7.2.7): messages, 1001h, 1003h, 1014h, 1015h; bus faults and nodes with the same identifiers."""

import pytest

from canopen_device.core import emcy
from canopen_device.core.codes import ERROR_FLAG
from canopen_device.core.emcy import FIRST_RESTART_US, LAST_RESTART_US, MAX_WAITING, OVERRUN_QUIET_US, TRANSMIT_OVERFLOW
from canopen_device.testing import Conversation
from device.tiny import serving

BUS_OFF, RESTARTED = (ERROR_FLAG | 0x40, bytes(8)), (ERROR_FLAG | 0x100, bytes(8))


def raised(talk: Conversation, code: int, detail: int = 0, bits: int = emcy.PROFILE) -> None:
    talk.device.emcy.raise_error(code, bits, detail)
    talk.step()


def test_an_error_is_said_once_and_cured_once() -> None:
    talk = serving()
    raised(talk, 0x5030, 9)
    talk.say("< 085#3050210900000000")
    raised(talk, 0x5030, 9)
    talk.say("+ 1000")
    assert talk.get("B", 0x1001) == 0x21
    assert talk.get("I", 0x1003, 1) == 0x00095030
    talk.device.emcy.cure(0x5030, 9)
    talk.device.emcy.cure(0x5030, 9)
    talk.step()
    talk.say("< 085#0000003050090000\n+ 1000")
    assert talk.get("B", 0x1001) == 0


def test_what_waits_is_bounded() -> None:
    talk = serving()
    talk.say("> 000#0205")
    for detail in range(3 * MAX_WAITING):
        raised(talk, 0x5030, detail)
    talk.say("> 000#8005\n< 085#3050210000000000")
    talk.advance(1)
    later = talk.take()
    assert (len(later), later[-1][1][3]) == (MAX_WAITING - 1, 3 * MAX_WAITING - 1)  # the newest is the last


def test_an_invalid_cob_id_holds_messages_back() -> None:
    talk = serving()
    assert talk.put("I", 0x1014, 0, 0x85) == 0  # the same once more is no change
    assert talk.put("I", 0x1014, 0, 0x80000085) == 0
    raised(talk, 0x5030)
    talk.say("+ 1000")
    assert talk.put("I", 0x1014, 0, 0x90) == 0
    assert talk.take() == [(0x090, bytes.fromhex("3050210000000000"))]


def test_a_reset_of_communication_keeps_what_the_application_reported() -> None:
    talk = serving()
    raised(talk, 0x5030)
    raised(talk, emcy.ERROR_PASSIVE, 0, emcy.COMMUNICATION)
    raised(talk, emcy.HEARTBEAT_LOST, 7, emcy.COMMUNICATION)
    talk.advance(10)
    talk.take()
    talk.say("> 000#0205")
    raised(talk, 0x5030, 9)  # waits while STOPPED: it is active, and nobody has heard of it
    talk.say("> 000#8205\n< 705#00\n< 085#3050310900000000")
    assert talk.get("B", 0x1001) == 0x31
    assert talk.get("B", 0x1003) == 4
    talk.say("> 000#8105\n< 705#00")
    assert talk.get("B", 0x1001) == 0x11  # the controller is no part of the node's reset
    assert talk.get("B", 0x1003) == 4


def test_nothing_is_lost_while_the_bus_is_off() -> None:
    talk = serving()
    talk.step([BUS_OFF])
    raised(talk, 0x5030)
    talk.say("+ 50000")
    talk.step([RESTARTED])
    talk.say("< 085#3050210000000000\n+ 1\n< 085#4081210000000000")


def test_an_error_of_a_pdo_ends_when_the_pdo_does() -> None:
    talk = serving()
    assert talk.put("I", 0x1800, 1, 0x40000185) == 0
    talk.say("> 185#00\n< 085#5081118501000000")
    assert talk.put("I", 0x1800, 1, 0xC0000185) == 0
    talk.say("< 085#0000005081850100")
    assert talk.put("I", 0x1400, 1, 0x205) == talk.put("H", 0x1400, 5, 10) == 0
    talk.say("> 000#0105\n> 205#110000\n+ 10000\n< 085#5082110502000000\n> 205#11\n< 085#1082110502000000")
    assert talk.put("I", 0x1400, 1, 0x80000205) == 0
    talk.advance(1)
    assert {data[:5].hex() for _, data in talk.take()} == {"0000111082", "0000005082"}
    assert talk.get("B", 0x1001) == 0


def controller(detail: int) -> tuple[int, bytes]:
    return ERROR_FLAG | 0x4, bytes((0, detail, 0, 0, 0, 0, 0, 0))


def said(talk: Conversation, frame: tuple[int, bytes]) -> list[str]:
    talk.step([frame])
    return [data.hex() for _, data in talk.take()]


@pytest.mark.parametrize("end", [controller(0x40), controller(0x08), controller(0x04), RESTARTED])
def test_error_passive_is_said_once_and_its_end(end: tuple[int, bytes]) -> None:
    talk = serving()
    assert said(talk, controller(0x10)) == ["2081110000000000"]
    assert said(talk, controller(0x20)) == []
    assert said(talk, end) == ["0000002081000000"]
    assert said(talk, end) == []


@pytest.mark.parametrize("frame", [controller(0x01), controller(0x02), TRANSMIT_OVERFLOW])
def test_an_overrun_is_over_when_none_came_for_a_while(frame: tuple[int, bytes]) -> None:
    talk = serving()
    assert said(talk, frame) == ["1081110000000000"]
    talk.advance(OVERRUN_QUIET_US - 1)
    assert said(talk, frame) == []
    talk.say(f"+ {OVERRUN_QUIET_US - 1}\n+ 1\n< 085#0000001081000000")


@pytest.mark.parametrize("frame", [(ERROR_FLAG | 0x8, bytes(8)), (ERROR_FLAG | 0x4, b""), (ERROR_FLAG | 0x4, bytes(8))])
def test_other_error_frames_say_nothing(frame: tuple[int, bytes]) -> None:
    assert said(serving(), frame) == []


def test_bus_off_asks_for_a_restart_ever_more_rarely() -> None:
    talk = serving()
    assert said(talk, BUS_OFF) == said(talk, BUS_OFF) == []
    waits = [min(FIRST_RESTART_US << k, LAST_RESTART_US) for k in range(9)]
    for wait_us in waits:
        talk.say(f"+ {wait_us - 1}")
        assert talk.device.requests == []
        talk.say("+ 1")
        assert talk.device.requests.pop() == ("bus-restart", 0, 0)
    assert waits[-1] == waits[-2] == LAST_RESTART_US


@pytest.mark.parametrize("back", [RESTARTED, controller(0x40), controller(0x08)])
def test_recovery_is_said_and_ends_the_requests(back: tuple[int, bytes]) -> None:
    talk = serving()
    talk.step([BUS_OFF])
    talk.say("+ 50000")
    assert said(talk, back) == ["4081000000000000"]
    talk.say("+ 100000000")
    assert talk.device.requests == []


def test_a_frame_shows_that_the_bus_is_back_and_what_fell_due_meanwhile_is_not_sent() -> None:
    talk = serving()
    assert talk.put("H", 0x1017, 0, 10) == 0
    talk.step([BUS_OFF])
    talk.say("+ 95000")
    talk.say("> 605#4000100000000000\n< 585#4300100094010200\n< 085#4081000000000000\n+ 5000\n< 705#7F")


@pytest.mark.parametrize(("quiet_us", "wait_us"), [(1_000_000, 2 * FIRST_RESTART_US), (60_000_000, FIRST_RESTART_US)])
def test_the_back_off_ends_when_the_bus_was_well_for_long(quiet_us: int, wait_us: int) -> None:
    talk = serving()
    talk.advance(60_000_000)
    talk.step([BUS_OFF])
    talk.advance(FIRST_RESTART_US)
    assert talk.device.requests.pop() == ("bus-restart", 0, 0)
    assert said(talk, RESTARTED) == ["4081000000000000"]
    talk.advance(quiet_us)
    talk.step([BUS_OFF])
    talk.advance(wait_us - 1)
    assert talk.device.requests == []
    talk.advance(1)
    assert talk.device.requests == [("bus-restart", 0, 0)]


@pytest.mark.parametrize("can_id", [0x585, 0x705])
def test_another_node_with_this_node_id_is_said_once(can_id: int) -> None:
    talk = serving()
    answer = f"< 085#508111{can_id & 0xFF:02X}{can_id >> 8:02X}000000"
    talk.say(f"> {can_id:03X}#00\n{answer}\n> {can_id:03X}#00")
