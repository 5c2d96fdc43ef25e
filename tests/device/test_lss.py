"""LSS slave (CiA 305): selection, configuration, inquiry, identification, fastscan, the unconfigured node-id 255."""

import struct

import pytest

from device.conversation import Conversation
from device.services import PRODUCT, REVISION, SERIAL, VENDOR, serving
from device.tiny import Memory
from tipforce.device import storage

IDENTITY = (VENDOR, PRODUCT, REVISION, SERIAL)
CONFIGURE, WAIT = "> 7E5#0401000000000000\n", "> 7E5#0400000000000000\n"


def ask(talk: Conversation, service: int, number: int = 0, tail: bytes = b"") -> bytes | None:
    """One request; the data of the answer, None if there is none."""
    talk.step([(0x7E5, struct.pack("<BI", service, number) + tail.ljust(3, b"\0"))])
    answers = [data for can_id, data in talk.take() if can_id == 0x7E4]
    assert len(answers) < 2
    return answers[0] if answers else None


def test_nothing_is_configured_in_the_waiting_state() -> None:
    talk = serving()
    for service in (0x11, 0x13, 0x15, 0x17, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E):
        assert ask(talk, service, 9) is None
    assert talk.device.requests == []


def test_inquiry() -> None:
    talk = serving()
    talk.say(CONFIGURE)
    for k, number in enumerate(IDENTITY):
        assert ask(talk, 0x5A + k) == struct.pack("<BIxxx", 0x5A + k, number)
    talk.say("> 7E5#5E00000000000000\n< 7E4#5E05000000000000")
    talk.say(WAIT + "> 7E5#5E00000000000000")
    # No such mode, no such service, no LSS message: nothing happens, and the state stays.
    talk.say(CONFIGURE + "> 7E5#0402000000000000\n> 7E5#7700000000000000\n> 7E5#5E00")
    assert ask(talk, 0x5E) is not None


@pytest.mark.parametrize("wrong", [None, 0, 1, 2, 3])
def test_selective(wrong: int | None) -> None:
    talk = serving()
    answers = [ask(talk, 0x40 + k, number + (k == wrong)) for k, number in enumerate(IDENTITY)]
    assert answers == [None] * 3 + [b"\x44" + bytes(7) if wrong is None else None]
    assert (ask(talk, 0x5E) is not None) == (wrong is None)


def test_selective_begins_anew_with_each_vendor_id() -> None:
    talk = serving()
    assert ask(talk, 0x40, VENDOR) is ask(talk, 0x40, VENDOR) is None
    assert [ask(talk, 0x41 + k, IDENTITY[k + 1]) is not None for k in range(3)] == [False, False, True]


@pytest.mark.parametrize(("node_id", "error"), [(1, 0), (127, 0), (255, 0), (0, 1), (128, 1)])
def test_node_id_holds_after_a_reset(node_id: int, error: int) -> None:
    talk = serving()
    talk.say(CONFIGURE + f"> 7E5#11{node_id:02X}000000000000\n< 7E4#110{error}000000000000")
    assert talk.device.node_id == 5
    talk.step([(0, b"\x82\x05")])
    assert talk.device.node_id == (5 if error else node_id)


@pytest.mark.parametrize(("table", "index", "error"), [(0, 0, 0), (0, 8, 0), (0, 5, 1), (0, 9, 1), (1, 0, 1)])
def test_bit_timing(table: int, index: int, error: int) -> None:
    serving().say(CONFIGURE + f"> 7E5#13{table:02X}{index:02X}0000000000\n< 7E4#130{error}000000000000")


def test_activate_asks_the_loop_for_the_bit_rate() -> None:
    talk = serving()
    talk.say(CONFIGURE + "> 7E5#1300030000000000\n< 7E4#1300000000000000\n> 7E5#1534120000000000")
    assert talk.device.requests == [("bit-rate", 250_000, 0x1234)]


