"""LSS slave (CiA 305): the bit rate, what is stored, the unconfigured node-id 255."""

import pytest

from canopen_device.core import storage
from canopen_device.testing import MemoryStore
from device.tiny import serving

CONFIGURE = "> 7E5#0401000000000000\n"


def test_activate_asks_the_loop_for_the_bit_rate() -> None:
    talk = serving()
    talk.say(CONFIGURE + "> 7E5#1300030000000000\n< 7E4#1300000000000000\n> 7E5#1534120000000000")
    assert talk.device.requests == [("bit-rate", 250_000, 0x1234)]


def test_store_and_start_again() -> None:
    store = MemoryStore()
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
    store = MemoryStore()
    store.groups["lss"] = storage.with_crc(content)
    assert serving(store=store).device.node_id == 5


def test_a_node_that_is_given_255_falls_silent_after_the_reset() -> None:
    talk = serving()
    talk.say(
        CONFIGURE + "> 7E5#11FF000000000000\n< 7E4#1100000000000000\n> 000#8205\n+ 10000000\n> 605#4000100000000000"
    )
    assert talk.device.node_id == 255