def test_store_and_start_again() -> None:
    store = Memory()
    talk = serving(store=store)
    talk.say(CONFIGURE + "> 7E5#1109000000000000\n< 7E4#1100000000000000")
    store.refuses = True
    talk.say("> 7E5#1700000000000000\n< 7E4#1702000000000000")
    store.refuses = False
    talk.say("> 7E5#1700000000000000\n< 7E4#1700000000000000")
    assert serving(store=store).device.node_id == 9


def test_store_where_nothing_can_be_stored() -> None:
    serving().say(CONFIGURE + "> 7E5#1700000000000000\n< 7E4#1701000000000000")


@pytest.mark.parametrize("content", [b"\x09", b"\x09\x05", b"\x80\x00", b"\x09\x00\x00"])
def test_a_stored_node_id_that_cannot_be_is_passed_over(content: bytes) -> None:
    store = Memory()
    store.groups["lss"] = storage.with_crc(content)
    assert serving(store=store).device.node_id == 5


@pytest.mark.parametrize("wrong", [None, 0, 1, 2, 3, 4, 5])
def test_identify(wrong: int | None) -> None:
    talk = serving()
    numbers = [VENDOR, PRODUCT, REVISION - 1, REVISION + 1, SERIAL, SERIAL]
    if wrong is not None:
        numbers[wrong] += -2 if wrong % 2 else 2
    answers = [ask(talk, 0x46 + k, number) for k, number in enumerate(numbers)]
    assert answers == [None] * 5 + [b"\x4f" + bytes(7) if wrong is None else None]


def test_identify_unconfigured() -> None:
    assert ask(serving(), 0x4C) is None
    assert ask(serving(255), 0x4C) == b"\x50" + bytes(7)


def fastscan(talk: Conversation) -> list[int]:
    """What a master finds by guessing each bit (CiA 305, 6.6.4)."""
    assert ask(talk, 0x51, 0, bytes((0x80, 0, 0))) == b"\x4f" + bytes(7)
    found = [0, 0, 0, 0]
    for part in range(4):
        for bit in range(31, -1, -1):
            if ask(talk, 0x51, found[part], bytes((bit, part, part))) is None:
                found[part] |= 1 << bit
        assert ask(talk, 0x51, found[part], bytes((0, part, (part + 1) % 4))) is not None
    return found


def test_fastscan_finds_the_identity_and_leaves_the_node_in_configuration() -> None:
    talk = serving(255)
    assert fastscan(talk) == list(IDENTITY)
    assert ask(talk, 0x51, 0, bytes((0x80, 0, 0))) is None  # found: it takes part no more
    talk.say("> 7E5#110C000000000000\n< 7E4#1100000000000000\n" + WAIT + "< 70C#00")
    assert talk.device.node_id == 12
    assert ask(talk, 0x51, 0, bytes((0x80, 0, 0))) is None


@pytest.mark.parametrize("tail", [(32, 0, 0), (31, 4, 0), (31, 0, 4), (31, 1, 0)])
def test_fastscan_out_of_order_or_range(tail: tuple[int, int, int]) -> None:
    talk = serving(255)
    assert ask(talk, 0x51, 0, bytes((0x80, 0, 0))) is not None
    assert ask(talk, 0x51, IDENTITY[0], bytes(tail)) is None


def test_an_unconfigured_node_says_nothing_but_lss() -> None:
    talk = serving(255)
    talk.say("""
        + 10000000
        > 000#0100
        > 67F#4000100000000000
        > 080#
        > 7E5#0401000000000000
        > 7E5#5E00000000000000
        < 7E4#5EFF000000000000
        > 7E5#0400000000000000
        + 10000000
    """)


def test_a_node_that_is_given_255_falls_silent_after_the_reset() -> None:
    talk = serving()
    talk.say(
        CONFIGURE + "> 7E5#11FF000000000000\n< 7E4#1100000000000000\n> 000#8205\n+ 10000000\n> 605#4000100000000000"
    )
    assert talk.device.node_id == 255
